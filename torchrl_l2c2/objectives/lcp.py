"""LCP: policies whose log-likelihood, or whose mean, has a small gradient in the state."""

from __future__ import annotations

from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Distribution
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_choice, check_real, check_takes_gradients
from torchrl_l2c2.distances import log_prob_of
from torchrl_l2c2.objectives._batch import at_rows
from torchrl_l2c2.objectives._evaluation import Policy, in_full_precision
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.policy_distances import policy_mean


class LCPLoss(RegularizedLoss):
    r"""A loss with the gradient penalty of Lipschitz-constrained policies (Chen et al., 2024).

    Adds this term, ``loss_lcp``, to any TorchRL loss with a stochastic policy:

    .. math::
        \lambda\, \mathbb E\left[\lVert \nabla_s \ln\pi(a|s) \rVert_2^2\right]

    at the states and actions of the batch ("Learning Smooth Humanoid Locomotion through
    Lipschitz-Constrained Policies", arXiv 2410.11825). It trains the policy only and needs no next
    state. With ``of="mean"`` the term is the squared norm of the Jacobian of the mean:

    .. math::
        \lambda\, \mathbb E\left[\lVert \nabla_s \mu(s) \rVert_F^2\right]
        = \lambda\, \mathbb E\left[\lVert \nabla_s\, v^\top \mu(s) \rVert_2^2\right],
        \qquad v_i = \pm 1,

    It does not depend on the width of the policy, and works for deterministic policies. One random
    sign vector :math:`v` for each state gives an unbiased estimate.

    With several agents whose policies read their own states, the terms are of each agent. If each
    policy reads the states of all agents, ``"log_prob"`` has the gradient of the summed logarithms,
    divided by the number of agents; ``"mean"`` is of each agent's mean.

    .. note:: The loss cannot be passed to ``torch.compile``, because it differentiates twice. (The
        experiment compiles its updates in another way, and supports it.) A narrow policy has a
        steep likelihood: as the policy's scale falls, the same slope of its mean costs more.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        coeff (float): :math:`\lambda`, at least 0. Larger values flatten the policy. Scheduled as
            ``lcp_coeff``. Defaults to ``0.002``.

    Keyword Args:
        of (str): function to differentiate: ``"log_prob"`` (the paper) or ``"mean"``. Defaults to
            ``"log_prob"``.
        fraction (float): share of the batch, in (0, 1], whose states are used. Each call draws new
            rows with torch's global generator. Smaller values save time and memory in large batches
            and make the term noisier; its expectation does not change. Defaults to ``1.0``.

    Raises:
        TypeError: the loss has no policy, has a deterministic policy with ``of="log_prob"``, or
            cannot be regularized; or an argument has the wrong type.
        ValueError: an argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import PPOLoss
        >>> from torchrl_l2c2 import LCPLoss, make_actor
        >>> loss = LCPLoss(PPOLoss(make_actor(3, 1, hidden=(8,)), None))
        >>> batch = TensorDict({"observation": torch.randn(32, 3)}, batch_size=[32])
        >>> batch["action"] = torch.zeros(32, 1)
        >>> bool(loss.policy_regularizer(batch)["loss_lcp"] > 0)
        True
    """

    _settings: ClassVar[tuple[str, ...]] = ("lcp_of", "lcp_fraction")

    def __init__(
        self,
        base_loss: LossModule,
        coeff: float = 0.002,
        *,
        of: Literal["log_prob", "mean"] = "log_prob",
        fraction: float = 1.0,
    ) -> None:
        check_choice("of", of, ("log_prob", "mean"))
        check_real("fraction", fraction, above=0, at_most=1)
        self.lcp_of = of
        self.lcp_fraction = float(fraction)
        self.register_coefficient("lcp_coeff", coeff)
        self.declare_policy(successors=False)
        if of == "log_prob" and not self.has_stochastic_policy():
            raise TypeError(
                "LCPLoss needs a stochastic policy: the policy of "
                f"{type(base_loss).__name__} has no likelihood. Use of='mean', or another "
                "regularizer."
            )
        self.declare_terms(policy=["loss_lcp"])

    # Dynamo does not trace a gradient within the loss; the rest is compiled around it.
    @torch.compiler.disable
    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        check_takes_gradients("LCPLoss")
        rows = self.sample_rows("lcp", tensordict, self.lcp_fraction)
        batch = at_rows(tensordict, rows)
        read = self.policy_states(batch)
        with torch.enable_grad():
            states = {key: state.unsqueeze(0).requires_grad_() for key, state in read.items()}
            others = TensorDict(states, batch_size=[1, *batch.batch_size])
            policy = self.policy_at(batch, others)
            output = self._log_prob(policy, batch) if self.lcp_of == "log_prob" else _signed(policy)
            with in_full_precision(batch):
                term = lcp_term(output, list(states.values()), batch.batch_dims + 1)
        term = self.reduce_term(term.squeeze(0), tensordict, rows=rows)
        return terms.set("loss_lcp", self.scaled(term, "lcp_coeff"))

    def _log_prob(self, policy: Policy, batch: TensorDictBase) -> Tensor:
        """The log-likelihood of the batch's actions, ``[1, *B]``."""
        assert isinstance(policy, Distribution)
        actions = batch.detach().unsqueeze(0)
        if not isinstance(policy, CompositeDistribution):
            # If the loss does not name the action, it is the output of the policy.
            written = self.networks[POLICY_NETWORK].output
            actions = actions.get(getattr(self.tensor_keys, "action", written))
        return log_prob_of(policy, actions)


def _signed(policy: Policy) -> Tensor:
    """The sum of the mean's coordinates with random signs, ``[1, *B]``."""
    mean = policy_mean(policy)
    signs = 2.0 * torch.randint_like(mean, 2) - 1.0
    return (signs * mean).sum(-1)


def lcp_term(
    log_prob: Tensor,  # shape: [*B, ...]
    states: list[Tensor],  # shape: [*B, *F] each
    batch_dims: int,
) -> Tensor:  # shape: [*B] or, for agents with separate states, [*B, agents]
    r"""The gradient penalty of LCP, before its gain and its reduction.

    .. math::
        \lVert \nabla_s \ln\pi(a|s) \rVert_2^2

    over all parts of the state. Its gradient is a second derivative.

    Args:
        log_prob: :math:`\ln\pi(a|s)`, computed from the states; it may have a dimension of agents.
        states: the parts of the state, which require a gradient.
        batch_dims: number of dimensions of ``[*B]``.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.lcp import lcp_term
        >>> state = torch.tensor([[3.0, 4.0]], requires_grad=True)
        >>> lcp_term(state.square().sum(-1), [state], 1)
        tensor([100.], grad_fn=<SumBackward1>)
    """
    # Zero where the policy does not use a part of the state.
    gradients = torch.autograd.grad(
        log_prob.sum(), states, create_graph=True, materialize_grads=True
    )
    # Agents with separate states are treated as rows of the batch: no sum over agents.
    agents = log_prob.ndim
    if all(s.ndim > agents and s.shape[:agents] == log_prob.shape for s in states):
        batch_dims = agents
    # Not flatten, which refuses states [*B].
    shapes = [(*state.shape[:batch_dims], state.shape[batch_dims:].numel()) for state in states]
    squares = [g.square().reshape(s).sum(-1) for g, s in zip(gradients, shapes, strict=True)]
    return torch.stack(squares).sum(0)
