"""Which settings a run has: as one short code, and as what differs from the defaults."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from torchrl_l2c2.experiment.config import GROUPS, ExperimentConfig, is_free, is_neutral
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.identity import BUDGETS, by_name
from torchrl_l2c2.experiment.tasks import TASKS

# Chosen by name; what else these groups have are settings of what was chosen.
_COMPARED = ("task", "algorithm", "regularizer")


def fingerprint(config: Mapping[str, Any]) -> str:
    """Ten hexadecimal digits that two runs share if, and only if, they may be pooled.

    They stand for every setting but the seed, the logger, the task's name, and those that change
    none of the numbers or only the length of the training. A setting that is off (null, false, or
    as older runs had it) does not count: one that is added later leaves the codes of older runs.

    Args:
        config (Mapping): of :func:`~.saved.read_config`; settings that it lacks have defaults.

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
        config (Mapping): of :func:`~.saved.read_config`.

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
