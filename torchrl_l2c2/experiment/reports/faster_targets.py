"""The paper's ablation of the value term: L2C2 on Swingup with faster target networks."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_l2c2.experiment.reports.comparison import READING, improvement, probability
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.paper import FASTER, FASTER_RETURNS, PAPER, TAU, is_of_paper
from torchrl_l2c2.experiment.reports.paper_table import FIRST, SECOND
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table, number, number_range, pooled

TASK, WITHOUT = "swingup", "l2c2_policy"
LEGEND = (
    "Means over seeds, standard deviations in brackets, of the late policies with sampled "
    "actions, and of the last policy; for tau .5 the paper has the returns alone. P: the "
    "probability that a run of L2C2 returns more than a run without the value term (beta=0) at "
    "the same tau (ties count half), with its 95% interval of the stratified bootstrap. " + READING
)


def faster_targets_table(records: Sequence[Record]) -> Table | None:
    """L2C2 with and without its value term, at every pace of the target networks.

    Args:
        records (sequence of Record): of any tasks; others are passed over.

    Returns:
        Table: ``None`` where no run has another pace than the paper's usual one.
    """
    found = [
        record
        for record in records
        if record.task == TASK
        and is_of_paper(record.task, record.algorithm)
        and record.method in FASTER_RETURNS
        and not any(name.startswith("regularizer.") for name in record.other_settings)
    ]
    if not any(TAU in record.other_settings for record in found):
        return None
    groups = group_records(found)
    columns = ["task", "method", "seeds", "return", "last policy", "the paper's"]
    columns += ["P(returns more than beta=0)"]
    rows = [_row(group, groups) for group in groups]
    return Table("Faster target networks", columns, rows, [LEGEND])


def _row(group: Group, groups: Sequence[Group]) -> list[str]:
    others = (other for other in groups if other.first.method == WITHOUT and other is not group)
    without = next((other for other in others if other.reading == group.reading), None)
    better = improvement([group], [without], FIRST, "return") if without else None
    return [
        *(group.first.task, group.name, number_range(group.seeds)),
        *(pooled(group, test, "return") for test in (FIRST, SECOND)),
        _published(group.first),
        probability(better),
    ]


def _published(record: Record) -> str:
    tau = record.other_settings.get(TAU)
    if tau is None:
        return number(PAPER[record.task, record.method].return_mean, "return")
    return number(FASTER_RETURNS[record.method], "return") if tau == str(FASTER) else ""
