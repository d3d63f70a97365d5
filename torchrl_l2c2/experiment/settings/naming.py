"""Names of run folders, from the task, the algorithm, the regularizer and changed settings.

Names need no quoting in shells, on Hydra's command line or in any file system. Single runs and
sweeps use the same names. The folder's ``config.json`` contains all settings.
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
from torchrl_l2c2.experiment.settings.identity import may_change
from torchrl_l2c2.experiment.settings.regularizers import preset_settings
from torchrl_l2c2.experiment.settings.tasks import TaskConfig

MAX_PART_LENGTH = 64


def run_name(
    config: ExperimentConfig, preset: str | None = None, defaults: ExperimentConfig | None = None
) -> str:
    """Returns the path of a run's folder below ``outputs``.

    Args:
        config (ExperimentConfig): The run's settings.
        preset (str, optional): Name of the preset.
        defaults (ExperimentConfig, optional): Settings of the preset, without which the settings
            are compared with the defaults of each choice.

    Returns:
        str: ``task/algorithm/regularizer/preset_setting-value_setting-value/seed_0`` of letters,
        digits and ``.+-_``. The fourth part is left out without a preset if every setting has its
        default. A part longer than 64 characters is cut and ends with a hash; the regularizer's
        settings then come first.

    Examples:
        >>> from torchrl_l2c2.experiment import ExperimentConfig, L2C2Config
        >>> run_name(ExperimentConfig(regularizer=L2C2Config(beta=0.2, sigma=2.0), seed=3))
        'swingup/ppo_rpe/l2c2/sigma-2.0_beta-0.2/seed_3'
    """
    chosen = [getattr(config, group).name for group in ("task", "algorithm", "regularizer")]
    changed = list(_changed_settings(config, defaults))
    if sum(len(_written(*each[1:])) + 1 for each in changed) > MAX_PART_LENGTH + 1:
        # Comparisons vary the regularizer's settings most often: keep these.
        changed.sort(key=lambda each: each[0] != "regularizer")
    settings = [*([plain(preset)] if preset else []), *(_written(*each[1:]) for each in changed)]
    parts = [*map(plain, chosen), "_".join(settings), f"seed_{config.seed}"]
    return str(PurePosixPath(*map(_short, parts)))


def _changed_settings(
    config: ExperimentConfig, of_preset: ExperimentConfig | None
) -> Iterator[tuple[str, str, Any]]:
    """Yields group, name and value of each setting that differs from the defaults."""
    default_names = {
        "replay": config.algorithm.default_replay,
        "optimizer": config.algorithm.default_optimizer,
    }
    names = Counter(name for group in GROUPS for name in vars(getattr(config, group)))
    for group in sorted(GROUPS):
        chosen = getattr(config, group)
        if chosen.name != default_names.get(group, chosen.name):
            yield group, group, chosen.name
        defaults = getattr(of_preset, group, None)
        if defaults is None or defaults.name != chosen.name:
            defaults = _defaults_of_choice(group, chosen, config.algorithm.name)
        for name, value in vars(chosen).items():
            ignored = name == "name" or may_change(f"{group}.{name}")
            if not ignored and value != getattr(defaults, name):
                unique = group == "regularizer" or names[name] == 1
                yield group, name if unique else f"{group}.{name}", value
    default = of_preset or ExperimentConfig()
    for name in sorted(vars(config).keys() - GROUPS.keys() - {"seed"}):
        if not may_change(name) and getattr(config, name) != getattr(default, name):
            yield "", name, getattr(config, name)


def _defaults_of_choice(group: str, chosen: Any, algorithm: str) -> Any:
    """Returns the settings of ``group=name``, with the regularizer's preset for the algorithm."""
    if group == "task" and chosen.name not in GROUPS[group]:
        return TaskConfig(chosen.name, chosen.name)
    defaults = GROUPS[group][chosen.name]
    if group == "regularizer":
        return replace(defaults, **preset_settings(chosen.name, algorithm))
    return defaults


def _written(name: str, value: Any) -> str:
    return f"{plain(name)}-{plain(value)}"


def plain(value: Any) -> str:
    """Formats a value for a file name."""
    if isinstance(value, tuple):
        return "x".join(map(plain, value))
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    return re.sub(r"[^A-Za-z0-9.+_-]+", "-", str(value)).rstrip(".")


def unique(text: str) -> str:
    """Formats a text for a file name of at most 64 characters, a different one for each text."""
    written = plain(text)
    return _hashed(written, text) if written != text else _short(text)


def _short(part: str) -> str:
    return part if len(part) <= MAX_PART_LENGTH else _hashed(part, part)


def _hashed(written: str, text: str) -> str:
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    return f"{written[: MAX_PART_LENGTH - 9]}_{digest}"
