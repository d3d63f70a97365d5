"""Identity of a run: a short code, and the settings that differ from the defaults.

The fields of the settings say it: their metadata are :data:`~.fields.CHANGES_NO_NUMBERS` and
:func:`~.fields.neutral`.
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

NOT_THEN = "none, as it is a setting since"
# How long a training is; a longer one is of the same kind.
BUDGETS = ("task.episodes", "task.frames")


@cache
def _metadata() -> dict[str, dict[str, Any]]:
    """The metadata of the settings that have any, by the names of the command line."""
    classes = {("", ExperimentConfig)}
    classes |= {(f"{g}.", type(each)) for g, choices in GROUPS.items() for each in choices.values()}
    return {
        f"{prefix}{field.name}": extra
        for prefix, cls in classes
        for field in dataclasses.fields(cls)
        if (extra := getattr(field.default, "json_schema_extra", None))
    }


def is_free(name: str, gain_of: str | None = None) -> bool:
    """Checks whether a setting may differ between a run and its continuation.

    Args:
        name (str): name with the group, such as ``"task.solved_at"``.
        gain_of (str, optional): the regularizer's ``gain_of``: what a gain follows is part of the
            training.
    """
    if name == "late_share" and str(gain_of).startswith("test_"):
        return False
    return "changes_no_numbers" in _metadata().get(name, {})


def is_neutral(name: str, value: Any) -> bool:
    """Checks whether a run with this value has the numbers of a run without the setting.

    Args:
        name (str): name with the group, such as ``"regularizer.policy_distance"``.
        value: value of the setting.
    """
    neutral = _metadata().get(name, {}).get("neutral")
    return value is None or value is False or (neutral is not None and neutral == value)


def by_name(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by the names of the command line; settings of groups as ``group.name``.

    As JSON has them, where a tuple and a list are the same.

    Args:
        settings (Mapping): Content of ``config.json`` or of a checkpoint, or result of
            ``ExperimentConfig.to_dict()``.
    """
    flat: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(settings)).items():
        flat |= {f"{name}.{k}": v for k, v in value.items()} if name in GROUPS else {name: value}
    return flat


def differing(saved: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Settings that change a run's numbers and have changed.

    Args:
        saved (Mapping): Content of ``config.json`` or of a checkpoint.
        now (Mapping): Result of ``ExperimentConfig.to_dict()``.

    Returns:
        dict: The old and the new value by name; choices of a group first.
    """
    before, after = by_name(saved), by_name(now)
    # The settings of another choice are others anyway.
    names = sorted(before.keys() | after.keys(), key=lambda n: (not n.endswith(".name"), n))
    followed = after.get("regularizer.gain_of")
    pairs = {
        name: (before.get(name, NOT_THEN), after.get(name, NOT_THEN))
        for name in names
        if not is_free(name, followed)
    }
    return {
        name: (was, is_now)
        for name, (was, is_now) in pairs.items()
        if was != is_now and not (was == NOT_THEN and is_neutral(name, is_now))
    }


def of_length(config: ExperimentConfig) -> list[str]:
    """The settings by which a longer training begins otherwise than a shorter one."""
    gain_of = str(getattr(config.regularizer, "gain_of", None))
    going = {
        f"regularizer.gain_of={gain_of}": gain_of.startswith("test_"),
        "optimizer.linear=true": config.optimizer.linear,
        "regularizer.gain=ramp": config.regularizer.ramped,
    }
    return [setting for setting, chosen in going.items() if chosen]


# Groups that are chosen by name; their other fields are settings of the choice.
_COMPARED = ("task", "algorithm", "regularizer")


def fingerprint(config: Mapping[str, Any]) -> str:
    """Ten hexadecimal digits that two runs share if, and only if, they may be pooled.

    The seed, the logger and the task's name do not count. Neither do settings that change none of
    the numbers, or only the length of the training. A setting that is off (null, false, or the
    value of older runs) does not count either: a new setting keeps the codes of older runs.

    Args:
        config (Mapping): Content of ``config.json``; missing settings have their defaults.

    Raises:
        SettingError: a setting that is not known.
    """
    own = by_name(ExperimentConfig.from_dict(config).to_dict())
    compared = {
        name: value
        for name, value in own.items()
        if _counts(name, own) and name != "task.name" and not is_neutral(name, value)
    }
    return hashlib.sha256(json.dumps(compared, sort_keys=True).encode()).hexdigest()[:10]


def differences(config: Mapping[str, Any]) -> dict[str, str]:
    """The settings that differ from the defaults of what the run's names choose.

    Args:
        config (Mapping): Content of ``config.json``.

    Returns:
        dict: such as ``{"algorithm.replay_ratio": "10", "task.episodes": "400"}``, sorted; without
        the settings that change none of the numbers.

    Raises:
        SettingError: a setting that is not known.

    Examples:
        >>> config = ExperimentConfig().to_dict()
        >>> config["regularizer"]["beta"] = 0.5
        >>> differences(config)
        {'regularizer.beta': '0.5'}
    """
    own = by_name(ExperimentConfig.from_dict(config).to_dict())
    usual = by_name(ExperimentConfig.from_dict(_names(config, _COMPARED)).to_dict())
    chosen = by_name(ExperimentConfig.from_dict(_names(config, GROUPS)).to_dict())
    return {
        name: _word(value)
        for name, value in sorted(own.items())
        if (_counts(name, own) or name in BUDGETS)
        and value != (usual if name.endswith(".name") else chosen)[name]
    }


def write_differences(values: Mapping[str, str]) -> str:
    """One line of what differs: ``a=1 b=2``."""
    return " ".join(f"{name}={value}" for name, value in values.items())


def read_differences(line: str) -> dict[str, str]:
    """Reads :func:`write_differences` back.

    Raises:
        UserError: a word that is no setting with its value.
    """
    pairs = [word.partition("=") for word in line.split()]
    if cut := [name for name, equals, _ in pairs if not equals]:
        raise UserError(f"differences must be words such as a=1, got {cut[0]!r}")
    return {name: value for name, _, value in pairs}


def _names(config: Mapping[str, Any], groups: Any) -> dict[str, Any]:
    named = {group: {"name": config[group]["name"]} for group in groups if group in config}
    if named["task"]["name"] not in TASKS:  # A task of one's own is what its id says.
        named["task"]["env_id"] = config["task"]["env_id"]
    return named


def _counts(name: str, settings: Mapping[str, Any]) -> bool:
    return name != "seed" and not is_free(name, settings.get("regularizer.gain_of"))


def _word(value: Any) -> str:
    """A value without a space in it: as JSON, but for plain words and whole floats."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, str) and value.replace("_", "").isalnum():
        return value
    return json.dumps(value, separators=(",", ":")).replace(" ", "\\u0020")
