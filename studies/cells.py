"""Cells of the tables in ``results/``, and rows over several tasks."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from torchrl_l2c2.experiment.analysis.reports.groups import Group, baseline_of
from torchrl_l2c2.experiment.analysis.reports.records import to_csv
from torchrl_l2c2.experiment.analysis.reports.table import improvement_cell, number, pipe_table


def number_range(values: Sequence[int]) -> str:
    """Whole numbers, three and more in a row shortened.

    Examples:
        >>> number_range([0, 1, 2, 3, 7, 8])
        '0-3, 7, 8'
    """
    spans: list[list[int]] = []
    for value in sorted(values):
        if spans and value == spans[-1][-1] + 1:
            spans[-1].append(value)
        else:
            spans.append([value])
    return ", ".join(
        f"{span[0]}-{span[-1]}" if len(span) > 2 else ", ".join(map(str, span)) for span in spans
    )


def of_runs(known: int, all_runs: int) -> str:
    """The end of a cell with a mean of fewer runs than the group has."""
    return f", of {known} runs" if known < all_runs else ""


def pooled(group: Group, test: str, quantity: str) -> str:
    """The mean of a group, with the standard deviation over its seeds in brackets."""
    scores = group.scores(test, quantity)
    if not len(scores):
        return "-"
    center = float(scores.mean())
    cell = number(center, quantity)
    if len(scores) > 1:
        cell += f" ({number(float(scores.std(ddof=1)), quantity, center)})"
    return cell + of_runs(len(scores), len(group.runs))


def over_tasks(groups: Iterable[Group]) -> list[tuple[str, str, list[Group]]]:
    """Groups of several tasks with the same name and settings of the regularizer.

    Other settings may differ between tasks, as in a preset.

    Returns:
        list: the algorithm, the name, and a group for each task.
    """
    rows: dict[tuple[Any, ...], list[Group]] = defaultdict(list)
    for group in groups:
        own = tuple(pair for pair in group.settings.items() if pair[0].startswith("regularizer."))
        rows[group.first.algorithm, group.name, own].append(group)
    return [(algorithm, name, found) for (algorithm, name, _), found in rows.items()]


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
    found = []
    for algorithm, name, ours in over_tasks(baselines):
        theirs = [baselines[group] for group in ours]
        cells = [improvement_cell(ours, theirs, test, quantity) for quantity in quantities]
        if len(ours) > 1:
            found.append((algorithm, name, ours, cells))
    return found


def regrouped(groups: Iterable[Group]) -> pd.DataFrame:
    """The records of groups in one table."""
    return pd.concat([group.runs for group in groups], ignore_index=True)


def digest(groups: Iterable[Group]) -> str:
    """A code of the records of groups, for the description of their picture."""
    return hashlib.sha256(to_csv(regrouped(groups))).hexdigest()[:12]


def seeds_table(settings: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> str:
    """Markdown table of every run of some settings, with their means.

    Args:
        settings (Mapping): Returns and action variations by seed, by the setting's name.
    """
    columns = ["setting", "return by seed", "action variation by seed"]
    columns += ["mean return", "mean action variation"]
    rows = [columns]
    for name, (returns, variations) in settings.items():
        each = [", ".join(f"{score:.0f}" for score in returns)]
        each.append(", ".join(f"{score:.3f}" for score in variations))
        rows.append([name, *each, f"{np.mean(returns):.1f}", f"{np.mean(variations):.3f}"])
    return pipe_table(rows)
