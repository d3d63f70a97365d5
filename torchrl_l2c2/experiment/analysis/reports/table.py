"""The table of groups: means and probabilities of improvement, with 95% intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of
from torchrl_l2c2.experiment.analysis.reports.statistics import (
    Interval,
    Scores,
    bootstrap_interval,
    mean,
    probability_of_improvement,
)
from torchrl_l2c2.experiment.run.finished import TESTS

# The compared quantities, their names in tables, and the names of their probabilities.
COMPARED = {
    "return": ("return", "P(returns more)"),
    "action_variation": ("action variation", "P(smoother)"),
    "sm_asap": ("Sm", "P(smaller Sm)"),
}
INTERVAL_NOTE = (
    "An interval that contains 0.5: the same within seed noise. An interval without a width: all "
    "pairs of runs agree, which can also be chance."
)
LEGEND = (
    "Means over runs with 95% intervals of the stratified bootstrap in brackets (Agarwal et al. "
    "2021). P: the probability that a run is better than a run of the baseline (no regularizer) "
    f"with the same other settings; ties count half. {INTERVAL_NOTE} Action variation: mean change "
    "of the policy's mean action per step; Sm: frequency-weighted spectrum of the actions, which "
    "grows with episode length. Smaller is smoother. Late policies: policies of the last tenth of "
    "training, or of its late_share."
)


@dataclass(frozen=True)
class Table:
    """Cells of text under a title, with notes below.

    Examples:
        >>> print(Table("Squares", ["n", "n²"], [["2", "4"]], ["by hand"]).markdown())
        **Squares**
        <BLANKLINE>
        | n | n² |
        | --- | --- |
        | 2 | 4 |
        <BLANKLINE>
        by hand
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = field(default_factory=list)

    def markdown(self) -> str:
        """Returns the title, a pipe table, and the notes."""
        table = pipe_table([self.columns, *self.rows])
        return "\n\n".join([f"**{self.title}**", table, *self.notes])


def pipe_table(lines: Sequence[Sequence[str]]) -> str:
    """Returns cells as a Markdown table; the first line has the columns' names.

    Examples:
        >>> print(pipe_table([["n", "n²"], ["2", "4"]]))
        | n | n² |
        | --- | --- |
        | 2 | 4 |
    """
    columns, *rows = ([_cell(text) for text in line] for line in lines)
    ruled = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in ruled)


def _cell(text: str) -> str:
    """Text of a cell: without line breaks, and without HTML, which a run's name may have."""
    return " ".join(text.replace("|", "\\|").replace("<", "&lt;").split("\n"))


@dataclass(frozen=True)
class Estimate:
    """A statistic and its 95% interval; no interval if a side or a task has a single run."""

    value: float
    interval: Interval | None

    @classmethod
    def of(cls, statistic: Callable[..., Scores], *scores: Scores) -> Estimate | None:
        """Estimates by the stratified bootstrap with a fixed seed; ``None`` without scores."""
        if not all(len(matrix) for matrix in scores):
            return None
        value, generator = float(statistic(*scores)), np.random.default_rng(0)
        if min((~np.isnan(matrix)).sum(0).min() for matrix in scores) <= 1:
            return cls(value, None)
        return cls(value, bootstrap_interval(statistic, *scores, generator=generator))

    def text(self, write: Callable[[float], str] = "{:.2f}".format) -> str:
        """Returns ``value [lower, upper]``."""
        if self.interval is None:
            return write(self.value)
        return f"{write(self.value)} [{', '.join(map(write, self.interval))}]"


def improvement(
    groups: Sequence[Group], baselines: Sequence[Group], test: str, quantity: str
) -> Estimate | None:
    """Probability that a run is better than a run of the baseline, over tasks.

    Args:
        groups (sequence of Group): A group for each task, which counts with all of its runs.
        baselines (sequence of Group): The baseline, or another method, of the same tasks in this
            order.
        test (str): One of ``TESTS``.
        quantity (str): ``"return"``, or a measure that is better if it is smaller.

    Returns:
        Estimate: ``None`` if a side has less than two such runs of a task: of two runs, one is
        always better.
    """
    sign = 1.0 if quantity == "return" else -1.0
    matrices = []
    for side in (groups, baselines):
        columns = [group.by_seed(test, quantity).values() for group in side]
        if any(len(column) < 2 for column in columns):
            return None
        # Tasks with fewer runs have NaN below them.
        matrices.append(sign * np.array(list(zip_longest(*columns, fillvalue=np.nan))))
    return Estimate.of(probability_of_improvement, *matrices)


def improvement_cell(
    groups: Sequence[Group], baselines: Sequence[Group | None], test: str, quantity: str
) -> str:
    """:func:`improvement` as a cell; empty if it is unknown or a baseline is missing."""
    known = [baseline for baseline in baselines if baseline is not None]
    better = improvement(groups, known, test, quantity) if len(known) == len(groups) else None
    return "" if better is None else better.text()


def known_tests(groups: Sequence[Group]) -> list[str]:
    """The tests that some group has, in the order of ``TESTS``."""
    return [test for test in TESTS if any(len(group.scores(test, "return")) for group in groups)]


def comparison_table(
    test: str, groups: Sequence[Group], center: Callable[..., Scores] = mean
) -> Table:
    """Means and probabilities of improvement over the baseline, with intervals.

    Args:
        test (str): One of ``TESTS``.
        groups (sequence of Group): A row for each.
        center (callable): The mean, or another statistic of ``[..., runs, tasks]``.
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
    return Table(TESTS[test].capitalize(), columns, rows, [LEGEND])


def estimate_cell(estimate: Estimate | None, quantity: str) -> str:
    """An estimate with its interval, in the digits of its quantity; a dash for ``None``."""
    if estimate is None:
        return "-"
    return estimate.text(partial(number, quantity=quantity, like=estimate.value))


def number(value: float, quantity: str, like: float | None = None) -> str:
    """Formats a number with the digits of its quantity; a dash if it is unknown.

    Args:
        value (float): The number.
        quantity (str): Returns of 100 and more have one digit, smaller ones two; other quantities
            have three.
        like (float, optional): The number whose digits it gets, such as the mean of an interval.
    """
    size = abs(value if like is None else like)
    digits = 3 if quantity != "return" else 1 if size >= 100 else 2
    return or_dash(value, f".{digits}f")


def or_dash(value: float, spec: str) -> str:
    """Formats a number; a dash if it is unknown."""
    return "-" if math.isnan(value) else format(value, spec)
