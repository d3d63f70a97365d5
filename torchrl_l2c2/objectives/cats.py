"""CATS: policies whose mean changes little between successive states, with a growing gain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_bool, check_choice, check_real
from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives._batch import at_rows, finite_successor, read_moved_keys
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.policy_distances import policy_mean


class CATSLoss(RegularizedLoss):
    r"""A loss with CATS's temporal term (arXiv 2610.07910).

    Adds this term, ``loss_cats``, to any TorchRL loss with a policy:

    .. math::
        \frac kK\, \lambda\, \mathbb E\left[\lVert \mu(s) - \mu(s') \rVert_2^2\right]

    in update :math:`k` of :math:`K`. For the factor :math:`k / K`, call
    :meth:`~RegularizedLoss.ramp` once and :meth:`~RegularizedLoss.set_progress` during training.
    There is no spatial term: the authors bound it by twice the temporal term. The term trains the
    policy only, with gradients through both states.

    [inferred] The side of the squashing on which means are compared, and the value of
    :math:`\lambda`, are not known from the paper. The next state and its masks and labels come from
    the batch; behind ``MultiStepTransform`` it is several steps away. Its coordinates that are not
    finite are replaced by the state's coordinates. Transitions without any finite coordinate do not
    count. ``cats_counted`` is the share of the batch that counts.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        lambda_temporal (float): :math:`\lambda k / K`, at least 0. Larger values slow down the
            actions. Scheduled as ``cats_lambda_temporal``. Defaults to ``0.1``.

    Keyword Args:
        mean (str): ``"loc"`` compares means before the squashing, ``"action"`` mean actions.
            Defaults to ``"loc"``.
        fraction (float): share of the batch, in (0, 1], whose states are compared. Each call draws
            new rows with torch's global generator. Smaller values save time and memory in large
            batches and make the term noisier; its expectation does not change. Defaults to ``1.0``.
        moved_keys (str or sequence of NestedKey, optional): observations that are taken from the
            next state; the others, such as commands and previous actions, stay as they are in the
            state. Defaults to ``None``, all inputs.
        skip_ends (bool): whether to leave out transitions that end an episode. Use it for
            environments that store the reset state as the last next observation. Defaults to
            ``False``.

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

    _settings: ClassVar[tuple[str, ...]] = ("cats_mean", "cats_fraction", "cats_moved_keys")

    def __init__(
        self,
        base_loss: LossModule,
        lambda_temporal: float = 0.1,
        *,
        mean: Literal["loc", "action"] = "loc",
        fraction: float = 1.0,
        moved_keys: str | Sequence[NestedKey] | None = None,
        skip_ends: bool = False,
    ) -> None:
        check_choice("mean", mean, ("loc", "action"))
        check_real("fraction", fraction, above=0, at_most=1)
        self.cats_mean = mean
        self.cats_fraction = float(fraction)
        check_bool("skip_ends", skip_ends)
        self.skip_ends = self.skip_ends or skip_ends
        self.register_coefficient("cats_lambda_temporal", lambda_temporal)
        self.declare_policy()
        read = {POLICY_NETWORK: self.networks[POLICY_NETWORK].states}
        self.cats_moved_keys = None if moved_keys is None else read_moved_keys(moved_keys, read)
        self.declare_terms(policy=["loss_cats"], diagnostics=["cats_counted"])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        rows = self.sample_rows("cats", tensordict, self.cats_fraction)
        batch = at_rows(tensordict, rows)
        transitions = self.transitions(
            batch, self.policy_networks(), all_inputs=True, moved_keys=self.cats_moved_keys
        )
        counts = self.counted(batch, transitions)
        later = {key: finite_successor(*pair)[None] for key, pair in transitions.items()}
        states = TensorDict(later, batch_size=[1, *batch.batch_size])
        policies = self.policies_at(tensordict, states, rows)
        squashed = self.cats_mean == "action"
        means = (policy_mean(policy, squashed=squashed) for policy in policies)
        difference = cats_term(*means).squeeze(0)
        term = self.reduce_term(difference, tensordict, rows=rows, counts=counts)
        terms.set("loss_cats", self.scaled(term, "cats_lambda_temporal"))
        counted = self.reduce_diagnostic(counts.to(term.dtype), tensordict, rows=rows)
        return terms.set("cats_counted", counted)


def cats_term(
    mean: Tensor,  # shape: [*B, A]
    later: Tensor,  # shape: [*B, A]
) -> Tensor:  # shape: [*B]
    r"""The temporal term of CATS, before its gain and its reduction.

    .. math::
        \lVert \mu(s) - \mu(s') \rVert_2^2

    Args:
        mean: the policy's means at the states.
        later: the policy's means at the next states.

    Raises:
        ValueError: their last dimensions differ.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.cats import cats_term
        >>> cats_term(torch.zeros(1, 2), torch.tensor([[3.0, 4.0]]))
        tensor([25.])
    """
    return 2.0 * squared_error(mean, later)
