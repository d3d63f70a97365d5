"""CAPS, the baseline: policies whose mean changes little over time and under noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_bool, check_choice, check_real
from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives._batch import (
    at_rows,
    finite_successor,
    is_floating_point,
    read_moved_keys,
)
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.policy_distances import policy_mean


class CAPSLoss(RegularizedLoss):
    r"""A loss with conditioning for action policy smoothness (Mysore et al., 2021).

    Adds these terms to any TorchRL loss with a policy, in the form of Kobayashi, L2C2, 2022:

    .. math::
        \lambda_T\, \mathbb E\left[\tfrac12 \lVert\mu(s) - \mu(s')\rVert_2^2\right]
        + \lambda_S\, \mathbb E\left[\tfrac12 \lVert\mu(s) - \mu(\bar s)\rVert_2^2\right],
        \qquad \bar s \sim \mathcal N(s, \sigma),

    the temporal and the spatial term, as ``loss_caps_temporal`` and ``loss_caps_spatial``. They
    train the policy only, with gradients through both states.

    :math:`\mu` is the mean of the normal distribution. [inferred] The paper's policy is a normal
    distribution. For squashed or truncated distributions, ``mean`` chooses whether means are
    compared before or after the squashing. Discrete policies are compared by their probabilities,
    the mean of the one-hot action. For composite policies the distances of the heads add up.

    The next state and its masks and labels come from the batch; behind ``MultiStepTransform`` it is
    several steps away. The noisy state keeps the masks and labels of the state. Coordinates of the
    next observation that are not finite are replaced by the state's coordinates. Transitions
    without any finite coordinate, such as the ends of some episodes, do not count in the temporal
    term. ``caps_counted`` is the share of the batch that counts.

    .. note:: The noise is drawn with torch's global generator. Gains are buffers: assign to them at
        any time, as in ``loss.caps_lambda_spatial = 0.1``, also between calls of a compiled loss.
        They are not part of the ``state_dict``.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        sigma (float): standard deviation of the noise on every coordinate, in the observation's
            units, greater than 0. Larger values smooth over larger distances. Defaults to ``0.2``.
        lambda_temporal (float): gain of the temporal term, at least 0. Larger values slow down the
            actions. Scheduled as ``caps_lambda_temporal``. Defaults to ``0.01``.
        lambda_spatial (float): gain of the spatial term, at least 0. Larger values make actions
            less sensitive to the state. Scheduled as ``caps_lambda_spatial``. Defaults to ``0.05``.

    Keyword Args:
        mean (str): ``"loc"`` compares means before the squashing and also restrains saturated
            policies; ``"action"`` compares mean actions, which hardly change once they are
            saturated. The two are equal for deterministic policies and policies without squashing.
            [inferred] Defaults to ``"loc"``.
        fraction (float): share of the batch, in (0, 1], whose states are compared. Each call draws
            new rows with torch's global generator. Smaller values save time and memory in large
            batches and make the terms noisier; their expectation does not change. Defaults to
            ``1.0``.
        moved_keys (str or sequence of NestedKey, optional): observations that are taken from the
            next state, and get noise; the others, such as commands and previous actions, stay as
            they are in the state. Defaults to ``None``, all inputs.
        skip_ends (bool): whether to leave transitions that end an episode out of the temporal term.
            Use it for environments that store the reset state as the last next observation.
            Defaults to ``False``.

    Raises:
        TypeError: the loss has no policy or cannot be regularized, or an argument has the wrong
            type.
        ValueError: an argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import CAPSLoss
        >>> actor = Actor(torch.nn.Linear(3, 1))
        >>> value = ValueOperator(
        ...     MLP(in_features=4, out_features=1), in_keys=["observation", "action"]
        ... )
        >>> loss = CAPSLoss(DDPGLoss(actor, value), sigma=0.2)
        >>> batch = TensorDict({"observation": torch.randn(32, 3)}, batch_size=[32])
        >>> batch["next", "observation"] = batch["observation"]
        >>> loss.policy_regularizer(batch)["loss_caps_temporal"].item()
        0.0
    """

    _settings: ClassVar[tuple[str, ...]] = (
        "caps_sigma",
        "caps_mean",
        "caps_fraction",
        "caps_moved_keys",
    )

    def __init__(
        self,
        base_loss: LossModule,
        sigma: float = 0.2,
        lambda_temporal: float = 0.01,
        lambda_spatial: float = 0.05,
        *,
        mean: Literal["loc", "action"] = "loc",
        fraction: float = 1.0,
        moved_keys: str | Sequence[NestedKey] | None = None,
        skip_ends: bool = False,
    ) -> None:
        check_choice("mean", mean, ("loc", "action"))
        check_real("sigma", sigma, above=0)
        self.caps_sigma = float(sigma)
        check_real("fraction", fraction, above=0, at_most=1)
        self.caps_mean = mean
        self.caps_fraction = float(fraction)
        check_bool("skip_ends", skip_ends)
        self.skip_ends = self.skip_ends or skip_ends
        self.register_coefficient("caps_lambda_temporal", lambda_temporal)
        self.register_coefficient("caps_lambda_spatial", lambda_spatial)
        self.declare_policy()
        read = {POLICY_NETWORK: self.networks[POLICY_NETWORK].states}
        self.caps_moved_keys = None if moved_keys is None else read_moved_keys(moved_keys, read)
        self.declare_terms(
            policy=["loss_caps_temporal", "loss_caps_spatial"], diagnostics=["caps_counted"]
        )

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        rows = self.sample_rows("caps", tensordict, self.caps_fraction)
        batch = at_rows(tensordict, rows)
        transitions = self.transitions(
            batch, self.policy_networks(), all_inputs=True, moved_keys=self.caps_moved_keys
        )
        counts = self.counted(batch, transitions)
        policies = self.policies_at(tensordict, self._states(batch, transitions), rows)
        squashed = self.caps_mean == "action"
        means = (policy_mean(policy, squashed=squashed) for policy in policies)
        temporal, spatial = caps_terms(*means)
        temporal = self.reduce_term(temporal, tensordict, rows=rows, counts=counts)
        spatial = self.reduce_term(spatial, tensordict, rows=rows)
        terms.set("loss_caps_temporal", self.scaled(temporal, "caps_lambda_temporal"))
        terms.set("loss_caps_spatial", self.scaled(spatial, "caps_lambda_spatial"))
        counted = self.reduce_diagnostic(counts.to(temporal.dtype), tensordict, rows=rows)
        return terms.set("caps_counted", counted)

    def _states(
        self,
        batch: TensorDictBase,
        transitions: Mapping[NestedKey, tuple[Tensor, Tensor]],
    ) -> TensorDictBase:
        """The next state and a noisy one, ``[2, *B]``."""
        states = TensorDict(batch_size=[2, *batch.batch_size])
        recurrent = self.networks[POLICY_NETWORK].recurrent
        for key, (state, successor) in transitions.items():
            later = finite_successor(state, successor)
            noisy = state
            if is_floating_point(state) and key not in recurrent:
                noisy = state + self.caps_sigma * torch.randn_like(state)
            states.set(key, torch.stack((later, noisy)))
        return states


def caps_terms(
    mean: Tensor,  # shape: [1, *B, A] or [2, *B, A]
    moved: Tensor,  # shape: [2, *B, A]
) -> tuple[Tensor, Tensor]:  # shape: [*B], [*B]
    r"""The temporal and the spatial term of CAPS, before their gains and their reduction.

    .. math::
        \tfrac12 \lVert\mu(s) - \mu(s')\rVert_2^2, \qquad
        \tfrac12 \lVert\mu(s) - \mu(\bar s)\rVert_2^2

    (Mysore et al., 2021, in the form of Kobayashi, L2C2, 2022).

    Args:
        mean: the policy's means at the states.
        moved: the means at the next states, then at noisy copies of the states.

    Raises:
        ValueError: their last dimensions differ.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.caps import caps_terms
        >>> moved = torch.tensor([[[1.0, 0.0]], [[1.0, 2.0]]])
        >>> caps_terms(torch.zeros(1, 1, 2), moved)
        (tensor([0.5000]), tensor([2.5000]))
    """
    temporal, spatial = squared_error(mean, moved)
    return temporal, spatial
