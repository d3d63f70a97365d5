"""Hydra configurations of the components, for TorchRL's trainers.

Needs ``hydra-core``, as TorchRL's configurations do. No other module imports this module.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, make_dataclass
from typing import Any, Literal, Optional, get_args, get_origin, get_type_hints

import torch
from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, ListConfig, OmegaConf
from torchrl.objectives import LossModule
from torchrl.trainers.algorithms.configs.common import (
    ConfigBase,
    _normalize_hydra_key,
    _normalize_hydra_keys,
)
from torchrl.trainers.algorithms.configs.objectives import LossConfig, TargetNetUpdaterConfig
from torchrl.trainers.algorithms.configs.transforms import TransformConfig

from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import L2C2Loss, PPORPELoss, RegularizedLoss
from torchrl_l2c2.optim import AdaTerm
from torchrl_l2c2.smoothing import smooth
from torchrl_l2c2.transforms import NeighborTransform, ObservationNoise
from torchrl_l2c2.updaters import TSoftUpdate


def _make_smooth_loss(
    base_loss: LossModule | Callable[..., LossModule],
    method: str,
    strength: float,
    fold: bool,
    overrides: Mapping[str, Any],
    **networks: Any,
) -> RegularizedLoss:
    """The wrapped loss; some trainers pass their networks to a loss with ``_partial_``."""
    normalized = {key: _normalize_hydra_key(value) for key, value in overrides.items()}
    if "moved_keys" in normalized:
        normalized["moved_keys"] = _listed(overrides["moved_keys"])
    if "neighborhood" in normalized and OmegaConf.is_config(overrides):
        # OmegaConf keeps dataclasses as configurations.
        objects: Any = OmegaConf.to_object(overrides)
        normalized["neighborhood"] = objects["neighborhood"]
    loss = base_loss(**networks) if networks else base_loss
    return smooth(loss, method, strength, fold, **normalized)


def _make_l2c2_loss(
    base_loss: LossModule, neighbor_key: Any, moved_keys: Any = None, **settings: Any
) -> L2C2Loss:
    return L2C2Loss(
        base_loss,
        neighbor_key=_normalize_hydra_key(neighbor_key),
        moved_keys=_listed(moved_keys),
        **settings,
    )


def _make_neighbor_transform(
    in_keys: Any,
    out_key: Any,
    neighborhood: Any = None,
    seed: int | None = None,
    device: str = "cpu",
    **settings: Any,
) -> NeighborTransform:
    return NeighborTransform(
        Neighborhood() if neighborhood is None else neighborhood,
        in_keys=_listed(in_keys),
        out_key=_normalize_hydra_key(out_key),
        generator=_generator(seed, device),
        **settings,
    )


def _make_observation_noise(
    scale: Any, in_keys: Any, seed: int | None = None, device: str = "cpu"
) -> ObservationNoise:
    # OmegaConf passes its own list type, which torch does not accept.
    scale = list(scale) if isinstance(scale, ListConfig) else scale
    return ObservationNoise(scale, in_keys=_listed(in_keys), generator=_generator(seed, device))


def _listed(keys: Any) -> Any:
    """A list of names of entries; a string is a single name."""
    return keys if isinstance(keys, str) else _normalize_hydra_keys(keys)


def _generator(seed: int | None, device: str) -> torch.Generator | None:
    return None if seed is None else torch.Generator(device).manual_seed(seed)


def _node(
    component: type[Any],
    base: type,
    *,
    builder: Callable[..., Any] | None = None,
    without: tuple[str, ...] = (),
    partial: bool = False,
) -> type:
    """Makes a dataclass of a component's parameters, with their types and defaults.

    Args:
        component: the class to configure.
        base: TorchRL's base class of the configuration.
        builder: function called instead of the class; its types and defaults take precedence.
        without: parameters that are not configured.
        partial: whether the program passes the other arguments, such as an optimizer's parameters.
    """
    target = component if builder is None else builder
    module = "torchrl_l2c2" if builder is None else __name__
    parameters = _parameters(component.__init__)
    for name, (kind, default) in _parameters(builder).items() if builder else ():
        known = parameters.get(name, (kind, MISSING))
        parameters[name] = (kind, known[1] if default is MISSING else default)
    inherited = {f.name for f in fields(base)} | {"self", *without}
    made = [
        (name, kind, field(default=default))
        for name, (kind, default) in parameters.items()
        if name not in inherited
    ]
    made.append(("_target_", str, field(default=f"{module}.{target.__name__}")))
    if partial:
        made.append(("_partial_", bool, field(default=True)))
    name = f"{component.__name__}Config"
    namespace = {
        "__doc__": f"Hydra configuration of :class:`~torchrl_l2c2.{component.__name__}`.",
        "__module__": __name__,
        "__post_init__": lambda self: None,
    }
    return make_dataclass(name, made, bases=(base,), namespace=namespace)


def _parameters(function: Callable[..., Any]) -> dict[str, tuple[Any, Any]]:
    """A function's parameters by name, with types that OmegaConf can check, and defaults."""
    hints = get_type_hints(function)
    return {
        name: (
            _checkable(hints.get(name, Any)),
            MISSING if parameter.default is parameter.empty else parameter.default,
        )
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD
    }


