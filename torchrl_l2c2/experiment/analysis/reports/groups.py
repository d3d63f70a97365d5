"""Runs that differ in nothing but their seeds, as one group; and what tells groups apart."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.names import name_with_settings
from torchrl_l2c2.experiment.analysis.reports.records import place
from torchrl_l2c2.experiment.analysis.reports.statistics import Scores
from torchrl_l2c2.experiment.run.finished import Record


@dataclass(frozen=True)
class Group:
    """Runs with the same settings and length, one of each seed.

    Attributes:
        records: by seed.
        name: the method, and what tells the group from others of its task and algorithm, such as
            ``"L2C2, beta=0.5"``.
    """

    records: tuple[Record, ...]
    name: str

    @property
    def first(self) -> Record:
        """Any of them, for what they have in common."""
        return self.records[0]

    @property
    def seeds(self) -> list[int]:
        """Of its runs."""
        return [record.seed for record in self.records]

    @property
    def setup(self) -> tuple[Any, ...]:
        """Every setting but the regularizer's: what is compared with it has the same."""
        # A run of so many frames has a number of episodes, too, which says nothing.
        settings = self.first.settings_without_length.items()
        others = sorted(pair for pair in settings if not pair[0].startswith("regularizer."))
        return (self.first.task, self.first.algorithm, self.first.length, *others)

    def by_seed(self, test: str, quantity: str) -> dict[int, float]:
        """A quantity in one of the tests, of every run that has it."""
        values = {record.seed: record.value(test, quantity) for record in self.records}
        return {seed: value for seed, value in values.items() if not math.isnan(value)}

    def scores(self, test: str, quantity: str) -> Scores:
        """The same as a matrix ``[runs, 1]``."""
        return np.array(list(self.by_seed(test, quantity).values())).reshape(-1, 1)


def group_records(records: Iterable[Record]) -> list[Group]:
    """Groups records by every setting but the seed, in the order of tables."""
    pooled: dict[tuple[Any, ...], list[Record]] = defaultdict(list)
    for record in sorted(records, key=place):
        # Without the seed, which is the last of it.
        pooled[record.identity[:-1]].append(record)
    groups = (Group(tuple(members), "") for members in pooled.values())
    return [named for together in by_task(groups) for named in _named(together)]


def by_task(groups: Iterable[Group]) -> list[list[Group]]:
    """Groups of a task and an algorithm together, in the order in which they come."""
    together: dict[tuple[str, str], list[Group]] = defaultdict(list)
    for group in groups:
        together[group.first.task, group.first.algorithm].append(group)
    return list(together.values())


def baseline_of(group: Group, groups: Iterable[Group]) -> Group | None:
    """Finds the baseline runs with the same other settings.

    ``None`` for the baseline itself, if there are none, and if there are several with different
    defaults.
    """
    if group.first.method == "none":
        return None
    vanilla = (other for other in groups if other.first.method == "none")
    found = [other for other in vanilla if other.setup == group.setup]
    return found[0] if len(found) == 1 else None


def over_tasks(groups: Iterable[Group]) -> list[tuple[str, str, list[Group]]]:
    """Groups of several tasks that have the same name and the same settings of the regularizer.

    Other settings may be a task's own, as a preset's are.

    Returns:
        list: the algorithm, the name, and the groups, one of each task.
    """
    rows: dict[tuple[Any, ...], list[Group]] = defaultdict(list)
    for group in groups:
        settings = group.first.other_settings.items()
        own = tuple(pair for pair in settings if pair[0].startswith("regularizer."))
        rows[group.first.algorithm, group.name, own].append(group)
    return [(algorithm, name, found) for (algorithm, name, _), found in rows.items()]


def differing_versions(groups: Sequence[Group]) -> list[str]:
    """Notes on runs of several versions, which are pooled."""
    rows: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for name in ("torch", "torchrl", "commit"):
        for group in groups:
            versions = sorted({str(getattr(r, name)) or "unknown" for r in group.records})
            if len(versions) > 1:
                note = f"runs of more than one {name} ({', '.join(versions)}) are pooled."
                rows[group.first.task, group.first.algorithm, note].append(group.name)
    return [
        f"{task}, {algorithm}, {'; '.join(names)}: {note}"
        for (task, algorithm, note), names in rows.items()
    ]


def common_settings(groups: Sequence[Group]) -> dict[str, str]:
    """What differs from the defaults in all groups alike."""
    first, *rest = ({**group.first.other_settings} for group in groups)
    return {k: v for k, v in first.items() if all(other.get(k) == v for other in rest)}


def _named(groups: list[Group]) -> list[Group]:
    """Groups of one task and algorithm, each named by what the others have differently."""
    methods = [name_with_settings(g.first.method, g.first.other_settings) for g in groups]
    differing = [
        {key: value for key, value in _differing(group, groups).items() if key not in told}
        for group, (_, told) in zip(groups, methods, strict=True)
    ]
    keys = {key for values in differing for key in values}
    short = {key: _shortest(key, keys) for key in keys}
    several = len({group.first.length for group in groups}) > 1
    names = [
        ", ".join(
            [method]
            + [f"{short[key]}={value}" for key, value in values.items()]
            + ([group.first.length] if several else [])
        )
        for group, (method, _), values in zip(groups, methods, differing, strict=True)
    ]
    # Other defaults, when it was run: only the code of the settings tells.
    return [
        replace(group, name=f"{name}, {group.first.settings}" if names.count(name) > 1 else name)
        for group, name in zip(groups, names, strict=True)
    ]


def _differing(group: Group, groups: Sequence[Group]) -> dict[str, str]:
    def others_have(key: str) -> set[str | None]:
        own_kind = key.startswith("regularizer.")
        return {
            other.first.other_settings.get(key)
            for other in groups
            if not own_kind or other.first.method == group.first.method
        }

    known = group.first.settings_without_length.items()
    return {k: v for k, v in known if len(others_have(k)) > 1}


def _shortest(key: str, keys: set[str]) -> str:
    """A setting's name without its group, where that is clear."""
    ending = key.rpartition(".")[2]
    return ending if sum(k.rpartition(".")[2] == ending for k in keys) == 1 else key
