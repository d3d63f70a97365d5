"""Runs that differ in nothing but their seeds, as one group; and what tells groups apart."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.reports.names import method_name, name_with_settings
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.statistics import Scores

# A row's settings by name; ``None`` where the default stands.
Settings = tuple[tuple[str, str | None], ...]
# What sets groups apart and is no setting of a run: how long it was, and the code of all settings.
LENGTH, CODE = "length", "settings"


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
    def reading(self) -> tuple[Any, ...]:
        """Every setting but the regularizer's: what is compared with it has the same."""
        return (self.first.task, self.first.algorithm, *sorted(_others(self).items()))

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
    for record in sorted(records, key=lambda record: record.place):
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
    """The vanilla runs with the same other settings; ``None`` for themselves or without any.

    And where there are several, of other defaults: nothing says beside which of them it belongs.
    """
    if group.first.method == "none":
        return None
    vanilla = (other for other in groups if other.first.method == "none")
    found = [other for other in vanilla if other.reading == group.reading]
    return found[0] if len(found) == 1 else None


def over_tasks(groups: Iterable[Group]) -> list[tuple[str, str, list[Group]]]:
    """A row for every method and its own settings: of each task that has them, one group.

    Other settings and the length may be a task's own, as a preset's are. Where a task has several
    such groups, only what sets these apart must be the same on all tasks of a row.

    Args:
        groups (iterable of Group): of several tasks.

    Returns:
        list: the algorithm, the row's name, with what sets it apart from the method's other rows,
        and its groups.
    """
    methods: dict[tuple[str, str], dict[Settings, list[Group]]] = {}
    for group in groups:
        of_method = methods.setdefault((group.first.algorithm, group.first.method), {})
        of_method.setdefault(_own(group), []).append(group)
    rows = []
    for (algorithm, method), found in methods.items():
        common = set.intersection(*map(set, found))
        for own, alike in found.items():
            name, named = name_with_settings(method, dict(own))
            told = tuple(pair for pair in own if pair not in common and pair[0] not in named)
            for others, row in _one_of_each(alike).items():
                parts = [name, *_told_settings(told + others)]
                rows.append((algorithm, ", ".join(parts), row))
    names = Counter((algorithm, name) for algorithm, name, _ in rows)
    return [
        # Methods may differ in no more than what they are called, as l2c2_policy from beta=0.
        (algorithm, name if names[algorithm, name] == 1 else f"{name}, {row[0].first.method}", row)
        for algorithm, name, row in rows
    ]


def _one_of_each(groups: Sequence[Group]) -> dict[Settings, list[Group]]:
    """Rows with one group of a task, by the settings that set groups of the same task apart."""
    apart: set[str] = set()
    for one, other in combinations(groups, 2):
        if one.first.task == other.first.task:
            ours, theirs = _others(one), _others(other)
            apart |= {k for k in ours | theirs if ours.get(k) != theirs.get(k)} or {CODE}
    rows: dict[Settings, list[Group]] = defaultdict(list)
    for group in groups:
        others = _others(group) | {CODE: group.first.settings}
        rows[tuple((key, others.get(key)) for key in sorted(apart))].append(group)
    return rows


def _told_settings(settings: Settings) -> list[str]:
    keys = {key for key, _ in settings}
    return [
        value if key in (LENGTH, CODE) else f"{_shortest(key, keys)}={value}"
        for key, value in settings
        if value is not None
    ]


def comparable(groups: Iterable[Group]) -> list[tuple[str, list[Group]]]:
    """Groups that differ in the regularizer alone, together, and what sets them apart from others.

    All of a task and an algorithm are together where no two of them are so: a sweep over other
    settings is compared for these.

    Returns:
        list: what sets them apart, such as ``"reduction=mean, 300 episodes"``, empty where there
        are no others; and the groups, whose names no longer say it.
    """
    tasks: dict[tuple[str, str], dict[tuple[Any, ...], list[Group]]] = {}
    for group in groups:
        readings = tasks.setdefault((group.first.task, group.first.algorithm), {})
        readings.setdefault(group.reading, []).append(group)
    found = []
    for together in map(list, (readings.values() for readings in tasks.values())):
        if len(together) == 1 or max(map(len, together)) == 1:
            found.append(("", [group for members in together for group in members]))
            continue
        others = [_others(members[0]) for members in together]
        keys = sorted({key for one in others for key in one})
        apart = [key for key in keys if len({one.get(key) for one in others}) > 1]
        for own, members in zip(others, together, strict=True):
            told = _told_settings(tuple((key, own.get(key)) for key in apart))
            found.append((", ".join(told), _named(members)))
    return found


def differing_lengths(groups: Sequence[Group]) -> list[str]:
    """What was trained for different lengths, which is not pooled."""
    lengths: dict[tuple[str, ...], list[Group]] = defaultdict(list)
    for group in groups:
        # A run's identity without its length and seed.
        lengths[tuple(map(str, group.first.identity[:-2]))].append(group)
    several = [
        (" and of ".join(group.first.length for group in same), same[0])
        for same in lengths.values()
        if len(same) > 1
    ]
    return _told(
        (f"runs of {found} are rows of their own", group, method_name(group.first.method))
        for found, group in several
    )


def differing_versions(groups: Sequence[Group]) -> list[str]:
    """What was run by several versions, which are pooled."""
    found = (
        (name, sorted({str(getattr(r, name)) or "unknown" for r in group.records}), group)
        for name in ("torch", "torchrl", "commit")
        for group in groups
    )
    return _told(
        (f"runs of more than one {name} ({', '.join(versions)}) are pooled", group, group.name)
        for name, versions, group in found
        if len(versions) > 1
    )


def _told(said: Iterable[tuple[str, Group, str]]) -> list[str]:
    """A line for each that is said, of all rows of a task and an algorithm together."""
    rows: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for sentence, group, name in said:
        rows[group.first.task, group.first.algorithm, sentence].append(name)
    return [
        f"{task}, {algorithm}, {'; '.join(names)}: {sentence}"
        for (task, algorithm, sentence), names in rows.items()
    ]


def common_settings(groups: Sequence[Group]) -> dict[str, str]:
    """What differs from the defaults in all groups alike."""
    first, *rest = ({**group.first.other_settings} for group in groups)
    return {k: v for k, v in first.items() if all(other.get(k) == v for other in rest)}


def _own(group: Group) -> Settings:
    """The regularizer's settings."""
    found = group.first.other_settings.items()
    return tuple((k, v) for k, v in found if k.startswith("regularizer."))


def _others(group: Group) -> dict[str, str]:
    """All other settings, and the length."""
    # A run of so many frames has a number of episodes, too, which says nothing.
    known = group.first.settings_of_any_length.items()
    others = {k: v for k, v in known if not k.startswith("regularizer.")}
    return {**others, LENGTH: group.first.length}


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

    known = group.first.settings_of_any_length.items()
    return {k: v for k, v in known if len(others_have(k)) > 1}


def _shortest(key: str, keys: set[str]) -> str:
    """A setting's name without its group, where that is clear."""
    ending = key.rpartition(".")[2]
    return ending if sum(k.rpartition(".")[2] == ending for k in keys) == 1 else key
