"""Regularized losses from settings."""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch
from inspect import signature

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


def _with_settings(make: Callable[..., LossModule]) -> Callable[..., LossModule]:
    """Makes a function that passes the settings that have the names of arguments."""

    def wrapped(config: RegularizerConfig, loss: LossModule) -> LossModule:
        settings = {k: v for k, v in vars(config).items() if k in signature(make).parameters}
        previous = {"previous_key": PREVIOUS} if config.reads_previous else {}
        return make(loss, **settings, **previous)

    return wrapped


wrap.register(CAPSConfig, _with_settings(CAPSLoss))
wrap.register(CATSConfig, _with_settings(CATSLoss))
wrap.register(GradCAPSConfig, _with_settings(GradCAPSLoss))
wrap.register(ASAPConfig, _with_settings(ASAPLoss))
wrap.register(SR2LConfig, _with_settings(SR2LLoss))
wrap.register(LCPConfig, _with_settings(LCPLoss))


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
