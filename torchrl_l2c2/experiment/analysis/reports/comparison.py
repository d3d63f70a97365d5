"""Groups compared: means and probabilities of improvement over the baseline, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of, over_tasks
from torchrl_l2c2.experiment.analysis.reports.statistics import (
    Interval,
    Scores,
    bootstrap_interval,
    interquartile_mean,
    mean,
    mean_and_deviation,
    probability_of_improvement,
)
from torchrl_l2c2.experiment.analysis.reports.tables import Table, number, number_range
from torchrl_l2c2.experiment.run.finished import TESTS

# The compared quantities, their names in tables, and the names of their probabilities.
COMPARED = {
    "return": ("return", "P(returns more)"),
    "sm_asap": ("Sm", "P(smaller Sm)"),
    "action_variation": ("action variation", "P(smoother)"),
}
# Larger returns and smaller action variations are better.
SIGNS = {"return": 1.0, "action_variation": -1.0}
INTERVAL_NOTE = (
    "An interval that contains .50 does not separate the two; one without a width says that all "
    "pairs agree, not that chance is ruled out."
)
LEGEND = (
    "Means over runs with 95% intervals of the stratified bootstrap in brackets (Agarwal et al. "
    "2021). P: the probability that a run is better than a run of vanilla (no regularizer) with "
    f"the same other settings; ties count half. {INTERVAL_NOTE} Action variation: mean change of "
    "the policy's mean action per step; Sm: frequency-weighted spectrum of the actions, which "
    "grows with episode length. Smaller is smoother. Late policies: policies of the last tenth of "
    "training, or of its late_share."
)


@dataclass(frozen=True)
class Estimate:
    """A statistic and its 95% interval; where a side or a task has a single run there is none."""

    value: float
    interval: Interval | None

    @classmethod
    def of(cls, statistic: Callable[..., Scores], *scores: Scores) -> Estimate | None:
        """By the stratified bootstrap, which is seeded: the same scores, the same ends."""
        if not all(len(matrix) for matrix in scores):
            return None
        value, generator = float(statistic(*scores)), np.random.default_rng(0)
        if min((~np.isnan(matrix)).sum(0).min() for matrix in scores) <= 1:
            return cls(value, None)
        return cls(value, bootstrap_interval(statistic, *scores, generator=generator))

    def text(self, write: Callable[[float], str]) -> str:
        """``value [lower, upper]``."""
        if self.interval is None:
            return write(self.value)
        return f"{write(self.value)} [{', '.join(map(write, self.interval))}]"


def improvement(
    groups: Sequence[Group], baselines: Sequence[Group], test: str, quantity: str
) -> Estimate | None:
    """Probability that a run is better than one of the baseline, over tasks.

    Args:
        groups (sequence of Group): one of each task, which counts with all of its runs.
        baselines (sequence of Group): the baseline, or another method, of the same tasks in this
            order.
        test (str): one of ``TESTS``.
        quantity (str): ``"return"``, or a measure of which less is better.

    Returns:
        Estimate: ``None`` where a task has no such runs.
    """
    sign = SIGNS.get(quantity, -1.0)
    matrices = [sign * _matrix(side, test, quantity) for side in (groups, baselines)]
    if any(np.isnan(matrix).all(0).any() for matrix in matrices):
        return None
    return Estimate.of(probability_of_improvement, *matrices)


def improvement_cell(
    groups: Sequence[Group], baselines: Sequence[Group | None], test: str, quantity: str
) -> str:
    """:func:`improvement` as a table's cell; empty where there is none, or no baseline."""
    known = [baseline for baseline in baselines if baseline is not None]
    better = improvement(groups, known, test, quantity) if len(known) == len(groups) else None
    return "" if better is None else better.text("{:.2f}".format)


