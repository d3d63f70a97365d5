"""SR2L: policies that change little in the worst direction of a small box around the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_positive_int, check_real, check_takes_gradients
from torchrl_l2c2.divergences import kl_divergence
from torchrl_l2c2.objectives._batch import at_rows
from torchrl_l2c2.objectives._evaluation import Policy, in_full_precision
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.policy_distances import (
    PolicyDistance,
    choose_policy_distance,
    compare_policies,
    distance_name,
)

States = Mapping[NestedKey, Tensor]


class SR2LLoss(RegularizedLoss):
    r"""A loss with the smoothness-inducing adversarial term of SR2L (Shen et al., 2020).

    Adds this term, ``loss_sr2l``, to any TorchRL loss with a policy:

    .. math::
        \lambda\, \mathbb E\left[\max_{\lVert \delta \rVert_\infty \le \epsilon}
            D\big(\pi(\cdot|s), \pi(\cdot|s + \delta)\big)\right]

    ("Deep Reinforcement Learning with Robust and Smooth Policy", arXiv 2003.09423). Projected
    gradient ascent searches for the maximum. It starts at a random point of the box and follows the
    sign of the gradient, in steps of :math:`2.5\,\epsilon` divided by their number [inferred]. The
    term trains the policy only, with gradients through both states but not through the search.

    .. note:: The loss cannot be passed to ``torch.compile``, because the search takes gradients.
        (The experiment compiles its updates in another way, and supports it.) The cost is high: the
        policy is evaluated and differentiated at the states, in each of the ``steps`` and at the
        point found.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        epsilon (float): half the width of the box, in the observation's units, greater than 0.
            Larger values smooth over larger distances. Typical values are 0.01 to 0.05 for
            normalized observations. Defaults to ``0.05``.
        coeff (float): :math:`\lambda`, at least 0. Larger values flatten the policy. Typical values
            are 0.03 to 0.3. Scheduled as ``sr2l_coeff``. Defaults to ``0.1``.

    Keyword Args:
        steps (int): number of ascent steps, at least 1. Larger values come closer to the maximum.
            Defaults to ``10``.
        policy_distance (str or callable): :math:`D`. ``"jeffreys"`` (the paper) is the mean of the
            two KL divergences; the other values are as for :class:`L2C2Loss`. Deterministic
            policies use half the squared distance of the actions (the paper has no factor
            one half), or with ``"mse"`` their mean squared error. Defaults to ``"jeffreys"``.
        fraction (float): share of the batch, in (0, 1], whose states are compared. Each call draws
            new rows with torch's global generator. Smaller values save time and memory in large
            batches and make the term noisier; its expectation does not change. Defaults to ``1.0``.

    Raises:
        TypeError: the loss has no policy or cannot be regularized, or an argument has the wrong
            type.
        ValueError: an argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import SR2LLoss
        >>> actor = Actor(torch.nn.Linear(3, 1, bias=False))
        >>> _ = torch.nn.init.ones_(actor.module.weight)
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = SR2LLoss(DDPGLoss(actor, value), epsilon=0.1, coeff=1.0)
        >>> batch = TensorDict({"observation": torch.randn(32, 3)}, batch_size=[32])
        >>> loss.policy_regularizer(batch)["loss_sr2l"]  # (3 * 0.1)^2 / 2, in a corner
        tensor(0.0450, grad_fn=<MulBackward0>)
    """

    _settings: ClassVar[tuple[str, ...]] = ("sr2l_epsilon", "sr2l_steps", "sr2l_fraction")

    def __init__(
        self,
        base_loss: LossModule,
        epsilon: float = 0.05,
        coeff: float = 0.1,
        *,
        steps: int = 10,
        policy_distance: Literal["jeffreys", "hellinger", "mean", "mse", "kl"]
        | PolicyDistance = "jeffreys",
        fraction: float = 1.0,
    ) -> None:
        check_real("fraction", fraction, above=0, at_most=1)
        self.sr2l_fraction = float(fraction)
        check_real("epsilon", epsilon, above=0)
        check_positive_int("steps", steps)
        self.sr2l_epsilon, self.sr2l_steps = float(epsilon), int(steps)
        self.register_coefficient("sr2l_coeff", coeff)
        self.declare_policy(successors=False)
        if policy_distance == "jeffreys":
            self._sr2l_distance: PolicyDistance = jeffreys_divergence
        else:
            self._sr2l_distance = choose_policy_distance(policy_distance)
            distance_name(policy_distance, self.has_stochastic_policy())
        self.declare_terms(policy=["loss_sr2l"])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        check_takes_gradients("SR2LLoss")
        rows = self.sample_rows("sr2l", tensordict, self.sr2l_fraction)
        batch = at_rows(tensordict, rows)
        states = self.policy_states(batch)

        def policy_at(places: States) -> Policy:
            moved = {key: place.unsqueeze(0) for key, place in places.items()}
            others = TensorDict(moved, batch_size=[1, *batch.batch_size])
            return self.policy_at(batch, others)

        here = policy_at(states)

        def distance(moved: States) -> Tensor:
            return compare_policies(self._sr2l_distance, here, policy_at(moved)).squeeze(0)

        farthest = ascend(distance, states, self.sr2l_epsilon, self.sr2l_steps)
        term = self.reduce_term(distance(farthest), tensordict, rows=rows)
        return terms.set("loss_sr2l", self.scaled(term, "sr2l_coeff"))


def jeffreys_divergence(p: Distribution, q: Distribution) -> Tensor:
    r"""The mean of the two KL divergences, :math:`\tfrac12 D(p \Vert q) + \tfrac12 D(q \Vert p)`.

    Args:
        p: a policy, batch shape ``[*B]``.
        q: another policy with the same action space.

    Returns:
        The divergences, shape ``[*B]``, at least 0.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal
        >>> from torchrl_l2c2.objectives.sr2l import jeffreys_divergence
        >>> jeffreys_divergence(Normal(torch.tensor([3.0]), 1.0), Normal(torch.zeros(1), 1.0))
        tensor([4.5000])
    """
    return 0.5 * (kl_divergence(p, q) + kl_divergence(q, p))


def ascend(
    distance: Callable[[States], Tensor], states: States, epsilon: float, steps: int
) -> States:
    """Searches a box around states for the point with the largest distance.

    Args:
        distance: function from states to one number each, ``[*B]``; differentiable.
        states: states by key, ``[*B, *F]``.
        epsilon: half the width of the box.
        steps: number of ascent steps.

    Returns:
        The states found, without a gradient.
    """
    moved = {k: s + epsilon * (2.0 * torch.rand_like(s) - 1.0) for k, s in states.items()}
    for _ in range(steps):
        with torch.enable_grad():
            moved = {key: state.detach().requires_grad_() for key, state in moved.items()}
            # Zero where the policy does not use a part of the state.
            total = distance(moved).sum()
            with in_full_precision(TensorDict(states)):
                gradients = torch.autograd.grad(total, list(moved.values()), materialize_grads=True)
        for (key, state), gradient in zip(states.items(), gradients, strict=True):
            found = moved[key].detach() + 2.5 * epsilon / steps * gradient.sign()
            moved[key] = found.clamp(state - epsilon, state + epsilon)
    return moved