def _checkable(hint: Any) -> Any:
    """Converts a type hint to a type that OmegaConf checks; ``Any`` for objects."""
    members = get_args(hint) if get_origin(hint) is not Literal else ()
    simple: list[Any] = [kind for kind in (bool, int, float, list[Any]) if kind in (hint, *members)]
    if get_origin(hint) is Literal or hint is str:
        simple = [str]
    if not simple:
        return Any
    return Optional[simple[0]] if type(None) in members else simple[0]  # noqa: UP045


@dataclass
class SmoothLossConfig(LossConfig):
    """Hydra configuration of :func:`~torchrl_l2c2.smooth`.

    Attributes:
        base_loss: configuration of the loss.
        method: as for ``smooth``.
        strength: as for ``smooth``.
        fold: as for ``smooth``.
        overrides: settings that replace the preset, by name.
    """

    base_loss: Any = MISSING
    method: str = "l2c2"
    strength: float = 1.0
    fold: bool = True
    overrides: dict[str, Any] = field(default_factory=dict)
    _target_: str = "torchrl_l2c2.trainers._make_smooth_loss"

    def __post_init__(self) -> None:
        pass


NeighborhoodConfig = _node(Neighborhood, ConfigBase)
L2C2LossConfig = _node(L2C2Loss, LossConfig, builder=_make_l2c2_loss)
PPORPELossConfig = _node(PPORPELoss, LossConfig)
NeighborTransformConfig = _node(
    NeighborTransform, TransformConfig, builder=_make_neighbor_transform, without=("generator",)
)
ObservationNoiseConfig = _node(
    ObservationNoise, TransformConfig, builder=_make_observation_noise, without=("generator",)
)
AdaTermConfig = _node(AdaTerm, ConfigBase, without=("params",), partial=True)
TSoftUpdateConfig = _node(TSoftUpdate, TargetNetUpdaterConfig)


def register() -> None:
    """Adds the package's configurations to Hydra's store, in TorchRL's groups.

    Importing this module also stores TorchRL's configurations. The package's configurations are
    stored only by this call; further calls have no effect. No name replaces a configuration of
    TorchRL:

    ====================== ===================================
    group                  names
    ====================== ===================================
    ``loss``               ``smooth``, ``l2c2``, ``ppo_rpe``
    ``transform``          ``neighbor``, ``observation_noise``
    ``optimizer``          ``adaterm``
    ``target_net_updater`` ``tsoft``
    ``neighborhood``       ``l2c2``
    ====================== ===================================

    ``loss: smooth`` is :func:`~torchrl_l2c2.smooth`, with its methods and presets. The other
    configurations have the parameters and defaults of their components. ``base_loss`` is the
    configuration of another loss, such as TorchRL's ``loss: sac``. ``neighborhood`` is a
    configuration of the group ``neighborhood``; without it, the paper's settings apply. With
    ``seed``, a transform has its own generator on ``device``, the device of the batches (such as
    ``cuda:0``; default ``cpu``).

    Examples:
        >>> from hydra import compose, initialize
        >>> from torchrl_l2c2 import trainers
        >>> trainers.register()
        >>> with initialize(version_base=None, config_path=None):
        ...     cfg = compose(
        ...         overrides=[
        ...             "+loss=smooth",
        ...             "+loss@loss.base_loss=sac",
        ...             "loss.strength=2",
        ...             "+loss.overrides.lambda_max=500",
        ...         ]
        ...     )
        >>> cfg.loss.method, cfg.loss.strength, cfg.loss.base_loss.num_qvalue_nets
        ('l2c2', 2.0, 2)
    """
    store = ConfigStore.instance()
    store.store(group="loss", name="smooth", node=SmoothLossConfig)
    store.store(group="loss", name="l2c2", node=L2C2LossConfig)
    store.store(group="loss", name="ppo_rpe", node=PPORPELossConfig)
    store.store(group="transform", name="neighbor", node=NeighborTransformConfig)
    store.store(group="transform", name="observation_noise", node=ObservationNoiseConfig)
    store.store(group="optimizer", name="adaterm", node=AdaTermConfig)
    store.store(group="target_net_updater", name="tsoft", node=TSoftUpdateConfig)
    store.store(group="neighborhood", name="l2c2", node=NeighborhoodConfig)
