"""Folders of runs below a path, and different names for them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from itertools import compress
from pathlib import Path

from torchrl_l2c2.experiment.analysis.reports.names import method_name, name_with_settings
from torchrl_l2c2.experiment.analysis.reports.records import walk_runs
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import read_config
from torchrl_l2c2.experiment.settings.identity import differences


def run_folders(folders: Iterable[str]) -> list[str]:
    """Finds the runs at or below folders, baselines first; a folder without runs stays.

    A diagnosis compares the first run with the others.
    """
    below = [sorted(walk_runs([folder]), key=_place) or [Path(folder)] for folder in folders]
    return [str(run) for runs in below for run in runs]


def _place(folder: Path) -> tuple[bool, Path]:
    """Sort key of runs below the same folder."""
    described = _description(folder)
    return described is None or described[2] != method_name("none"), folder


def run_names(folders: Sequence[str]) -> list[str]:
    """Names runs by the differences of their settings, or else by their folders.

    Examples:
        >>> run_names(["outputs/none/seed_0", "outputs/caps/seed_0"])
        ['none/seed_0', 'caps/seed_0']
        >>> run_names(["outputs/none/seed_0"])
        ['seed_0']
    """
    paths = [str(Path(folder).resolve()) for folder in folders]
    if len(set(paths)) < len(paths):
        raise UserError("Expected each run once, got a run twice. Name each run once.")
    described = [_description(Path(path)) for path in paths]
    if None not in described and len(set(described)) == len(paths) > 1:
        differing = [len(set(each)) > 1 for each in zip(*filter(None, described), strict=True)]
        return ["/".join(compress(each, differing)) for each in filter(None, described)]
    common = os.path.commonpath([os.path.dirname(path) for path in paths])
    return [os.path.relpath(path, common) for path in paths]


def _description(folder: Path) -> tuple[str, ...] | None:
    """Task, algorithm, method and seed; ``None`` if the folder has no settings."""
    try:
        config = read_config(folder)
        groups = ("task", "algorithm", "regularizer")
        task, algorithm, method = (config[group]["name"] for group in groups)
        name, _ = name_with_settings(method, differences(config))
    except (OSError, ValueError, KeyError):
        return None
    return task, algorithm, name, f"seed_{config['seed']}"
