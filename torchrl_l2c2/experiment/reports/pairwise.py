"""Each method against each other one, on the tasks that all of them ran on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

from torchrl_l2c2.experiment.reports.comparison import READING, improvement, probability
from torchrl_l2c2.experiment.reports.field import BETTER, field_groups
from torchrl_l2c2.experiment.reports.groups import Group, over_tasks
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table, of_runs

MOST = 12  # Methods of a table: more are what a search tried, and are told by their plane.
LEGEND = (
    "The probability that a run of the row is better than a run of the column (all pairs of runs "
    "on a task, ties count half), averaged over tasks; 95% intervals of the stratified bootstrap "
    f"in brackets. {READING}"
)


def pairwise_tables(records: Sequence[Record]) -> list[Table]:
    """The probability of improvement of every method over every other, by return and by Sm.

    Args:
        records (sequence of Record): of any tasks; those that are not the field's are passed over.

    Returns:
        list of Table: one of each measure, for every algorithm and set of tasks that three to
        twelve methods ran on with the same other settings, and for as long; of two, the table
        beside vanilla has said it.
    """
    # By everything but the regularizer: runs of other lengths or settings are not compared.
    together: dict[tuple[Any, ...], dict[str, list[Group]]] = defaultdict(dict)
    for _, name, found in over_tasks(field_groups(records)):
        groups = sorted(found, key=lambda group: group.first.task)
        together[tuple(group.reading for group in groups)][name] = groups
    return [
        _table(better, quantity, methods)
        for methods in together.values()
        if 2 < len(methods) <= MOST
        for quantity, better in BETTER.items()
    ]


def _table(better: str, quantity: str, methods: dict[str, list[Group]]) -> Table:
    def cell(name: str, other: str) -> str:
        if name == other:
            return ""
        return probability(improvement(methods[name], methods[other], "last_mean", quantity))

    rows = [[name, *(cell(name, other) for other in methods)] for name in methods]
    of = [group.first for group in next(iter(methods.values()))]
    title = f"{better}, {of[0].algorithm} on {', '.join(record.task for record in of)}"
    lacking = [
        f"{group.first.task}, {name}{of_runs(known, len(group.records))}"
        for name, groups in methods.items()
        for group in groups
        if (known := len(group.scores("last_mean", quantity))) < len(group.records)
    ]
    notes = [f"Not all runs have it: {'; '.join(lacking)}."] if lacking else []
    return Table(title, ["method", *methods], rows, [LEGEND, *notes])
