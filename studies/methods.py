"""Methods and their settings compared with one another over the field's tasks."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from studies.cells import number_range, of_runs, over_tasks
from studies.field import BETTER, TEST, field_groups, known_cell
from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    INTERVAL_NOTE,
    Table,
    improvement_cell,
    number,
    or_dash,
)

CHOICE_LEGEND = (
    "Compared with the baseline's runs of the same seeds and other settings, smoothest first; "
    "the last policy's test episodes, with its mean actions. Return: the difference of the means "
    "over seeds, relative to the size of the baseline's mean, averaged over tasks. Sm: the ratio "
    "of the means over seeds, geometric mean over tasks; 1 is no smoother. P: the probability "
    "that a run is better than a run of the baseline (all pairs of runs, ties count half), "
    f"averaged over tasks. {INTERVAL_NOTE}"
)
MOST = 12  # Methods of a table: more are a search, which a picture shows.
PAIRWISE_LEGEND = (
    "The probability that a run of the row is better than a run of the column (all pairs of runs "
    "on a task, ties count half), averaged over tasks; 95% intervals of the stratified bootstrap "
    f"in brackets. {INTERVAL_NOTE}"
)
AGAINST_LEGEND = (
    "Means over seeds of the last policy's test episodes, with its mean actions. P: the "
    "probability that a run of {name} is better than a run of the other method (all pairs of "
    "runs, ties count half), with its 95% interval of the stratified bootstrap."
)


class Pair(NamedTuple):
    """A setting and the baseline on one task, on the seeds that both have."""

    group: Group
    baseline: Group
    gained: float
    sm: float
    seeds: list[int]

    @property
    def task(self) -> str:
        """The task of both."""
        return self.group.first.task


def choice_table(records: pd.DataFrame) -> Table:
    """Settings in the order of their smoothness over tasks, with the cost in return."""
    groups = field_groups(records)
    compared = {
        group: pair
        for group in groups
        if (baseline := baseline_of(group, groups)) is not None
        and (pair := _pair(group, baseline)) is not None
    }
    settings = [
        (algorithm, name, [compared[group] for group in row])
        for algorithm, name, row in over_tasks(compared)
    ]
    # Methods of most tasks come first: means over other tasks are not comparable.
    settings.sort(key=lambda row: (row[0], -len(row[2]), np.nan_to_num(_sm(row[2]), nan=np.inf)))
    rows = [[algorithm, name, *_cells(tasks)] for algorithm, name, tasks in settings]
    columns = ["algorithm", "method", "tasks", "seeds"]
    columns += [f"{measure}{end}" for measure in ("return", "Sm") for end in ("", ", worst task")]
    return Table("In order over tasks", [*columns, *BETTER.values()], rows, [CHOICE_LEGEND])


def pairwise_tables(records: pd.DataFrame) -> list[Table]:
    """Probabilities of improvement of every method over every other, by return and by Sm.

    Returns:
        list of Table: two for every algorithm and set of tasks that three to twelve methods ran on
        with the same other settings and length.
    """
    # By everything but the regularizer: runs of other lengths or settings are not compared.
    together: dict[tuple[Any, ...], dict[str, list[Group]]] = defaultdict(dict)
    for _, name, found in over_tasks(field_groups(records)):
        groups = sorted(found, key=lambda group: group.first.task)
        together[tuple(group.setup for group in groups)][name] = groups
    return [
        _pairwise_table(better, quantity, methods)
        for methods in together.values()
        if 2 < len(methods) <= MOST
        for quantity, better in BETTER.items()
    ]


def against_table(records: pd.DataFrame, name: str) -> Table:
    """One method against each other one with the same other settings, task by task.

    Args:
        records (DataFrame): Records of any tasks; only the field's tasks are used.
        name (str): The method's name in tables, such as ``"L2C2, mse 1, ramp"``.
    """
    groups = field_groups(records)
    rows = [
        _against_row(ours, theirs)
        for ours in groups
        for theirs in groups
        if ours.name == name and theirs is not ours and theirs.setup == ours.setup
    ]
    columns = ["task", "algorithm", "against", "seeds"]
    for quantity, better in zip(COMPARED, ("returns more", *["smoother"] * 2), strict=True):
        columns += [COMPARED[quantity][0], "the other's", f"P({better})"]
    legend = f"{AGAINST_LEGEND.format(name=name)} {INTERVAL_NOTE}"
    return Table(f"{name} against each other method", columns, rows, [legend])


def _pairwise_table(better: str, quantity: str, methods: dict[str, list[Group]]) -> Table:
    rows = [
        [
            name,
            *(
                "" if name == other else improvement_cell(ours, theirs, TEST, quantity)
                for other, theirs in methods.items()
            ),
        ]
        for name, ours in methods.items()
    ]
    of = [group.first for group in next(iter(methods.values()))]
    title = f"{better}, {of[0].algorithm} on {', '.join(record.task for record in of)}"
    lacking = [
        f"{group.first.task}, {name}{of_runs(known, len(group.runs))}"
        for name, groups in methods.items()
        for group in groups
        if (known := len(group.scores(TEST, quantity))) < len(group.runs)
    ]
    notes = [f"Not all runs have it: {'; '.join(lacking)}."] if lacking else []
    return Table(title, ["method", *methods], rows, [PAIRWISE_LEGEND, *notes])


def _against_row(ours: Group, theirs: Group) -> list[str]:
    seeds = dict.fromkeys(number_range(group.seeds) for group in (ours, theirs))
    cells = [ours.first.task, ours.first.algorithm, theirs.name, " and ".join(seeds)]
    for quantity in COMPARED:
        for group in (ours, theirs):
            scores = group.scores(TEST, quantity)
            center = float(scores.mean()) if len(scores) else math.nan
            cells.append(known_cell(group, quantity, number(center, quantity)))
        cells.append(improvement_cell([ours], [theirs], TEST, quantity))
    return cells


def _pair(group: Group, baseline: Group) -> Pair | None:
    values = [
        side.by_seed(TEST, quantity)
        for quantity in ("return", "sm_asap")
        for side in (group, baseline)
    ]
    seeds = sorted(set.intersection(*map(set, values)))
    if not seeds:
        return None
    total, their_total, sm, their_sm = (np.mean([f[seed] for seed in seeds]) for f in values)
    # A return of 0 has no parts.
    gained = float((total - their_total) / abs(their_total)) if their_total else math.nan
    ours, theirs = (
        Group(side.runs[side.runs["seed"].isin(seeds)], side.name) for side in (group, baseline)
    )
    # Policies that never move have no ratio, or none with a logarithm.
    return Pair(ours, theirs, gained, float(sm / their_sm) if sm * their_sm else math.nan, seeds)


def _sm(tasks: Sequence[Pair]) -> float:
    return float(np.exp(np.mean(np.log([each.sm for each in tasks]))))


def _cells(tasks: Sequence[Pair]) -> list[str]:
    gained, rough = [each.gained for each in tasks], [each.sm for each in tasks]
    # For NumPy NaN is the smallest and the largest: the worst task, as it may be.
    least, roughest = tasks[int(np.argmin(gained))], tasks[int(np.argmax(rough))]
    ours, theirs = [each.group for each in tasks], [each.baseline for each in tasks]
    return [
        ", ".join(each.task for each in tasks),
        "; ".join(dict.fromkeys(number_range(each.seeds) for each in tasks)),
        or_dash(float(np.mean(gained)), "+.0%"),
        f"{or_dash(least.gained, '+.0%')} {least.task}",
        or_dash(_sm(tasks), ".2f"),
        f"{or_dash(roughest.sm, '.2f')} {roughest.task}",
        *(improvement_cell(ours, theirs, TEST, quantity) for quantity in BETTER),
    ]
