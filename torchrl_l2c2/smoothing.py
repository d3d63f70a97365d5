"""The main entry point: :func:`smooth` adds a regularizer to a loss, with a preset."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from torchrl.objectives import LossModule, TD3BCLoss

from torchrl_l2c2 import objectives
from torchrl_l2c2._checks import as_number, check_bool, check_real, describe_no_loss
from torchrl_l2c2._warnings import warn
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import RegularizedLoss
from torchrl_l2c2.objectives._batch import check_evaluates_states
from torchrl_l2c2.objectives._networks import IMITATING, POLICY_NETWORK, VALUE_NETWORKS
from torchrl_l2c2.presets import (
    GAIN_SETTING,
    KINDS,
    METHODS,
    NEIGHBORHOOD_FIELDS,
    Preset,
    kind_of,
    mixed_units,
    preset,
)


def smooth(
    loss: LossModule,
    method: str = "l2c2",
    strength: float = 1.0,
    fold: bool = True,
    **overrides: Any,
) -> RegularizedLoss:
    """Adds a smoothness regularizer to a loss, with the preset for its class.

    The result is a loss of the same class with the same parameters. Train it as before: the penalty
    is added to ``loss_actor`` or ``loss_objective``, and a value function's to its loss, so loops
    that sum terms by name, or all ``loss_*`` keys, need no change. (CQL has two terms of the
    policy, each with the penalty: a loop minimizes one at a time.) The penalty is reported as
    ``penalty_*``.

    The presets are in ``torchrl_l2c2.presets.PRESETS``. The gain of ``"l2c2"`` and ``"cats"`` with
    PPO and SAC rises with the progress of training: call
    ``loss.set_progress(frames / total_frames)`` before the updates on every batch that was
    collected. Without this call the gain stays at its final value. With TD3 the penalty of both is
    relative to the size of the action values (:meth:`RegularizedLoss.relative`).

    Args:
        loss (LossModule): a loss with a policy that is trained on transitions.
        method (str): the regularizer: ``"l2c2"``, ``"caps"``, ``"cats"``, ``"grad_caps"``,
            ``"asap"``, ``"lcp"`` or ``"sr2l"``. ``grad_caps`` and ``asap`` need the observation
            before each state in the batch, and a policy that is not recurrent. Defaults to
            ``"l2c2"``.
        strength (float): factor of the penalty, at least 0. Larger values smooth more; too large
            values lower the return. 0 leaves the loss's values and gradients unchanged, if the
            penalty is finite. Defaults to ``1.0``, the preset.
        fold (bool): whether to add the penalty to the loss's own terms. ``False`` returns separate
            ``loss_*`` terms, for loops that weigh or log them; the loss's own terms are then
            unchanged, bit for bit. Defaults to ``True``.
        **overrides: settings that replace the preset: keyword arguments of the regularizer's
            class, fields of its :class:`~torchrl_l2c2.Neighborhood`, ``ramp``, the share of
            training over which the gain rises, or ``None`` for a constant gain, and ``relative``,
            whether the penalty is relative to the size of the action values
            (:meth:`RegularizedLoss.relative`).

    Returns:
        RegularizedLoss: an instance of the regularizer and of the loss's class.

    Raises:
        TypeError: the loss cannot be regularized, is already regularized, or has no preset and no
            gain is given; or an override is not a setting of the method.
        ValueError: the method is unknown, or a value is out of its range.

    Warns:
        UserWarning: the preset was tuned with a similar loss, or was not tuned; the gain probably
            does not suit ``relative``; or ``neighborhood`` has other neighbors than the preset.

    Examples:
        >>> import torch
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import TD3Loss
        >>> from torchrl_l2c2 import smooth
        >>> qvalue = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = smooth(TD3Loss(Actor(torch.nn.Linear(3, 1)), qvalue, bounds=(-1, 1)))
        >>> isinstance(loss, TD3Loss), loss.regularizer_gain.item()
        (True, 1.0)
        >>> [key for key in loss.out_keys if key.startswith(("loss_", "penalty_"))]
        ['loss_actor', 'loss_qvalue', 'penalty_l2c2_actor']
    """
    if not isinstance(loss, LossModule):
        raise TypeError(f"Expected a torchrl.objectives.LossModule, got {describe_no_loss(loss)}.")
    if isinstance(loss, RegularizedLoss):
        raise TypeError(
            f"Expected a loss without a regularizer, got a {type(loss).__name__}. Call smooth once "
            "with overrides, or combine the classes: CATSLoss(L2C2Loss(loss, ...), ...)."
        )
    if not isinstance(method, str) or method not in METHODS:
        hint = f" For a strength: strength={method!r}." if isinstance(method, int | float) else ""
        if isinstance(method, str) and (near := get_close_matches(method.lower(), METHODS, 1)):
            hint = f" Did you mean {near[0]!r}?"
        raise ValueError(f"Expected method to be one of {list(METHODS)}, got {method!r}.{hint}")
    strength = as_number("strength", strength)
    check_real("strength", strength, at_least=0)
    check_bool("fold", fold)
    if overrides.get("ramp") is not None:
        check_real("ramp", overrides["ramp"], above=0, at_most=1, hint="None: no ramp.")
    if "relative" in overrides:
        check_bool("relative", overrides["relative"])
    check_evaluates_states(loss)
    chosen, doubts = _chosen(loss, method, overrides)
    make = getattr(objectives, METHODS[method])
    arguments = _arguments(method, make, chosen.settings)
    with warnings.catch_warnings():
        if chosen.relative:  # The size of such a gain says nothing.
            warnings.filterwarnings("ignore", "gains up to .* had no measurable effect")
        regularized = make(loss, **arguments)
    for doubt in doubts:  # After the errors.
        warn(doubt)
    if chosen.ramp is not None:
        regularized.ramp(chosen.ramp)
    regularized.strength = strength
    if chosen.relative:
        regularized.relative()
    return regularized.fold() if fold else regularized


def _chosen(
    loss: LossModule, method: str, overrides: Mapping[str, Any]
) -> tuple[Preset, list[str]]:
    """The preset of a loss with overrides, and warnings if it probably does not suit the loss."""
    name = type(loss).__name__
    kind, exact = kind_of(type(loss))
    if kind is None:
        return _of_nearest(loss, method, overrides)
    chosen = preset(method, kind)
    found_with = KINDS[kind][0][0]
    doubts = []
    if chosen.evidence is None and GAIN_SETTING[method] not in overrides:
        doubts.append(
            f"{method} takes settings that were not tuned, {_shown(chosen.shown)}: there are no "
            f"recorded runs of it with losses like {found_with}."
        )
    elif not exact and chosen.evidence is not None:
        doubts.append(
            f"{name} takes the preset of {found_with}, the nearest: it was found with that on "
            f"{chosen.tasks}, and not tried with {name}."
        )
    return chosen.overridden(overrides), doubts + _mismatches(method, chosen, overrides)


def _mismatches(method: str, chosen: Preset, overrides: Mapping[str, Any]) -> list[str]:
    """Warnings of a neighborhood or a gain that probably does not suit the preset."""
    name, near = GAIN_SETTING[method], overrides.get("neighborhood")
    kind = getattr(near, "neighbors", None)
    usual = chosen.settings.get("neighbors", kind)
    doubts = []
    if kind is not None and kind != usual:
        doubts.append(
            f"neighbors={kind!r} of the neighborhood replaces the preset's {usual!r}, and changes "
            f"the mean gain: give the fields, such as lambda_min=..., or neighbors={usual!r}."
        )
    for setting in ("policy_distance", "neighbors"):
        usual, given = chosen.settings.get(setting), overrides.get(setting)
        differs = usual is not None and given is not None and given != usual
        if differs and not overrides.keys() & {name, "neighborhood"}:
            doubts.append(
                f"{setting}={given!r} is taken with the preset's {name}={chosen.settings[name]!r}, "
                f"which was found with {usual!r}: give {name}, too."
            )
    gain = overrides.get(name, getattr(near, name, chosen.settings[name]))
    relative = overrides.get("relative", chosen.relative)
    given = {"relative", name} <= overrides.keys() or not isinstance(gain, int | float)
    if not given and (mixed := mixed_units(method, chosen, gain, relative)):
        doubts.append(f"{mixed}: give both {name} and relative.")
    return doubts


def _of_nearest(
    loss: LossModule, method: str, overrides: Mapping[str, Any]
) -> tuple[Preset, list[str]]:
    """The settings of a loss without a preset: the gain is given, others are the nearest preset's.

    Raises:
        TypeError: no gain is given, or the loss has nothing that the method can smooth.
    """
    name = type(loss).__name__
    without = "" if getattr(loss, POLICY_NETWORK, None) is not None else f" and no {POLICY_NETWORK}"
    if all(getattr(loss, network, None) is None for network in (POLICY_NETWORK, *VALUE_NETWORKS)):
        raise TypeError(
            f"smooth finds nothing to regularize: {name} has no {POLICY_NETWORK}, and no value "
            f"function among {', '.join(VALUE_NETWORKS)}."
        )
    if without and method != "l2c2":
        raise TypeError(
            f"{method} needs a policy: {name} has none. 'l2c2' smooths value functions, too."
        )
    kind = _nearest_kind(loss)
    nearest = preset(method, kind)
    settings = nearest.shown
    found_with = KINDS[kind][0][0]
    if GAIN_SETTING[method] not in overrides and "neighborhood" not in overrides:
        raise TypeError(
            f"{name} has no preset{without}. The nearest is the preset of {found_with}; to use it, "
            f"pass its settings: smooth(loss, {method!r}, {_shown(settings)})."
        )
    chosen = nearest.overridden(overrides)
    kept = chosen.settings.keys() | {"ramp", "relative"}
    taken = {k: v for k, v in settings.items() if k in kept and k not in overrides}
    doubt = (
        f"{name} has no preset: settings that are not given come from the preset of "
        f"{found_with}, the nearest: {_shown(taken)}."
    )
    return chosen, [doubt] if taken else []


def _nearest_kind(loss: LossModule) -> str:
    if getattr(loss, POLICY_NETWORK, None) is None:
        return "ppo_rpe"  # The only preset that smooths values.
    if isinstance(loss, TD3BCLoss):
        return "td3"
    if isinstance(loss, IMITATING):
        return "ppo"  # Its policy term does not grow with the action values.
    if getattr(loss, "qvalue_network", None) is not None:
        return "sac"
    value = getattr(loss, "value_network", None)  # DDPG's has this name.
    return "td3" if "action" in getattr(value, "in_keys", ()) else "ppo"


def _shown(settings: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in settings.items())


def _arguments(method: str, make: type, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a regularizer's class; fields of a neighborhood become a neighborhood."""
    arguments = dict(settings)
    known = list(inspect.signature(make).parameters)
    known.remove("base_loss")
    fields = {}
    if "neighborhood" in known:
        fields = {name: arguments.pop(name) for name in NEIGHBORHOOD_FIELDS & arguments.keys()}
        known += sorted(NEIGHBORHOOD_FIELDS)
    unknown = sorted(arguments.keys() - set(known))
    if unknown:
        known += ["ramp", "relative", "method", "strength", "fold"]
        near = get_close_matches(unknown[0], known, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise TypeError(f"Expected settings of {method}, {known}, got {unknown}.{hint}")
    if "neighborhood" not in arguments and fields:
        arguments["neighborhood"] = Neighborhood(**fields)
    return arguments
