"""Each method against each other one, on the tasks that all of them ran on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from torchrl_l2c2.experiment.reports.comparison import improvement, probability
from torchrl_l2c2.experiment.reports.field import BETTER, field_groups
from torchrl_l2c2.experiment.reports.groups import Group, over_tasks
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table

MOST = 12  # Methods of a table: more are what a search tried, and are told by their plane.
LEGEND = (
    "How probable it is that a run of the row is better than one of the column, of all pairs of "
    "runs on a task, ties halved, mean over tasks; 95% intervals of the stratified bootstrap in "
    "brackets. An interval that holds .50 does not tell the two apart."
)


def pairwise_tables(records: Sequence[Record]) -> list[Table]:
    """The probability of improvement of every method over every other, by return and by Sm.

    Args:
        records (sequence of Record): of any tasks; those that are not the field's are passed over.

    Returns:
        list of Table: one of each measure, for every algorithm and set of tasks that three to
        twelve methods ran on; of two, the table beside vanilla has said it.
    """
    together: dict[tuple[str, tuple[str, ...]], dict[str, list[Group]]] = defaultdict(dict)
    for algorithm, name, found in over_tasks(field_groups(records)):
        groups = sorted(found, key=lambda group: group.first.task)
        together[algorithm, tuple(g.first.task for g in groups)][name] = groups
    return [
        _table(f"{better}, {algorithm} on {', '.join(tasks)}", quantity, methods)
        for (algorithm, tasks), methods in together.items()
        if 2 < len(methods) <= MOST
        for quantity, better in BETTER.items()
    ]


def _table(title: str, quantity: str, methods: dict[str, list[Group]]) -> Table:
    def cell(name: str, other: str) -> str:
        if name == other:
            return ""
        return probability(improvement(methods[name], methods[other], "last_mean", quantity))

    rows = [[name, *(cell(name, other) for other in methods)] for name in methods]
    return Table(title, ["method", *methods], rows, [LEGEND])
