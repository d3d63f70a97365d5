"""Groups of runs that differ only in their seeds, and the names of groups in tables."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from torchrl_l2c2.experiment.analysis.reports.names import (
    DISTANCES,
    NAMES,
    method_name,
    name_with_settings,
)
from torchrl_l2c2.experiment.analysis.reports.records import KIND, merge, other_settings
from torchrl_l2c2.experiment.analysis.reports.statistics import Scores
from torchrl_l2c2.experiment.settings.identity import read_differences


@dataclass(frozen=True, eq=False)
class Group:
    """Runs with the same settings and length, one for each seed.

    Attributes:
        runs: the records of the runs, by seed.
        name: the method, and the settings that other groups of the task and algorithm have
            differently, such as ``"L2C2, beta=0.5"``.
    """

    runs: pd.DataFrame
    name: str

    @cached_property
    def first(self) -> Any:
        """The record of the first seed, for the columns that all runs share."""
        return self.runs.iloc[0]

    @property
    def kind(self) -> tuple[str, ...]:
        """The identity of the runs without their seed."""
        return tuple(self.first[name] for name in KIND)

    @property
    def seeds(self) -> list[int]:
        """The seeds of the runs."""
        return list(self.runs["seed"])

    @cached_property
    def settings(self) -> dict[str, str]:
        """The settings that differ from the defaults, except for the training's length."""
        return other_settings(self.first)

    @property
    def setup(self) -> tuple[Any, ...]:
        """Every setting but the regularizer's: compared groups have the same setup."""
        others = [pair for pair in self.settings.items() if not _is_own(pair[0])]
        return (self.first.task, self.first.algorithm, self.first.length, *sorted(others))

    def by_seed(self, test: str, quantity: str) -> dict[int, float]:
        """A quantity by seed, of the runs that have it.

        Args:
            test (str): One of ``TESTS``, such as ``"late_mean"``.
            quantity (str): ``"return"``, ``"action_variation"``, ``"sm_asap"`` (only of
                ``"last_mean"``), or ``"policy_scale"`` (of the late policies, for any test).
        """
        column = quantity if quantity == "policy_scale" else f"{test}_{quantity}"
        if column not in self.runs:
            return {}
        pairs = zip(self.seeds, self.runs[column], strict=True)
        return {seed: value for seed, value in pairs if not math.isnan(value)}

    def scores(self, test: str, quantity: str) -> Scores:
        """The values of :meth:`by_seed` as a matrix ``[runs, 1]``."""
        return np.array(list(self.by_seed(test, quantity).values())).reshape(-1, 1)


def group_records(records: pd.DataFrame) -> list[Group]:
    """Groups records by every setting but the seed, in the order of tables."""
    kinds = merge(records).groupby(KIND, sort=False)
    groups = [Group(runs, "") for _, runs in kinds]
    return [named for together in by_task(groups) for named in _named(together)]


def by_task(groups: Iterable[Group]) -> list[list[Group]]:
    """Groups of the same task and algorithm together, in the order of their first group."""
    together: dict[tuple[str, str], list[Group]] = defaultdict(list)
    for group in groups:
        together[group.first.task, group.first.algorithm].append(group)
    return list(together.values())


def baseline_of(group: Group, groups: Iterable[Group]) -> Group | None:
    """Finds the baseline with the same other settings.

    ``None`` for the baseline itself, if there is no such group, and if there are several, whose
    defaults differ.
    """
    if group.first.method == "none":
        return None
    baselines = (other for other in groups if other.first.method == "none")
    found = [other for other in baselines if other.setup == group.setup]
    return found[0] if len(found) == 1 else None


def settings_notes(groups: Sequence[Group]) -> list[str]:
    """Notes on the names, on settings that no name contains, and on pooled versions."""
    notes: dict[str, list[str]] = defaultdict(list)
    for together in by_task(groups):
        where = f"{together[0].first.task}, {together[0].first.algorithm}"
        shared = _common(together)
        rows = [("in every row, other than the defaults without a preset", shared)]
        for method in dict.fromkeys(group.first.method for group in together):
            common = _common([group for group in together if group.first.method == method])
            own = {k: v for k, v in common.items() if _is_own(k) and k not in shared}
            rows.append((f"{method_name(method)}, other than the defaults without a preset", own))
        for which, settings in rows:
            if settings:
                listed = ", ".join(f"`{name}={value}`" for name, value in settings.items())
                notes[f"{which}: {listed}."].append(where)
    # One note for all tasks with the same settings.
    written = [f"{'; '.join(tasks)}: {note}" for note, tasks in notes.items()]
    distances = tuple(f"L2C2, {distance}" for distance in DISTANCES.values())
    if any(group.name.startswith(distances) for group in groups):
        written.insert(0, NAMES)
    return [*written, *_pooled_versions(groups)]


def _pooled_versions(groups: Sequence[Group]) -> list[str]:
    rows: dict[tuple[str, str], list[str]] = defaultdict(list)
    for name in ("torch", "torchrl", "commit"):
        for group in groups:
            versions = sorted(set(group.runs[name].replace("", "unknown")))
            if len(versions) > 1:
                note = f"runs of more than one {name} ({', '.join(versions)}) are pooled."
                where = f"{group.first.task}, {group.first.algorithm}"
                rows[where, note].append(group.name)
    return [f"{where}, {'; '.join(names)}: {note}" for (where, note), names in rows.items()]


def _common(groups: Sequence[Group]) -> dict[str, str]:
    """The settings that differ from the defaults in the same way in all groups."""
    first, *rest = (read_differences(group.first.differences) for group in groups)
    return {k: v for k, v in first.items() if all(other.get(k) == v for other in rest)}


def _named(groups: list[Group]) -> list[Group]:
    """Groups of one task and algorithm, each named by its differences from the others."""
    methods = [name_with_settings(group.first.method, group.settings) for group in groups]
    differing = [
        {key: value for key, value in _differing(group, groups).items() if key not in contained}
        for group, (_, contained) in zip(groups, methods, strict=True)
    ]
    keys = {key for values in differing for key in values}
    endings = Counter(key.rpartition(".")[2] for key in keys)
    # A setting's name without its group, if that is clear.
    short = {k: k if endings[k.rpartition(".")[2]] > 1 else k.rpartition(".")[2] for k in keys}
    several = len({group.first.length for group in groups}) > 1
    names = []
    for group, (method, _), values in zip(groups, methods, differing, strict=True):
        parts = [method, *(f"{short[key]}={value}" for key, value in values.items())]
        names.append(", ".join([*parts, group.first.length] if several else parts))
    # Runs of older defaults differ only in the code of their settings.
    return [
        Group(group.runs, f"{name}, {group.first.settings}" if names.count(name) > 1 else name)
        for group, name in zip(groups, names, strict=True)
    ]


def _differing(group: Group, groups: Sequence[Group]) -> dict[str, str]:
    alike = [other for other in groups if other.first.method == group.first.method]
    return {
        key: value
        for key, value in group.settings.items()
        if any(other.settings.get(key) != value for other in (alike if _is_own(key) else groups))
    }


def _is_own(setting: str) -> bool:
    return setting.startswith("regularizer.")
