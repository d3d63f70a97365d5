"""CATS: policies whose mean changes little from a state to the next, ever less in training."""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_choice
from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.objectives.transitions import finite_successor
from torchrl_l2c2.policy_distances import policy_mean


class CATSLoss(RegularizedLoss):
    r"""A loss with CATS's temporal term (arXiv 2610.07910).

    Adds to any TorchRL loss with a policy

    .. math::
        \frac kK\, \lambda\, \mathbb E\left[\lVert \mu(s) - \mu(s') \rVert_2^2\right]

    as ``loss_cats``, in update :math:`k` of :math:`K`. The ramp is the caller's: assign
    ``loss.cats_lambda_temporal = RampGain(0.1).step(progress)``
    (:class:`torchrl_l2c2.gains.RampGain`), as ``regularizer=cats`` does in a run. There is no
    spatial term: its authors bound it by twice the temporal one. Gradients flow into the policy
    alone, through both states.

    [inferred] Which side of a squashing is compared and the value of :math:`\lambda` could not be
    read. The next state is that of the batch, with its masks and labels, several steps away behind
    ``MultiStepTransform``. Its coordinates that are not finite count as not having moved.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        lambda_temporal (float): :math:`\lambda k / K`, at least 0. Larger values slow the actions
            down. Scheduled as ``cats_lambda_temporal``. Defaults to ``0.1``.

    Keyword Args:
        mean (str): ``"loc"`` compares means before the squashing, ``"action"`` deterministic
            actions. Defaults to ``"loc"``.

    Raises:
        TypeError: the loss has no policy or cannot be regularized, or an argument has the wrong
            type.
        ValueError: an argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import CATSLoss
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = CATSLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value))
        >>> batch = TensorDict({"observation": torch.randn(32, 3)}, batch_size=[32])
        >>> batch["next", "observation"] = batch["observation"]
        >>> loss.policy_regularizer(batch)["loss_cats"].item()
        0.0
    """

    def __init__(
        self,
        base_loss: LossModule,
        lambda_temporal: float = 0.1,
        *,
        mean: Literal["loc", "action"] = "loc",
    ) -> None:
        check_choice("mean", mean, ("loc", "action"))
        self.cats_mean = mean
        self.register_coefficient("cats_lambda_temporal", lambda_temporal)
        self.declare_policy()
        self.declare_terms(policy=["loss_cats"])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        transitions = self.transitions(tensordict, self.policy_networks(), labels=True)
        later = {key: finite_successor(*pair)[None] for key, pair in transitions.items()}
        states = TensorDict(later, batch_size=[1, *tensordict.batch_size])
        squashed = self.cats_mean == "action"
        means = (policy_mean(p, squashed=squashed) for p in self.policies_at(tensordict, states))
        term = self.reduce_term(cats_term(*means).squeeze(0), tensordict)
        return terms.set("loss_cats", self.scaled(term, "cats_lambda_temporal"))


def cats_term(
    mean: Tensor,  # shape: [*B, A]
    later: Tensor,  # shape: [*B, A]
) -> Tensor:  # shape: [*B]
    r"""The temporal term of CATS, before its gain and its reduction.

    .. math::
        \lVert \mu(s) - \mu(s') \rVert_2^2

    Args:
        mean: the policy's means at the states.
        later: those at the next states.

    Raises:
        ValueError: their last dimensions differ.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.cats import cats_term
        >>> cats_term(torch.zeros(1, 2), torch.tensor([[3.0, 4.0]]))
        tensor([25.])
    """
    return 2.0 * squared_error(mean, later)
