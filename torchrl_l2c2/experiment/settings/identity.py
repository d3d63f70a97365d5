"""Identity of a run: a hash of its settings, and the settings that differ from the defaults.

The metadata of the settings' fields, ``CHANGES_NO_NUMBERS`` and ``neutral`` of ``fields.py``,
declare which settings count.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.settings.config import GROUPS, ExperimentConfig
from torchrl_l2c2.experiment.settings.tasks import TASKS

NEWER_SETTING = "none (a newer setting)"
# Removed settings with the value that all recorded runs have: a part of their hashes.
REMOVED = {"on_nonfinite": "stop"}
# Length of training: runs of different lengths are of the same kind.
BUDGETS = ("task.episodes", "task.frames")


@cache
def _metadata() -> dict[str, dict[str, Any]]:
    """Returns the metadata of settings by their command-line names."""
    classes = {("", ExperimentConfig)}
    classes |= {(f"{g}.", type(each)) for g, choices in GROUPS.items() for each in choices.values()}
    return {
        f"{prefix}{field.name}": extra
        for prefix, cls in classes
        for field in dataclasses.fields(cls)
        if (extra := getattr(field.default, "json_schema_extra", None))
    }


def may_change(name: str) -> bool:
    """Checks whether a setting may differ between a run and its continuation.

    Args:
        name (str): Name with the group, such as ``"task.solved_at"``.
    """
    return "changes_no_numbers" in _metadata().get(name, {})


def is_neutral(name: str, value: Any) -> bool:
    """Checks whether a run with this value has the numbers of a run without the setting.

    Args:
        name (str): Name with the group, such as ``"regularizer.policy_distance"``.
        value: Value of the setting.
    """
    neutral = _metadata().get(name, {}).get("neutral")
    return value is None or value is False or (neutral is not None and neutral == value)


def flatten_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings by their command-line names, such as ``group.name``.

    Values are converted as by JSON, in which a tuple and a list are the same.

    Args:
        settings (Mapping): Content of ``config.json`` or of a checkpoint, or result of
            ``ExperimentConfig.to_dict()``.
    """
    flat: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(settings)).items():
        flat |= {f"{name}.{k}": v for k, v in value.items()} if name in GROUPS else {name: value}
    return flat


def changed_settings(
    saved: Mapping[str, Any], now: Mapping[str, Any]
) -> dict[str, tuple[Any, Any]]:
    """Returns changed settings, except for settings that change no numbers.

    Args:
        saved (Mapping): Content of ``config.json`` or of a checkpoint.
        now (Mapping): Result of ``ExperimentConfig.to_dict()``.

    Returns:
        dict: The old and the new value by name; names of choices, such as ``task.name``, come
        first.
    """
    before, after = flatten_settings(saved), flatten_settings(now)
    # Names of choices first: they explain the differences in their settings.
    names = sorted(before.keys() | after.keys(), key=lambda n: (not n.endswith(".name"), n))
    pairs = {
        name: (before.get(name, NEWER_SETTING), after.get(name, NEWER_SETTING))
        for name in names
        if not may_change(name)
    }
    return {
        name: (was, is_now)
        for name, (was, is_now) in pairs.items()
        if was != is_now and not (was == NEWER_SETTING and is_neutral(name, is_now))
    }


def length_dependent_settings(config: ExperimentConfig) -> list[str]:
    """Returns the settings whose effect during training depends on the training's length."""
    length_dependent = {
        "optimizer.linear=true": config.optimizer.linear,
        "regularizer.gain=ramp": config.regularizer.ramped,
    }
    return [setting for setting, chosen in length_dependent.items() if chosen]


# Groups whose choices do not depend on other groups.
_COMPARED = ("task", "algorithm", "regularizer")


def fingerprint(config: Mapping[str, Any]) -> str:
    """Returns a hash of ten hexadecimal digits that is equal for runs that may be pooled.

    It ignores the seed, the logger, the task's name, and settings that change no numbers or only
    the length of training. It also ignores settings that are off (null, false, or the neutral
    value), so a new setting does not change the hashes of older runs.

    Args:
        config (Mapping): Content of ``config.json``. Missing settings have their defaults.

    Raises:
        SettingError: If a setting is unknown.
    """
    own = flatten_settings(ExperimentConfig.from_dict(config).to_dict())
    compared = {
        name: value
        for name, value in own.items()
        if _counts(name) and name != "task.name" and not is_neutral(name, value)
    }
    compared |= REMOVED
    return hashlib.sha256(json.dumps(compared, sort_keys=True).encode()).hexdigest()[:10]


def differences(config: Mapping[str, Any]) -> dict[str, str]:
    """Returns the settings that differ from the defaults of the run's choices.

    Args:
        config (Mapping): Content of ``config.json``.

    Returns:
        dict: Values by name, sorted, such as ``{"algorithm.replay_ratio": "10",
        "task.episodes": "400"}``. Settings that change no numbers are left out.

    Raises:
        SettingError: If a setting is unknown.

    Examples:
        >>> config = ExperimentConfig().to_dict()
        >>> config["regularizer"]["beta"] = 0.5
        >>> differences(config)
        {'regularizer.beta': '0.5'}
    """
    own = flatten_settings(ExperimentConfig.from_dict(config).to_dict())
    defaults = flatten_settings(ExperimentConfig.from_dict(_names(config, _COMPARED)).to_dict())
    chosen = flatten_settings(ExperimentConfig.from_dict(_names(config, GROUPS)).to_dict())
    return {
        name: _word(value)
        for name, value in sorted(own.items())
        if (_counts(name) or name in BUDGETS)
        and value != (defaults if name.endswith(".name") else chosen)[name]
    }


def write_differences(values: Mapping[str, str]) -> str:
    """Returns the differences as one line, such as ``a=1 b=2``."""
    return " ".join(f"{name}={value}" for name, value in values.items())


def read_differences(line: str) -> dict[str, str]:
    """Parses a line of :func:`write_differences`.

    Raises:
        UserError: If a word has no ``=``.
    """
    pairs = [word.partition("=") for word in line.split()]
    if cut := [name for name, equals, _ in pairs if not equals]:
        raise UserError(f"differences must be words such as a=1, got {cut[0]!r}")
    return {name: value for name, _, value in pairs}


def _names(config: Mapping[str, Any], groups: Any) -> dict[str, Any]:
    named = {group: {"name": config[group]["name"]} for group in groups if group in config}
    if (name := named["task"]["name"]) not in TASKS:  # task=gymnasium names a task by its env_id.
        named["task"]["env_id"] = name
    return named


def _counts(name: str) -> bool:
    return name != "seed" and not may_change(name)


def _word(value: Any) -> str:
    """Formats a value without spaces: as JSON, except for plain words and whole floats."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, str) and value.replace("_", "").isalnum():
        return value
    return json.dumps(value, separators=(",", ":")).replace(" ", "\\u0020")
