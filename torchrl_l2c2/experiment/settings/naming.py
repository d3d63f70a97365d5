"""Names of run folders: task, algorithm, regularizer, and settings that are not the defaults.

Names are taken as they are by shells, Hydra's command line and every file system, and are the same
for single runs and sweeps. The whole of the settings is in the folder's ``config.json``.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

from torchrl_l2c2.experiment.settings.config import GROUPS, ExperimentConfig
from torchrl_l2c2.experiment.settings.identity import is_free
from torchrl_l2c2.experiment.settings.regularizers import preset_settings
from torchrl_l2c2.experiment.settings.tasks import TaskConfig

LONGEST = 64


def run_name(config: ExperimentConfig) -> str:
    """The path of a run's folder below ``outputs``.

    Args:
        config (ExperimentConfig): The run's settings.

    Returns:
        str: ``task/algorithm/regularizer/setting-value_setting-value/seed_0``, of letters, digits
        and ``.+-_`` only. The fourth part is missing if every setting has its default. A long part
        is cut and ends with a hash; the regularizer's settings then come first.

    Examples:
        >>> from torchrl_l2c2.experiment import ExperimentConfig, L2C2Config
        >>> run_name(ExperimentConfig(regularizer=L2C2Config(beta=0.2, sigma=2.0), seed=3))
        'swingup/ppo_rpe/l2c2/sigma-2.0_beta-0.2/seed_3'
    """
    chosen = [getattr(config, group).name for group in ("task", "algorithm", "regularizer")]
    parts = [*map(plain, chosen), *_settings_part(config), f"seed_{config.seed}"]
    return str(PurePosixPath(*map(_short, parts)))


def _settings_part(config: ExperimentConfig) -> list[str]:
    unusual = list(_unusual(config))
    if sum(len(_written(*each[1:])) + 1 for each in unusual) > LONGEST + 1:
        # Keep the settings that runs are compared by.
        unusual.sort(key=lambda each: each[0] != "regularizer")
    return ["_".join(_written(*each[1:]) for each in unusual)] if unusual else []


def _unusual(config: ExperimentConfig) -> Iterator[tuple[str, str, Any]]:
    """Settings that change a run's numbers and differ from its choices, with their groups."""
    usual_names = {
        "replay": config.algorithm.usual_replay,
        "optimizer": config.algorithm.usual_optimizer,
    }
    names = Counter(name for group in GROUPS for name in vars(getattr(config, group)))
    for group in sorted(GROUPS):
        chosen = getattr(config, group)
        if chosen.name != usual_names.get(group, chosen.name):
            yield group, group, chosen.name
        usual = _usual(group, chosen, config.algorithm.name)
        for name, value in vars(chosen).items():
            free = name == "name" or is_free(f"{group}.{name}")
            if not free and value != getattr(usual, name):
                alone = group == "regularizer" or names[name] == 1
                yield group, name if alone else f"{group}.{name}", value
    usual, followed = ExperimentConfig(), getattr(config.regularizer, "gain_of", None)
    for name in sorted(vars(config).keys() - GROUPS.keys() - {"seed"}):
        if not is_free(name, followed) and getattr(config, name) != getattr(usual, name):
            yield "", name, getattr(config, name)


def _usual(group: str, chosen: Any, algorithm: str) -> Any:
    """The settings of ``group=name``: a regularizer's preset for the algorithm, a task's own id."""
    if group == "task" and chosen.name not in GROUPS[group]:
        return TaskConfig(chosen.name, chosen.name)
    usual = GROUPS[group][chosen.name]
    if group == "regularizer":
        return replace(usual, **preset_settings(chosen.name, algorithm))
    return usual


def _written(name: str, value: Any) -> str:
    return f"{plain(name)}-{plain(value)}"


def plain(value: Any) -> str:
    """A value in characters that file names take."""
    if isinstance(value, tuple):
        return "x".join(map(plain, value))
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return re.sub(r"[^A-Za-z0-9.+_-]+", "-", str(value)).rstrip(".")


def _short(part: str) -> str:
    if len(part) <= LONGEST:
        return part
    return f"{part[: LONGEST - 9]}_{hashlib.sha256(part.encode()).hexdigest()[:8]}"
