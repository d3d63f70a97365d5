"""Regularized losses and sampled neighbors, from settings."""

from __future__ import annotations

from functools import singledispatch

import torch
from torchrl.objectives import LossModule

from torchrl_l2c2.experiment.envs.frames import PREVIOUS
from torchrl_l2c2.experiment.settings.regularizers import (
    ASAPConfig,
    CAPSConfig,
    CATSConfig,
    GainConfig,
    GradCAPSConfig,
    L2C2Config,
    LCPConfig,
    NoRegularizerConfig,
    RegularizerConfig,
    SR2LConfig,
)
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import (
    ASAPLoss,
    CAPSLoss,
    CATSLoss,
    GradCAPSLoss,
    L2C2Loss,
    LCPLoss,
    SR2LLoss,
)
from torchrl_l2c2.transforms import NeighborTransform


def add_regularizer(loss: LossModule, config: RegularizerConfig) -> LossModule:
    """Adds a regularizer's terms to a loss and sets its strength.

    Args:
        loss (LossModule): Loss of the algorithm.
        config (RegularizerConfig): Settings of the regularizer.
    """
    loss = wrap(config, loss)
    if isinstance(config, GainConfig):
        loss.regularizer_gain = config.strength
        if config.relative:
            loss.relative()
    return loss


@singledispatch
def wrap(config: RegularizerConfig, loss: LossModule) -> LossModule:
    """Adds a regularizer's terms to a loss.

    ``wrap.register(MyConfig, function)`` adds a regularizer.

    Args:
        config (RegularizerConfig): Settings of the regularizer.
        loss (LossModule): Loss of the algorithm.

    Raises:
        NotImplementedError: If no function is registered for these settings.
    """
    raise NotImplementedError(
        f"wrap has no function for {type(config).__name__}. Add it with "
        f"wrap.register({type(config).__name__}, function)."
    )


@wrap.register
def _none(config: NoRegularizerConfig, loss: LossModule) -> LossModule:
    return loss


@wrap.register
def _l2c2(config: L2C2Config, loss: LossModule) -> LossModule:
    return L2C2Loss(
        loss,
        neighborhood=make_neighborhood(config),
        beta=config.beta,
        num_samples=config.num_samples,
        over_neighbors=config.over_neighbors,
        fraction=config.fraction,
        policy_distance=config.policy_distance,
    )


@wrap.register
def _caps(config: CAPSConfig, loss: LossModule) -> LossModule:
    return CAPSLoss(
        loss, config.sigma, config.lambda_temporal, config.lambda_spatial, mean=config.mean
    )


@wrap.register
def _cats(config: CATSConfig, loss: LossModule) -> LossModule:
    return CATSLoss(loss, config.lambda_temporal, mean=config.mean)


@wrap.register
def _grad_caps(config: GradCAPSConfig, loss: LossModule) -> LossModule:
    return GradCAPSLoss(
        loss, config.lambda_temporal, config.epsilon, previous_key=PREVIOUS, mean=config.mean
    )


@wrap.register
def _asap(config: ASAPConfig, loss: LossModule) -> LossModule:
    return ASAPLoss(
        loss,
        config.lambda_spatial,
        config.lambda_temporal,
        config.lambda_grad,
        config.epsilon,
        previous_key=PREVIOUS,
        mean=config.mean,
    )


@wrap.register
def _sr2l(config: SR2LConfig, loss: LossModule) -> LossModule:
    return SR2LLoss(
        loss,
        config.epsilon,
        config.coeff,
        steps=config.steps,
        policy_distance=config.policy_distance,
    )


@wrap.register
def _lcp(config: LCPConfig, loss: LossModule) -> LossModule:
    return LCPLoss(loss, config.coeff, of=config.of)


def make_neighborhood(config: RegularizerConfig) -> Neighborhood | None:
    """Returns L2C2's neighborhood, or ``None`` for other regularizers."""
    if not isinstance(config, L2C2Config):
        return None
    return Neighborhood(
        config.sigma,
        config.lambda_min,
        config.lambda_max,
        neighbors=config.neighbors,
        max_step=config.max_step,
    )


def make_neighbors(
    config: RegularizerConfig, generator: torch.Generator
) -> NeighborTransform | None:
    """Returns the transform that samples neighbors in the replay buffer, or ``None``."""
    if not isinstance(config, L2C2Config) or (near := make_neighborhood(config)) is None:
        return None
    return NeighborTransform(near, num_samples=config.num_samples, generator=generator)
