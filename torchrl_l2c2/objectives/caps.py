"""CAPS, the baseline: policies whose mean changes little over time and under noise."""

from __future__ import annotations

import math
from numbers import Real
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Categorical,
    OneHotCategorical,
    TransformedDistribution,
)
from torch.distributions.utils import _sum_rightmost
from torchrl.objectives import LossModule

from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives.regularized import Policy, RegularizedLoss


class CAPSLoss(RegularizedLoss):
    r"""A loss with conditioning for action policy smoothness (Mysore et al., 2021).

    Adds to any TorchRL loss with a policy, in the form of Kobayashi, L2C2, 2022,

    .. math::
        \lambda_T\, \mathbb E\left[\tfrac12 \lVert\mu(s) - \mu(s')\rVert_2^2\right]
        + \lambda_S\, \mathbb E\left[\tfrac12 \lVert\mu(s) - \mu(\bar s)\rVert_2^2\right],
        \qquad \bar s \sim \mathcal N(s, \sigma),

    the temporal and the spatial term, as ``loss_caps_temporal`` and ``loss_caps_spatial``.
    Gradients flow into the policy's parameters alone, through both states.

    The mean :math:`\mu` is that of the normal distribution. [inferred] The paper's policy is a
    plain normal; of a squashed one, ``mean`` says which side of the squashing is compared. Of
    discrete policies the probabilities are compared, the mean of an action written as one-hot
    vector.
    Coordinates of the next observation that are not finite, as at the ends of some episodes, count
    as not having moved.

    .. note:: The noise is drawn with torch's global generator. The gains are buffers that can be
        assigned to, as in ``loss.caps_lambda_spatial = 0.1``, also between calls of a compiled
        loss. They are not part of the ``state_dict``.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        sigma (float): standard deviation of the noise on every coordinate, in the observation's
            units, greater than 0. Larger values smooth over larger distances. Defaults to ``0.2``.
        lambda_temporal (float): gain of the temporal term, at least 0. Larger values slow the
            actions down. Scheduled as ``caps_lambda_temporal``. Defaults to ``0.01``.
        lambda_spatial (float): gain of the spatial term, at least 0. Larger values make actions
            less sensitive to the state. Scheduled as ``caps_lambda_spatial``. Defaults to ``0.05``.

    Keyword Args:
        mean (str): ``"loc"`` compares means before the squashing, and so restrains saturated
            policies as well; ``"action"`` compares deterministic actions, which hardly move once
            they are saturated. The same for policies that are not squashed. [inferred] Defaults
            to ``"loc"``.

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

    _schedulable_buffers = frozenset({"caps_lambda_temporal", "caps_lambda_spatial"})

    def __init__(
        self,
        base_loss: LossModule,
        sigma: float = 0.2,
        lambda_temporal: float = 0.01,
        lambda_spatial: float = 0.05,
        *,
        mean: Literal["loc", "action"] = "loc",
    ) -> None:
        if mean not in ("loc", "action"):
            raise ValueError(f"mean must be 'loc' or 'action', got {mean!r}.")
        if not isinstance(sigma, Real) or isinstance(sigma, bool):
            raise TypeError(f"sigma must be a real number, got {sigma!r}.")
        if not (math.isfinite(sigma) and sigma > 0):
            raise ValueError(f"sigma must be finite and greater than 0, got {sigma!r}.")
        if not self._policy_networks():
            raise TypeError(f"CAPSLoss needs a policy: {type(base_loss).__name__} has none.")
        self.caps_sigma = float(sigma)
        self.caps_mean = mean
        self._register_coefficient("caps_lambda_temporal", lambda_temporal)
        self._register_coefficient("caps_lambda_spatial", lambda_spatial)
        self._regularize(self._policy_networks())
        self.out_keys = [*self.out_keys, "loss_caps_temporal", "loss_caps_spatial"]

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        policies = self._policies_at(tensordict, self._states(tensordict))
        difference = _mean_difference(*policies, squashed=self.caps_mean == "action")
        temporal, spatial = (self._reduce_term(term, tensordict) for term in difference)
        terms.set("loss_caps_temporal", self.caps_lambda_temporal * temporal)
        terms.set("loss_caps_spatial", self.caps_lambda_spatial * spatial)
        return terms

    def _states(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The next state and a noisy one, ``[2, *B]``."""
        states = TensorDict(batch_size=[2, *tensordict.batch_size])
        transitions = self._transitions(tensordict, self._policy_networks())
        for key, (state, successor) in transitions.items():
            later = torch.where(successor.isfinite(), successor, state)
            noisy = state + self.caps_sigma * torch.randn_like(state)
            states.set(key, torch.stack((later, noisy)))
        return states


def _mean_difference(here: Policy, there: Policy, squashed: bool) -> Tensor:
    if isinstance(here, CompositeDistribution):
        parts = [
            _mean_difference(here.dists[name], there.dists[name], squashed) for name in here.dists
        ]
        return sum(_sum_rightmost(part, part.ndim - len(here.batch_shape)) for part in parts)
    return squared_error(_mean(here, squashed), _mean(there, squashed))


def _mean(policy: Policy, squashed: bool) -> Tensor:
    if isinstance(policy, Tensor):
        return policy
    if isinstance(policy, Bernoulli | Categorical | OneHotCategorical):
        return policy.probs
    if not squashed:
        while isinstance(policy, TransformedDistribution):
            policy = policy.base_dist
    mean = getattr(policy, "deterministic_sample", None)
    return policy.mean if mean is None else mean
