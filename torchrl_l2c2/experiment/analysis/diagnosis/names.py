"""Folders of runs below a path, and names that tell the runs apart."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import compress
from pathlib import Path

from torchrl_l2c2.experiment.analysis.reports.names import method_name, name_with_settings
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import read_config
from torchrl_l2c2.experiment.settings.identity import differences


def run_folders(folders: Iterable[str]) -> list[str]:
    """Finds the runs at or below folders; a folder without any stays."""
    below = [sorted(Path(folder).rglob("config.json")) or [Path(folder, "_")] for folder in folders]
    return [str(path.parent) for paths in below for path in paths]


def run_names(folders: Sequence[str]) -> list[str]:
    """Names runs by what tells them apart: task, algorithm, method, seed, or the folders' paths.

    Examples:
        >>> run_names(["a/sac/none/seed_0", "a/sac/caps/seed_0"])
        ['baseline', 'CAPS']
        >>> run_names(["a/sac/none/seed_0", "a/td3/none/seed_0", "b/sac/caps/seed_0"])
        ['sac/baseline', 'td3/baseline', 'sac/CAPS']
        >>> run_names(["/a/sac/none/seed_0"])
        ['sac/baseline/seed_0']
    """
    paths = [Path(folder).resolve().parts for folder in folders]
    if len(set(paths)) < len(paths):
        raise UserError("A run is named twice. Name each run once.")
    paths = [tuple(map(method_name, path)) for path in paths]
    told = [each for each in map(_by_settings, map(Path, folders)) if each is not None]
    # Settings that no method's name tells are in the folders' own.
    if len(set(told)) == len(folders) > 1:
        differing = [len(set(each)) > 1 for each in zip(*told, strict=True)]
        return ["/".join(compress(each, differing)) for each in told]
    if len(paths) == 1:
        return ["/".join(paths[0][-3:])]
    longest = max(map(len, paths))
    length = next(n for n in range(1, longest + 1) if len({p[-n:] for p in paths}) == len(paths))
    ends = [path[-length:] for path in paths]
    while len({end[-1] for end in ends}) == 1:
        ends = [end[:-1] for end in ends]
    return ["/".join(end) for end in ends]


def _by_settings(folder: Path) -> tuple[str, ...] | None:
    """Task, algorithm, method and seed; ``None`` of a folder without settings."""
    try:
        config = read_config(folder)
        groups = ("task", "algorithm", "regularizer")
        task, algorithm, method = (config[group]["name"] for group in groups)
        name, _ = name_with_settings(method, differences(config))
    except (OSError, ValueError, KeyError):
        return None
    return task, algorithm, name, f"seed_{config['seed']}"
