"""One method against each other one, task by task."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_l2c2.experiment.reports.comparison import READING, improvement, probability
from torchrl_l2c2.experiment.reports.field import FIELD_MEASURES, field_groups
from torchrl_l2c2.experiment.reports.groups import Group
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table, number, number_range, of_runs

LEGEND = (
    "Means over seeds of the last policy's test episodes, with its mean actions. P: the "
    "probability that a run of {name} is better than a run of the other method (all pairs of "
    "runs, ties count half), with its 95% interval of the stratified bootstrap."
)


def against_table(records: Sequence[Record], name: str) -> Table:
    """A row for every field's task and every other method with the same other settings.

    Args:
        records (sequence of Record): of any tasks; those that are not the field's are passed over.
        name (str): of the method, as tables call it, such as ``"L2C2, mse 1, ramp"``.

    Raises:
        ValueError: no task has runs of that name, and of another method beside them.
    """
    groups = field_groups(records)
    pairs = [
        (ours, theirs)
        for ours in groups
        for theirs in groups
        if ours.name == name and theirs is not ours and theirs.reading == ours.reading
    ]
    if not pairs:
        known = "; ".join(dict.fromkeys(group.name for group in groups))
        raise ValueError(
            f"--against must name a method that has others beside it on a task of the field's "
            f"table, got {name!r}; here there are {known or 'no such runs'}."
        )
    columns = ["task", "algorithm", "against", "seeds"]
    for quantity, better in zip(FIELD_MEASURES, ("returns more", *["smoother"] * 2), strict=True):
        columns += [FIELD_MEASURES[quantity], "the other's", f"P({better})"]
    title = f"{name} against each other method"
    legend = f"{LEGEND.format(name=name)} {READING}"
    return Table(title, columns, [_row(*pair) for pair in pairs], [legend])


def _row(ours: Group, theirs: Group) -> list[str]:
    seeds = dict.fromkeys(number_range(group.seeds) for group in (ours, theirs))
    cells = [ours.first.task, ours.first.algorithm, theirs.name, " and ".join(seeds)]
    for quantity in FIELD_MEASURES:
        cells += [_mean(group, quantity) for group in (ours, theirs)]
        cells.append(probability(improvement([ours], [theirs], "last_mean", quantity)))
    return cells


def _mean(group: Group, quantity: str) -> str:
    scores = group.scores("last_mean", quantity)
    if not len(scores):
        return "-"
    return number(float(scores.mean()), quantity) + of_runs(len(scores), len(group.records))
