"""Published results on the tasks of later methods, and their table with the runs here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd

from studies.cells import number_range, of_runs
from studies.paper import is_of_own_task
from torchrl_l2c2.experiment.analysis.reports.groups import (
    Group,
    baseline_of,
    by_task,
    group_records,
)
from torchrl_l2c2.experiment.analysis.reports.statistics import mean
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    INTERVAL_NOTE,
    Estimate,
    Table,
    estimate_cell,
    improvement_cell,
)
from torchrl_l2c2.experiment.settings.tasks import FIELD_TASKS


class PublishedCell(NamedTuple):
    """Mean return and "Sm" of ten runs, each tested by ten episodes."""

    total: float
    sm: float


# CATS (arXiv 2610.07910), with RL Zoo's settings; by algorithm and method, in the order of tasks.
# Its L2C2 was made with the code of ASAP, which does not follow the paper's equations.
ROWS: dict[tuple[str, str], tuple[tuple[float, float], ...]] = {
    ("ppo", "none"): ((-218, 0.469), (221, 0.209), (2658, 1.162), (3510, 1.682)),
    ("ppo", "caps"): ((-175, 0.421), (206, 0.214), (2440, 0.471), (3626, 0.505)),
    ("ppo", "l2c2_asap"): ((-185, 0.452), (208, 0.211), (2704, 1.502), (3342, 1.744)),
    ("ppo", "cats"): ((-184, 0.343), (227, 0.194), (3002, 0.222), (4071, 0.407)),
    ("ppo", "grad_caps"): ((-191, 0.451), (218, 0.215), (3309, 0.578), (3384, 0.626)),
    ("ppo", "asap"): ((-223, 0.449), (191, 0.213), (2780, 0.441), (3754, 0.490)),
    ("ppo", "lipsnet++"): ((-671, 0.553), (135, 0.144), (1878, 0.543), (2344, 0.993)),
    ("sac", "none"): ((-149, 0.984), (276, 0.424), (2656, 1.507), (4189, 1.268)),
    ("sac", "caps"): ((-177, 0.376), (269, 0.355), (2856, 1.235), (4651, 1.178)),
    ("sac", "l2c2_asap"): ((-150, 1.189), (273, 0.441), (2965, 1.249), (4413, 1.081)),
    ("sac", "cats"): ((-149, 0.291), (278, 0.196), (3046, 0.259), (4714, 0.419)),
    ("sac", "grad_caps"): ((-149, 0.504), (250, 0.371), (2978, 0.898), (4381, 0.905)),
    ("sac", "asap"): ((-148, 0.485), (276, 0.248), (3014, 0.655), (4466, 0.795)),
    ("sac", "lipsnet++"): ((-148, 0.694), (260, 0.358), (2570, 0.886), (4419, 1.093)),
}
PUBLISHED: dict[tuple[str, str, str], PublishedCell] = {
    (task, algorithm, method): PublishedCell(*cell)
    for (algorithm, method), cells in ROWS.items()
    for task, cell in zip(FIELD_TASKS, cells, strict=True)
}
NAMES = {
    "none": "baseline",
    "caps": "CAPS",
    "cats": "CATS",
    "l2c2_asap": "L2C2, ASAP's code",
    "grad_caps": "Grad-CAPS",
    "asap": "ASAP",
    "lipsnet++": "LipsNet++",
}
TEST = "last_mean"
# By what methods are compared, and the columns of the probabilities.
BETTER = {quantity: COMPARED[quantity][1] for quantity in ("return", "sm_asap")}
LEGEND = (
    "Means over seeds of the last policy's test episodes, with its mean actions; 95% intervals "
    "of the bootstrap over seeds in brackets. Sm as in the published table: `(2 / N) sum_i f_i "
    "|FFT_i|` at one action per unit of time, averaged over the action's dimensions; unlike the "
    "action variation it grows with the length N of an episode. P: the probability that a run is "
    "better than a run of the baseline with the same other settings (ties count half). "
    f"{INTERVAL_NOTE} Published: "
    "CATS (arXiv 2610.07910), ten seeds by ten episodes; its L2C2 is ASAP's code, which does not "
    "follow the paper's equations."
)


def field_table(records: pd.DataFrame) -> Table:
    """A row for every group of runs on these tasks, then the other published rows."""
    groups = field_groups(records)
    rows = []
    for together in by_task(groups):
        task, algorithm = together[0].first.task, together[0].first.algorithm
        rows += [_row(group, baseline_of(group, groups)) for group in together]
        rows += [
            [task, algorithm, name, *[""] * 6, *_published(PUBLISHED[task, algorithm, method])]
            for method, name in NAMES.items()
            if method not in {group.first.method for group in together}
        ]
    columns = ["task", "algorithm", "method", "seeds", *(name for name, _ in COMPARED.values())]
    columns += [*BETTER.values(), "published: return", "published: Sm"]
    return Table("Next to the published table", columns, rows, [LEGEND])


def field_groups(records: pd.DataFrame) -> list[Group]:
    """Groups of the records on these tasks with PPO or SAC."""
    known = {(task, algorithm) for task, algorithm, _ in PUBLISHED}
    pairs = zip(records["task"], records["algorithm"], strict=True)
    return group_records(records[[pair in known for pair in pairs]])


def published_of(group: Group) -> PublishedCell | None:
    """The published results of a group's task and method; ``None`` without any."""
    first = group.first
    if not is_of_own_task(group):
        return None
    return PUBLISHED.get((first.task, first.algorithm, first.method))


def point(group: Group) -> Sequence[float] | None:
    """The published Sm and return of a group."""
    cell = published_of(group)
    return None if cell is None else (cell.sm, cell.total)


def known_cell(group: Group, quantity: str, cell: str) -> str:
    """A cell that names the number of its runs, if some lack the quantity."""
    known = len(group.scores(TEST, quantity))
    return cell + of_runs(known, len(group.runs)) if known else cell


def _row(group: Group, baseline: Group | None) -> list[str]:
    first = group.first
    cells = [first.task, first.algorithm, group.name, number_range(group.seeds)]
    for quantity in COMPARED:
        estimate = Estimate.of(mean, group.scores(TEST, quantity))
        cells.append(known_cell(group, quantity, estimate_cell(estimate, quantity)))
    cells += [improvement_cell([group], [baseline], TEST, quantity) for quantity in BETTER]
    return [*cells, *_published(published_of(group))]


def _published(cell: PublishedCell | None) -> tuple[str, str]:
    return ("", "") if cell is None else (f"{cell.total:g}", f"{cell.sm:.3f}")
