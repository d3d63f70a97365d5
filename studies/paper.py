"""The paper's results, and its tables next to the runs of this repository."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import pandas as pd

from studies.cells import improvements_over_tasks, number_range, pooled, regrouped
from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of, group_records
from torchrl_l2c2.experiment.analysis.reports.statistics import interquartile_mean
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    INTERVAL_NOTE,
    Table,
    comparison_table,
    improvement_cell,
    number,
)
from torchrl_l2c2.experiment.run.finished import QUANTITIES, TESTS
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
    "are sampled, as in training; the action variation is of the policy's mean, smaller is "
    "smoother. The first column of each is of the late policies (training's own episodes in its "
    "last tenth or late_share); † marks means further from the paper's than the paper's "
    "deviation. P is of the same: the probability that a run is better than a run of the baseline "
    "with the same other settings (ties count half), with its 95% interval of the stratified "
    f"bootstrap; over several tasks it is the mean of theirs. {INTERVAL_NOTE} The "
    "policy scale is of the late policies: the Hellinger distance is relative to it, so a "
    "wider policy may change more."
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
    "probability that a run is better than a run of the baseline with the same other settings "
    f"(ties count half). {INTERVAL_NOTE}"
)
FASTER_LEGEND = (
    "Means over seeds, standard deviations in brackets, of the late policies with sampled "
    "actions, and of the last policy; for tau .5 the paper has only returns. P: the "
    "probability that a run of L2C2 returns more than a run without the value term (beta=0) at "
    "the same tau (ties count half), with its 95% interval of the stratified bootstrap. "
    + INTERVAL_NOTE
)


def paper_of(group: Group) -> Published | None:
    """The paper's results for a group's task and method; ``None`` without any.

    Groups with other settings of the regularizer, another simulator or another pace of the target
    networks have none. Other settings that the paper leaves open may differ; the tables name them.
    """
    varied = ("regularizer.", TAU)
    if not is_of_own_task(group) or any(name.startswith(varied) for name in group.settings):
        return None
    return PAPER.get((group.first.task, group.first.method)) if is_of_paper(group) else None


def is_of_paper(group: Group) -> bool:
    """Tells if a group is on one of the paper's tasks with its algorithm, by any method."""
    return group.first.algorithm == "ppo_rpe" and (group.first.task, "none") in PAPER


def is_of_own_task(group: Group) -> bool:
    """Tells if a group has the simulator, the noise and the longest episode of its task."""
    return not {"task.env_id", "task.noise_scale", "task.max_steps"} & group.settings.keys()


def is_as_usual(group: Group, *but: str) -> bool:
    """Tells if length and settings are the task's defaults, except for the settings ``but``."""
    task = TASKS.get(group.first.task)
    others = {name for name in group.settings if not name.startswith("regularizer.")} - {*but}
    return task is not None and group.first.length == f"{task.episodes} episodes" and not others


def shown_groups(records: pd.DataFrame) -> list[Group]:
    """The groups of the paper's table: per task the default length and settings, if it has them."""
    groups = [group for group in group_records(records) if is_of_paper(group)]
    as_usual = {group.first.task for group in groups if is_as_usual(group)}
    shown = [g for g in groups if is_as_usual(g) or g.first.task not in as_usual]
    # New names: only differences between these groups count.
    return group_records(regrouped(shown)) if shown else []


def paper_table(groups: Sequence[Group]) -> Table:
    """Late and last policies of each group with sampled actions, next to the paper's results."""
    columns = ["task", "method", "seeds"]
    for quantity, better in BETTER.items():
        columns += [QUANTITIES[quantity], "in the paper", "last policy", better]
    rows = []
    for group in groups:
        cells = [group.first.task, group.name, number_range(group.seeds)]
        for quantity in QUANTITIES:
            cells += [
                pooled(group, FIRST, quantity) + ("†" if _is_off(group, quantity) else ""),
                _published(paper_of(group), quantity),
                pooled(group, SECOND, quantity),
                improvement_cell([group], [baseline_of(group, groups)], FIRST, quantity),
            ]
        rows.append([*cells, pooled(group, FIRST, "policy_scale")])
    for _, name, ours, found in improvements_over_tasks(groups, FIRST, QUANTITIES):
        across = [cell for each in found for cell in ("", "", "", each)]
        rows.append([f"{len(ours)} tasks", name, "", *across, ""])
    return Table("Next to the paper's table", [*columns, "policy scale"], rows, [LEGEND])


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
    across = [
        [
            f"{len(ours)} tasks",
            algorithm,
            name,
            _runs(ours),
            *(c for each in found for c in ("", each)),
        ]
        for algorithm, name, ours, found in improvements_over_tasks(groups, FIRST, QUANTITIES)
    ]
    means = {name: f"{name}: interquartile mean" for name in QUANTITIES.values()}
    return replace(
        table,
        title=f"Statistics: {TESTS[FIRST]}",
        columns=[means.get(column, column) for column in table.columns],
        rows=[*table.rows, *across],
        notes=[STATISTICS_LEGEND],
    )


def _runs(groups: Sequence[Group]) -> str:
    return number_range(sorted({len(group.scores(FIRST, "return")) for group in groups}))


def faster_targets_table(records: pd.DataFrame) -> Table:
    """L2C2 on Swingup with and without its value term, at every pace of the target networks."""
    groups = group_records(
        records[
            (records["task"] == "swingup")
            & (records["algorithm"] == "ppo_rpe")
            & records["method"].isin(FASTER_RETURNS)
            & ~records["differences"].str.contains("regularizer.", regex=False)
        ]
    )
    rows = []
    for group in groups:
        same = [g for g in groups if g.first.method == "l2c2_policy" and g.setup == group.setup]
        without = [g for g in same if g is not group]
        rows.append(
            [
                *(group.first.task, group.name, number_range(group.seeds)),
                *(pooled(group, test, "return") for test in (FIRST, SECOND)),
                _faster_published(group),
                improvement_cell([group], without[:1] or [None], FIRST, "return"),
            ]
        )
    columns = ["task", "method", "seeds", "return", "last policy", "in the paper"]
    columns += ["P(returns more than beta=0)"]
    return Table("Faster target networks", columns, rows, [FASTER_LEGEND])


def point(group: Group) -> tuple[float, ...] | None:
    """The paper's action variation and return of a group, then their standard deviations."""
    paper = paper_of(group)
    if paper is None:
        return None
    ends = zip(paper.cell("action_variation"), paper.cell("return"), strict=True)
    return tuple(value for pair in ends for value in pair)


def _is_off(group: Group, quantity: str) -> bool:
    """Tells if late policies are further from the paper's mean than its standard deviation."""
    scores, paper = group.scores(FIRST, quantity), paper_of(group)
    if paper is None or not len(scores):
        return False
    center, deviation = paper.cell(quantity)
    return abs(float(scores.mean()) - center) > deviation


def _published(paper: Published | None, quantity: str) -> str:
    if paper is None:
        return ""
    center, deviation = paper.cell(quantity)
    return f"{number(center, quantity)} ({number(deviation, quantity, center)})"


def _faster_published(group: Group) -> str:
    tau, method = group.settings.get(TAU), group.first.method
    if tau is None:
        return number(PAPER[group.first.task, method].return_mean, "return")
    return number(FASTER_RETURNS[method], "return") if tau == str(FASTER) else ""
