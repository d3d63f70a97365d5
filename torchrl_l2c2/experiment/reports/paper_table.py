"""The paper's table with what runs gave, and how probably each method is better than vanilla."""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_l2c2.experiment.reports.comparison import (
    READING,
    improvement,
    improvements_over_tasks,
    probability,
)
from torchrl_l2c2.experiment.reports.groups import Group, baseline_of
from torchrl_l2c2.experiment.reports.paper import Published, is_of_paper
from torchrl_l2c2.experiment.reports.records import QUANTITIES
from torchrl_l2c2.experiment.reports.tables import Table, number, number_range, pooled

LEGEND = (
    "Means over seeds, standard deviations in brackets; the paper's are over 18 seeds. Actions "
    "are sampled, as in training; the action variation is that of the policy's mean, smaller is "
    "smoother. The first column of each is of the late policies (training's own episodes in its "
    "last tenth or late_share); † marks means further from the paper's than the paper's "
    "deviation. P is of the same: the probability that a run is better than a run of vanilla "
    "with the same other settings (ties count half), with its 95% interval of the stratified "
    f"bootstrap; over several tasks it is the mean of theirs. {READING} The "
    "policy scale is that of the late policies: the Hellinger distance is relative to it, so that "
    "a wider policy may change more."
)
DEPLOYED_LEGEND = (
    "The same runs with mean actions, as a trained policy is used: the late policies in a test "
    "episode each, and the last policy in its test episodes (100 by default). P is of the late "
    "policies."
)
# Late policies in the first column, as they are steadier than the paper's test of the last one.
FIRST, SECOND = "late_sampled", "last_sampled"
DEPLOYED = ("late_mean", "last_mean")
BETTER = ("P(returns more)", "P(smoother)")


def paper_table(groups: Sequence[Group]) -> Table | None:
    """A row for every group of runs of the paper's tasks by its algorithm, beside its numbers.

    Args:
        groups (sequence of Group): of any tasks; others are passed over.

    Returns:
        Table: ``None`` where no run is of such a task.
    """
    columns = ["task", "method", "seeds"]
    for name, better in zip(QUANTITIES.values(), BETTER, strict=True):
        columns += [name, "the paper's", "last policy", better]
    columns += ["policy scale"]
    groups = _of_paper(groups)
    rows = [_row(group, baseline_of(group, groups)) for group in groups]
    for tasks, name, (returns, smoother) in _over_tasks(groups, FIRST):
        rows.append([tasks, name, "", *("", "", "", returns), *("", "", "", smoother), ""])
    return Table("Beside the paper's table", columns, rows, [LEGEND]) if rows else None


def deployed_table(groups: Sequence[Group]) -> Table | None:
    """The rows of :func:`paper_table` with mean actions, without noise from sampling.

    Args:
        groups (sequence of Group): of any tasks; others are passed over.

    Returns:
        Table: ``None`` where no run of such a task has been tested with mean actions.
    """
    columns = ["task", "method", "seeds"]
    for name, better in zip(QUANTITIES.values(), BETTER, strict=True):
        columns += [name, "last policy", better]
    groups = [g for g in _of_paper(groups) if len(g.scores(DEPLOYED[0], "return"))]
    rows = [_deployed_row(group, baseline_of(group, groups)) for group in groups]
    for tasks, name, (returns, smoother) in _over_tasks(groups, DEPLOYED[0]):
        rows.append([tasks, name, "", *("", "", returns), *("", "", smoother)])
    return Table("As deployed", columns, rows, [DEPLOYED_LEGEND]) if rows else None


def _of_paper(groups: Sequence[Group]) -> list[Group]:
    return [
        g
        for g in groups
        if is_of_paper(g.first.task, g.first.algorithm)
        and "task.env_id" not in g.first.other_settings
    ]


def _over_tasks(groups: Sequence[Group], test: str) -> list[tuple[str, str, list[str]]]:
    return [
        (f"{len(ours)} tasks", name, better)
        for _, name, ours, better in improvements_over_tasks(groups, test)
    ]


def _deployed_row(group: Group, vanilla: Group | None) -> list[str]:
    late, last = DEPLOYED
    cells = [group.first.task, group.name, number_range(group.seeds)]
    for quantity in QUANTITIES:
        better = improvement([group], [vanilla], late, quantity) if vanilla else None
        both = (pooled(group, test, quantity) for test in (late, last))
        cells += [*both, probability(better)]
    return cells


def _row(group: Group, vanilla: Group | None) -> list[str]:
    cells = [group.first.task, group.name, number_range(group.seeds)]
    for quantity in QUANTITIES:
        better = improvement([group], [vanilla], FIRST, quantity) if vanilla else None
        cells += [
            pooled(group, FIRST, quantity) + ("†" if _is_off(group, quantity) else ""),
            _published(group.first.paper, quantity),
            pooled(group, SECOND, quantity),
            probability(better),
        ]
    return [*cells, pooled(group, FIRST, "policy_scale")]


def _is_off(group: Group, quantity: str) -> bool:
    """Whether the late policies lie further from the paper's mean than its standard deviation."""
    scores, paper = group.scores(FIRST, quantity), group.first.paper
    if paper is None or not len(scores):
        return False
    center, deviation = paper.cell(quantity)
    return abs(float(scores.mean()) - center) > deviation


def _published(paper: Published | None, quantity: str) -> str:
    if paper is None:
        return ""
    center, deviation = paper.cell(quantity)
    return f"{number(center, quantity)} ({number(deviation, quantity, center)})"
