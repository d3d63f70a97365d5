"""Which run a run is: the settings that tell it from others, and those that do not."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.config import GROUPS, ExperimentConfig, is_free, is_neutral
from torchrl_l2c2.experiment.saved import as_it_was, read_back, read_config

NOT_THEN = "none, as it is a setting since"
# How long a training is; a longer one is of the same kind.
BUDGETS = ("task.episodes", "task.frames")


def by_name(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by the names of the command line, those of groups as ``group.name``.

    As JSON has them, where a tuple and a list are the same.

    Args:
        settings (Mapping): of ``config.json``, of a checkpoint, or ``ExperimentConfig.to_dict()``.
    """
    flat: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(settings)).items():
        flat |= {f"{name}.{k}": v for k, v in value.items()} if name in GROUPS else {name: value}
    return flat


def differing(saved: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """The settings that decide a run's numbers, and are others now than they were then.

    Args:
        saved (Mapping): of ``config.json`` or of a checkpoint.
        now (Mapping): of ``ExperimentConfig.to_dict()``.

    Returns:
        dict: by their names, what is chosen by name first, the value then and the one now.
    """
    before, after = by_name(as_it_was(saved)), by_name(now)
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


def is_tested(run: str | Path, settings: Mapping[str, Any]) -> bool:
    """Whether a folder has the test of a run with these settings.

    Settings that change none of the numbers may differ, but for how long the training is.

    Raises:
        ValueError: as :func:`read_config` and :func:`read_back`.
    """
    if not (Path(run) / "evaluation.json").exists():
        return False
    with read_back(run):
        saved = read_config(run)
        before, after = ([by_name(s).get(name) for name in BUDGETS] for s in (saved, settings))
        return before == after and not differing(saved, settings)
