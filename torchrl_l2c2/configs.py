"""The components as Hydra configurations, next to those of TorchRL's trainers.

Needs ``hydra-core``, as TorchRL's own configurations do; nothing else in the package imports this
module.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, ListConfig
from torchrl.objectives import LossModule
from torchrl.trainers.algorithms.configs.common import (
    ConfigBase,
    _normalize_hydra_key,
    _normalize_hydra_keys,
)
from torchrl.trainers.algorithms.configs.objectives import LossConfig, TargetNetUpdaterConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import L2C2Loss
from torchrl_l2c2.transforms import NeighborTransform, ObservationNoise

_BUILDERS = "torchrl_l2c2.configs"


@dataclass
class NeighborhoodConfig(ConfigBase):
    """Hydra configuration of a :class:`~torchrl_l2c2.Neighborhood`, ``neighborhood: l2c2``."""

    sigma: float = 1.0
    lambda_min: float = 0.01
    lambda_max: float = 1.0
    _target_: str = "torchrl_l2c2.Neighborhood"

    def __post_init__(self) -> None:
        """As TorchRL's configurations have it."""


@dataclass
class L2C2LossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.L2C2Loss`, ``loss: l2c2``.

    ``base_loss`` is the configuration of another loss, such as TorchRL's ``loss: sac``;
    ``neighborhood``, where it is not the paper's, one of the group of that name.
    """

    base_loss: Any = MISSING
    neighborhood: Any = None
    beta: float = 0.1
    coeff: float = 1.0
    num_samples: int = 1
    hellinger_samples: int | None = None
    neighbor_key: Any = "neighbor"
    _target_: str = f"{_BUILDERS}._make_l2c2_loss"


@dataclass
class CAPSLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.CAPSLoss`, ``loss: caps``.

    ``base_loss`` is the configuration of another loss, such as TorchRL's ``loss: sac``.
    """

    base_loss: Any = MISSING
    sigma: float = 0.2
    lambda_temporal: float = 0.01
    lambda_spatial: float = 0.05
    mean: str = "loc"
    _target_: str = "torchrl_l2c2.CAPSLoss"


@dataclass
class PPORPELossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.PPORPELoss`, ``loss: ppo_rpe``."""

    actor_network: Any = MISSING
    critic_network: Any = MISSING
    gamma: float = 0.99
    kappa: float = 0.5
    beta: float = 0.5
    decay: float = 0.999
    delta_min: float = 0.1
    threshold: str = "max"
    critic_weighting: str = "ratio"
    baseline: str = "stored"
    importance: str = "max"
    reduction: str = "mean"
    _target_: str = "torchrl_l2c2.PPORPELoss"


@dataclass
class NeighborTransformConfig(TransformConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.NeighborTransform`, ``transform: neighbor``.

    ``neighborhood`` is as in the loss. A ``seed`` gives the transform a generator of its own.
    """

    neighborhood: Any = None
    in_keys: list[Any] | None = None
    out_key: Any = "neighbor"
    num_samples: int = 1
    seed: int | None = None
    _target_: str = f"{_BUILDERS}._make_neighbor_transform"


@dataclass
class ObservationNoiseConfig(TransformConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.ObservationNoise`.

    It is ``transform: observation_noise``; ``scale`` may be a list. A ``seed`` gives the transform
    a generator of its own.
    """

    scale: Any = MISSING
    in_keys: list[Any] | None = None
    seed: int | None = None
    _target_: str = f"{_BUILDERS}._make_observation_noise"


@dataclass
class AdaTermConfig(ConfigBase):
    """Hydra configuration of :class:`~torchrl_l2c2.AdaTerm`, ``optimizer: adaterm``."""

    lr: float = 1e-3
    beta: float = 0.9
    eps: float = 1e-5
    nu_min: float = 1.0
    _target_: str = "torchrl_l2c2.AdaTerm"
    _partial_: bool = True

    def __post_init__(self) -> None:
        """As TorchRL's configurations have it."""


@dataclass
class TSoftUpdateConfig(TargetNetUpdaterConfig):
    """Hydra configuration of :class:`~torchrl_l2c2.TSoftUpdate`, ``target_net_updater: tsoft``."""

    tau: float = 0.1
    nu: float = 1.0
    _target_: str = "torchrl_l2c2.TSoftUpdate"


def register() -> None:
    """Adds the package's configurations to Hydra's store, in the groups of TorchRL's.

    TorchRL stores its own when ``torchrl.trainers.algorithms.configs`` is imported; importing this
    module imports that one too, and so brings TorchRL's configurations with it. The package's own
    are stored by this call alone, so that looking at a class changes nothing for others in the
    process. Calling it again changes nothing. Every name is new in its group:

    ====================== ===================================
    group                  names
    ====================== ===================================
    ``loss``               ``l2c2``, ``caps``, ``ppo_rpe``
    ``transform``          ``neighbor``, ``observation_noise``
    ``optimizer``          ``adaterm``
    ``target_net_updater`` ``tsoft``
    ``neighborhood``       ``l2c2``
    ====================== ===================================

    Examples:
        >>> from hydra import compose, initialize
        >>> from torchrl_l2c2 import configs
        >>> configs.register()
        >>> with initialize(version_base=None, config_path=None):
        ...     cfg = compose(
        ...         overrides=[
        ...             "+loss=l2c2",
        ...             "+loss@loss.base_loss=sac",
        ...             "+neighborhood@loss.neighborhood=l2c2",
        ...             "loss.neighborhood.lambda_max=0.5",
        ...         ]
        ...     )
        >>> cfg.loss.beta, cfg.loss.neighborhood.lambda_max, cfg.loss.base_loss.num_qvalue_nets
        (0.1, 0.5, 2)
    """
    store = ConfigStore.instance()
    store.store(group="loss", name="l2c2", node=L2C2LossConfig)
    store.store(group="loss", name="caps", node=CAPSLossConfig)
    store.store(group="loss", name="ppo_rpe", node=PPORPELossConfig)
    store.store(group="transform", name="neighbor", node=NeighborTransformConfig)
    store.store(group="transform", name="observation_noise", node=ObservationNoiseConfig)
    store.store(group="optimizer", name="adaterm", node=AdaTermConfig)
    store.store(group="target_net_updater", name="tsoft", node=TSoftUpdateConfig)
    store.store(group="neighborhood", name="l2c2", node=NeighborhoodConfig)


def _make_l2c2_loss(base_loss: LossModule, neighbor_key: Any, **settings: Any) -> L2C2Loss:
    return L2C2Loss(base_loss, neighbor_key=_normalize_hydra_key(neighbor_key), **settings)


def _make_neighbor_transform(
    neighborhood: Neighborhood | None,
    in_keys: Sequence[Any] | None,
    out_key: Any,
    seed: int | None,
    **settings: Any,
) -> NeighborTransform:
    return NeighborTransform(
        Neighborhood() if neighborhood is None else neighborhood,
        in_keys=_normalize_hydra_keys(in_keys),
        out_key=_normalize_hydra_key(out_key),
        generator=_generator(seed),
        **settings,
    )


def _make_observation_noise(
    scale: Any, in_keys: Sequence[Any] | None, seed: int | None
) -> ObservationNoise:
    # A list arrives as OmegaConf's own, which torch does not take.
    scale = list(scale) if isinstance(scale, ListConfig) else scale
    return ObservationNoise(
        scale, in_keys=_normalize_hydra_keys(in_keys), generator=_generator(seed)
    )


def _generator(seed: int | None) -> torch.Generator | None:
    return None if seed is None else torch.Generator().manual_seed(seed)