def improvements_over_tasks(
    groups: Sequence[Group], test: str, quantities: Iterable[str]
) -> list[tuple[str, str, list[Group], list[str]]]:
    """Probabilities of improvement over several tasks; unlike means they need no common scale.

    Args:
        groups (sequence of Group): Groups of several tasks.
        test (str): One of ``TESTS``.
        quantities (iterable of str): Keys of ``COMPARED``.

    Returns:
        list: for every method that several tasks have, the algorithm, the method, its group of each
        task, and a cell for each quantity: the mean probability over these tasks.
    """
    baselines = {
        group: baseline
        for group in groups
        if (baseline := baseline_of(group, groups)) is not None
        and all(len(side.scores(test, "return")) for side in (group, baseline))
    }
    return [
        (
            *(algorithm, name, ours),
            [improvement_cell(ours, [baselines[g] for g in ours], test, q) for q in quantities],
        )
        for algorithm, name, ours in over_tasks(baselines)
        if len(ours) > 1
    ]


def known_tests(groups: Sequence[Group]) -> list[str]:
    """The tests that some group has, in the order of ``TESTS``."""
    return [test for test in TESTS if any(len(group.scores(test, "return")) for group in groups)]


def comparison_table(
    test: str, groups: Sequence[Group], center: Callable[..., Scores] = mean
) -> Table:
    """Means and probabilities of improvement over the baseline, with intervals.

    Args:
        test (str): one of ``TESTS``.
        groups (sequence of Group): a row each, then one for each method that several tasks have.
        center (callable): the mean, or another statistic of ``[..., runs, tasks]``.
    """
    known = [name for name in COMPARED if any(len(group.scores(test, name)) for group in groups)]
    columns = ["task", "algorithm", "method", "runs"]
    columns += [column for name in known for column in COMPARED[name]]
    rows = []
    for group in groups:
        cells = [group.first.task, group.first.algorithm, group.name]
        cells.append(str(len(group.scores(test, "return"))))
        for name in known:
            cells.append(estimate_cell(Estimate.of(center, group.scores(test, name)), name))
            cells.append(improvement_cell([group], [baseline_of(group, groups)], test, name))
        rows.append(cells)
    for algorithm, name, ours, better in improvements_over_tasks(groups, test, known):
        runs = number_range(sorted({len(group.scores(test, "return")) for group in ours}))
        across = [cell for each in better for cell in ("", each)]
        rows.append([f"{len(ours)} tasks", algorithm, name, runs, *across])
    return Table(TESTS[test].capitalize(), columns, rows, [LEGEND])


def summary(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Every group's statistics as plain values, for a JSON file."""
    return [_summary(group, baseline_of(group, groups)) for group in groups]


def _summary(group: Group, baseline: Group | None) -> dict[str, Any]:
    statistics: dict[str, Any] = {}
    for test in TESTS:
        for quantity in COMPARED:
            scores = group.scores(test, quantity)
            if not len(scores):
                continue
            center, deviation = mean_and_deviation(scores)
            better = improvement([group], [baseline], test, quantity) if baseline else None
            statistics[f"{test}_{quantity}"] = {
                "mean": center.item(),
                "standard_deviation": deviation.item() if len(scores) > 1 else None,
                "interquartile_mean": _plain(Estimate.of(interquartile_mean, scores)),
                "probability_of_improvement": _plain(better),
                "by_seed": {str(s): v for s, v in group.by_seed(test, quantity).items()},
            }
    first = group.first
    return {
        "task": first.task,
        "algorithm": first.algorithm,
        "method": first.method,
        "name": group.name,
        "settings": first.settings,
        "differences": first.differences,
        "length": first.length,
        "seeds": group.seeds,
        "statistics": statistics,
    }


def _plain(estimate: Estimate | None) -> dict[str, Any] | None:
    return None if estimate is None else {"value": estimate.value, "interval": estimate.interval}


def _matrix(groups: Sequence[Group], test: str, quantity: str) -> Scores:
    """``[runs, tasks]``: runs that have the test, in the order of seeds; NaN below the fewer."""
    found = [sorted(group.by_seed(test, quantity).items()) for group in groups]
    columns = [[value for _, value in each] for each in found]
    return np.array(list(zip_longest(*columns, fillvalue=np.nan))).reshape(-1, len(groups))


def estimate_cell(estimate: Estimate | None, quantity: str) -> str:
    """Cell of an estimate with its interval, in the digits of its quantity; a dash for ``None``."""
    if estimate is None:
        return "-"
    return estimate.text(partial(number, quantity=quantity, like=estimate.value))
