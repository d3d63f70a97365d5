"""The paper's results, and its tables next to the runs of this repository."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

from torchrl_l2c2.experiment.analysis.reports.comparison import (
    COMPARED,
    INTERVAL_NOTE,
    comparison_table,
    improvement_cell,
    improvements_over_tasks,
)
from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of, group_records
from torchrl_l2c2.experiment.analysis.reports.statistics import interquartile_mean
from torchrl_l2c2.experiment.analysis.reports.tables import Table, number, number_range, pooled
from torchrl_l2c2.experiment.run.finished import QUANTITIES, TESTS, Record
from torchrl_l2c2.experiment.settings.tasks import TASKS


class Published(NamedTuple):
    """Mean and (over 18 seeds) standard deviation of a cell of the paper's Table III."""

    return_mean: float
    return_std: float
    action_variation_mean: float
    action_variation_std: float

    def cell(self, quantity: str) -> tuple[float, float]:
        """Mean and standard deviation of a quantity, such as ``"return"``."""
        return getattr(self, f"{quantity}_mean"), getattr(self, f"{quantity}_std")


# Kobayashi (2022), Table III: return and L2 norm of temporal actions.
PAPER: dict[tuple[str, str], Published] = {
    ("swingup", "none"): Published(649.57, 77.96, 0.084, 0.011),
    ("reacher", "none"): Published(14.73, 4.34, 0.132, 0.032),
    ("hopper", "none"): Published(1561.85, 879.99, 0.157, 0.097),
    ("ant", "none"): Published(2724.32, 341.46, 0.635, 0.090),
    ("swingup", "caps"): Published(239.57, 26.56, 0.026, 0.002),
    ("reacher", "caps"): Published(-1.57, 1.53, 0.003, 0.001),
    ("hopper", "caps"): Published(762.20, 321.26, 0.004, 0.001),
    ("ant", "caps"): Published(911.36, 98.33, 0.002, 0.001),
    ("swingup", "l2c2"): Published(693.77, 123.78, 0.075, 0.012),
    ("reacher", "l2c2"): Published(15.42, 4.04, 0.096, 0.018),
    ("hopper", "l2c2"): Published(2091.76, 563.82, 0.174, 0.055),
    ("ant", "l2c2"): Published(2762.75, 536.85, 0.531, 0.150),
    ("swingup", "l2c2_policy"): Published(707.41, 40.94, 0.075, 0.010),
    ("reacher", "l2c2_policy"): Published(15.81, 4.196, 0.095, 0.023),
    ("hopper", "l2c2_policy"): Published(1998.54, 714.88, 0.141, 0.063),
    ("ant", "l2c2_policy"): Published(2690.26, 483.62, 0.521, 0.142),
}
# Section V: what L2C2 on Swingup returned with faster target networks, at this tau instead of .1.
TAU, FASTER = "algorithm.tau", 0.5
FASTER_RETURNS = {"l2c2": 376.0, "l2c2_policy": 284.0}
LEGEND = (
    "Means over seeds, standard deviations in brackets; the paper's are over 18 seeds. Actions "
    "are sampled, as in training; the action variation is that of the policy's mean, smaller is "
    "smoother. The first column of each is of the late policies (training's own episodes in its "
    "last tenth or late_share); † marks means further from the paper's than the paper's "
    "deviation. P is of the same: the probability that a run is better than a run of vanilla "
    "with the same other settings (ties count half), with its 95% interval of the stratified "
    f"bootstrap; over several tasks it is the mean of theirs. {INTERVAL_NOTE} The "
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
BETTER = {quantity: COMPARED[quantity][1] for quantity in QUANTITIES}
STATISTICS_LEGEND = (
    "95% intervals of the stratified bootstrap in brackets (Agarwal et al. 2021). P: the "
    "probability that a run is better than a run of vanilla with the same other settings "
    f"(ties count half). {INTERVAL_NOTE}"
)
FASTER_LEGEND = (
    "Means over seeds, standard deviations in brackets, of the late policies with sampled "
    "actions, and of the last policy; for tau .5 the paper has the returns alone. P: the "
    "probability that a run of L2C2 returns more than a run without the value term (beta=0) at "
    "the same tau (ties count half), with its 95% interval of the stratified bootstrap. "
    + INTERVAL_NOTE
)


def paper_of(record: Record) -> Published | None:
    """The paper's results of a run's task and method; ``None`` where it has none.

    Runs with other settings of the regularizer, another simulator or another pace of the target
    networks have none. What else the paper leaves open may differ: the tables name it.
    """
    varied = ("regularizer.", TAU)
    if not is_of_own_task(record) or any(k.startswith(varied) for k in record.other_settings):
        return None
    return PAPER.get((record.task, record.method)) if is_of_paper(record) else None


def is_of_paper(record: Record) -> bool:
    """Tells if a run is on one of the paper's tasks with its algorithm, by any method."""
    return record.algorithm == "ppo_rpe" and (record.task, "none") in PAPER


def is_of_own_task(record: Record) -> bool:
    """Tells if a run has the simulator, the noise and the longest episode of its task."""
    return not {"task.env_id", "task.noise_scale", "task.max_steps"} & record.other_settings.keys()


def is_as_usual(record: Record, *but: str) -> bool:
    """Tells if length and settings are the task's defaults, except for the settings ``but``."""
    task = TASKS.get(record.task)
    others = {k for k in record.settings_without_length if not k.startswith("regularizer.")}
    others -= {*but}
    return task is not None and record.length == f"{task.episodes} episodes" and not others


def shown_groups(records: Iterable[Record]) -> list[Group]:
    """The groups of the paper's table: per task the default length and settings, if it has them."""
    records = [r for r in records if is_of_paper(r)]
    as_usual = {r.task for r in records if is_as_usual(r)}
    return group_records(r for r in records if is_as_usual(r) or r.task not in as_usual)


def paper_table(groups: Sequence[Group]) -> Table:
    """Each group's late and last policies with sampled actions, next to the paper's results."""
    columns = ["task", "method", "seeds"]
    for quantity, better in BETTER.items():
        columns += [QUANTITIES[quantity], "the paper's", "last policy", better]
    rows = []
    for group in groups:
        cells = [group.first.task, group.name, number_range(group.seeds)]
        for quantity in QUANTITIES:
            cells += [
                pooled(group, FIRST, quantity) + ("†" if _is_off(group, quantity) else ""),
                _published(paper_of(group.first), quantity),
                pooled(group, SECOND, quantity),
                improvement_cell([group], [baseline_of(group, groups)], FIRST, quantity),
            ]
        rows.append([*cells, pooled(group, FIRST, "policy_scale")])
    for _, name, ours, found in improvements_over_tasks(groups, FIRST, QUANTITIES):
        across = [cell for each in found for cell in ("", "", "", each)]
        rows.append([f"{len(ours)} tasks", name, "", *across, ""])
    return Table("Beside the paper's table", [*columns, "policy scale"], rows, [LEGEND])


def deployed_table(groups: Sequence[Group]) -> Table:
    """The same with mean actions, without noise from sampling."""
    late, _ = DEPLOYED
    columns = ["task", "method", "seeds"]
    for quantity, better in BETTER.items():
        columns += [QUANTITIES[quantity], "last policy", better]
    groups = [group for group in groups if len(group.scores(late, "return"))]
    rows = []
    for group in groups:
        cells = [group.first.task, group.name, number_range(group.seeds)]
        for quantity in QUANTITIES:
            cells += [pooled(group, test, quantity) for test in DEPLOYED]
            cells.append(improvement_cell([group], [baseline_of(group, groups)], late, quantity))
        rows.append(cells)
    for _, name, ours, found in improvements_over_tasks(groups, late, QUANTITIES):
        across = [cell for each in found for cell in ("", "", each)]
        rows.append([f"{len(ours)} tasks", name, "", *across])
    return Table("As deployed", columns, rows, [DEPLOYED_LEGEND])


def statistics_table(groups: Sequence[Group]) -> Table:
    """Interquartile means of the late policies with sampled actions."""
    table = comparison_table(FIRST, groups, interquartile_mean)
    means = {name: f"{name}: interquartile mean" for name in QUANTITIES.values()}
    return replace(
        table,
        title=f"Statistics: {TESTS[FIRST]}",
        columns=[means.get(column, column) for column in table.columns],
        notes=[STATISTICS_LEGEND],
    )


def faster_targets_table(records: Iterable[Record]) -> Table:
    """L2C2 on Swingup with and without its value term, at every pace of the target networks."""
    groups = group_records(
        record
        for record in records
        if (record.task, record.algorithm) == ("swingup", "ppo_rpe")
        and record.method in FASTER_RETURNS
        and not any(name.startswith("regularizer.") for name in record.other_settings)
    )
    rows = []
    for group in groups:
        same = [g for g in groups if g.first.method == "l2c2_policy" and g.setup == group.setup]
        without = [g for g in same if g is not group]
        rows.append(
            [
                *(group.first.task, group.name, number_range(group.seeds)),
                *(pooled(group, test, "return") for test in (FIRST, SECOND)),
                _faster_published(group.first),
                improvement_cell([group], without[:1] or [None], FIRST, "return"),
            ]
        )
    columns = ["task", "method", "seeds", "return", "last policy", "the paper's"]
    columns += ["P(returns more than beta=0)"]
    return Table("Faster target networks", columns, rows, [FASTER_LEGEND])


def point(group: Group) -> tuple[float, ...] | None:
    """The paper's action variation and return of a group, then their standard deviations."""
    paper = paper_of(group.first)
    if paper is None:
        return None
    ends = zip(paper.cell("action_variation"), paper.cell("return"), strict=True)
    return tuple(value for pair in ends for value in pair)


def _is_off(group: Group, quantity: str) -> bool:
    """Tells if late policies are further from the paper's mean than its standard deviation."""
    scores, paper = group.scores(FIRST, quantity), paper_of(group.first)
    if paper is None or not len(scores):
        return False
    center, deviation = paper.cell(quantity)
    return abs(float(scores.mean()) - center) > deviation


def _published(paper: Published | None, quantity: str) -> str:
    if paper is None:
        return ""
    center, deviation = paper.cell(quantity)
    return f"{number(center, quantity)} ({number(deviation, quantity, center)})"


def _faster_published(record: Record) -> str:
    tau = record.other_settings.get(TAU)
    if tau is None:
        return number(PAPER[record.task, record.method].return_mean, "return")
    return number(FASTER_RETURNS[record.method], "return") if tau == str(FASTER) else ""
