"""Groups against vanilla: interquartile means and probabilities of improvement, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.reports.groups import Group, baseline_of, over_tasks
from torchrl_l2c2.experiment.reports.records import QUANTITIES, TESTS
from torchrl_l2c2.experiment.reports.statistics import (
    Interval,
    Scores,
    bootstrap_interval,
    interquartile_mean,
    mean_and_deviation,
    probability_of_improvement,
)
from torchrl_l2c2.experiment.reports.tables import Table, number, number_range

READING = (
    "An interval that contains .50 does not separate the two; one without a width says that all "
    "pairs agree, not that chance is ruled out."
)
# What is better: a larger return, a smaller action variation.
SIGNS = {"return": 1.0, "action_variation": -1.0}


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
        baselines (sequence of Group): vanilla, or another method, of the same tasks in this order.
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


def improvements_over_tasks(
    groups: Sequence[Group], test: str
) -> list[tuple[str, str, list[Group], list[str]]]:
    """Of methods that several tasks have: probabilities, unlike means, need no common scale.

    Args:
        groups (sequence of Group): of several tasks.
        test (str): one of ``TESTS``.

    Returns:
        list: the algorithm, the method, its group of each task, and of each of ``QUANTITIES`` how
        probable it is that a run is better than one of vanilla, the mean over these tasks, with
        its interval.
    """
    vanilla = {
        group: baseline
        for group in groups
        if (baseline := baseline_of(group, groups)) is not None
        and all(len(side.scores(test, "return")) for side in (group, baseline))
    }
    found = []
    for algorithm, name, ours in over_tasks(vanilla):
        if len(ours) > 1:
            theirs = [vanilla[group] for group in ours]
            better = [probability(improvement(ours, theirs, test, q)) for q in QUANTITIES]
            found.append((algorithm, name, ours, better))
    return found


def statistics_tables(groups: Sequence[Group]) -> list[Table]:
    """Interquartile means and probabilities of improvement, a table for each test there is."""
    known = [f for f in TESTS if any(len(group.scores(f, "return")) for group in groups)]
    return [statistics_table(test, groups) for test in known]


def statistics_table(test: str, groups: Sequence[Group]) -> Table:
    """Interquartile means, and probabilities of improvement over vanilla, of one test.

    Args:
        test (str): one of ``TESTS``.
        groups (sequence of Group): a row each, and one for each method that several tasks have.
    """
    columns = ["task", "algorithm", "method", "runs"]
    for quantity, better in zip(QUANTITIES.values(), ("returns more", "smoother"), strict=True):
        columns += [f"{quantity}: interquartile mean", f"P({better})"]
    rows = [_statistics_row(test, group, baseline_of(group, groups)) for group in groups]
    rows += _across_tasks(test, groups)
    notes = [
        "95% intervals of the stratified bootstrap in brackets (Agarwal et al. 2021). P: the "
        "probability that a run is better than a run of vanilla with the same other settings "
        f"(ties count half). {READING}"
    ]
    return Table(f"Statistics: {TESTS[test]}", columns, rows, notes)


def _statistics_row(test: str, group: Group, baseline: Group | None) -> list[str]:
    runs = str(len(group.scores(test, "return")))
    cells = [group.first.task, group.first.algorithm, group.name, runs]
    for quantity in QUANTITIES:
        center = Estimate.of(interquartile_mean, group.scores(test, quantity))
        better = improvement([group], [baseline], test, quantity) if baseline else None
        cells += [estimate_cell(center, quantity), probability(better)]
    return cells


def _across_tasks(test: str, groups: Sequence[Group]) -> list[list[str]]:
    rows = []
    for algorithm, name, ours, better in improvements_over_tasks(groups, test):
        runs = number_range(sorted({len(group.scores(test, "return")) for group in ours}))
        rows.append([f"{len(ours)} tasks", algorithm, name, runs, "", better[0], "", better[1]])
    return rows


def summary(groups: Sequence[Group]) -> list[dict[str, Any]]:
    """Every group's statistics as plain values, for a JSON file."""
    return [_summary(group, baseline_of(group, groups)) for group in groups]


def _summary(group: Group, baseline: Group | None) -> dict[str, Any]:
    statistics: dict[str, Any] = {}
    for test in TESTS:
        for quantity in (*QUANTITIES, *(["sm_asap"] if test == "last_mean" else [])):
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
        "paper": first.paper._asdict() if first.paper else None,
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
    """With its interval, and the digits that its quantity is told with; a dash without one."""
    if estimate is None:
        return "-"
    return estimate.text(partial(number, quantity=quantity, beside=estimate.value))


def probability(estimate: Estimate | None) -> str:
    """Of an improvement, with its interval; empty where there is none."""
    return "" if estimate is None else estimate.text(lambda value: f"{value:.2f}")
