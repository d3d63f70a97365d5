"""Settings in order over several tasks: what each smooths there, and what it costs in return."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from torchrl_l2c2.experiment.reports.field import PUBLISHED
from torchrl_l2c2.experiment.reports.groups import Group, baseline_of, group_records
from torchrl_l2c2.experiment.reports.runs import FinishedRun
from torchrl_l2c2.experiment.reports.tables import Table, number_range

LEGEND = (
    "Beside vanilla's runs of the same seeds and other settings, smoothest first; tests of the "
    "last policy with its mean actions. Return: the difference of the means over seeds, in parts "
    "of vanilla's size, mean over tasks. Sm: the ratio of the means over seeds, geometric mean "
    "over tasks; 1 is no smoother."
)


class Beside(NamedTuple):
    """A setting beside vanilla, on one task."""

    task: str
    gained: float
    sm: float
    seeds: list[int]


def choice_table(runs: Sequence[FinishedRun]) -> Table | None:
    """A row for every setting of a regularizer that ran beside vanilla, over the field's tasks.

    Args:
        runs (sequence of FinishedRun): of any tasks; others are passed over.

    Returns:
        Table: ``None`` where nothing is to be compared.
    """
    ours = [run for run in runs if (run.task, run.algorithm, "none") in PUBLISHED]
    summaries = {run.record.identity: run.evaluation.get("summary", {}) for run in ours}
    settings: dict[tuple[str, ...], list[Beside]] = defaultdict(list)
    groups = group_records(run.record for run in ours)
    for group in groups:
        vanilla = baseline_of(group, groups)
        beside = None if vanilla is None else _beside(group, vanilla, summaries)
        if beside is not None:
            settings[group.first.algorithm, group.name].append(beside)
    if not settings:
        return None
    rows = [
        [*setting, *_cells(tasks)]
        # What ran on most tasks comes first: other means are of other tasks.
        for setting, tasks in sorted(
            settings.items(), key=lambda item: (item[0][0], -len(item[1]), _sm(item[1]))
        )
    ]
    columns = ["algorithm", "method", "tasks", "seeds"]
    columns += [f"{what}{where}" for what in ("return", "Sm") for where in ("", ", worst task")]
    return Table("In order over tasks", columns, rows, [LEGEND])


def _beside(
    group: Group, vanilla: Group, summaries: Mapping[tuple[str | int, ...], Mapping[str, float]]
) -> Beside | None:
    def figures(of: Group) -> dict[int, np.ndarray]:
        read = {record.seed: summaries[record.identity] for record in of.records}
        pairs = {
            seed: np.array([summary.get(name, np.nan) for name in ("return_mean", "sm_asap_mean")])
            for seed, summary in read.items()
        }
        return {seed: pair for seed, pair in pairs.items() if not np.isnan(pair).any()}

    ours, theirs = figures(group), figures(vanilla)
    seeds = sorted(ours.keys() & theirs.keys())
    if not seeds:
        return None
    (total, sm), (their_total, their_sm) = (
        np.mean([side[seed] for seed in seeds], axis=0) for side in (ours, theirs)
    )
    gained = float((total - their_total) / abs(their_total))
    return Beside(group.first.task, gained, float(sm / their_sm), seeds)


def _sm(tasks: Sequence[Beside]) -> float:
    return float(np.exp(np.mean(np.log([each.sm for each in tasks]))))


def _cells(tasks: Sequence[Beside]) -> list[str]:
    least, roughest = min(tasks, key=lambda t: t.gained), max(tasks, key=lambda t: t.sm)
    return [
        ", ".join(each.task for each in tasks),
        "; ".join(dict.fromkeys(number_range(each.seeds) for each in tasks)),
        f"{np.mean([each.gained for each in tasks]):+.0%}",
        f"{least.gained:+.0%} {least.task}",
        f"{_sm(tasks):.2f}",
        f"{roughest.sm:.2f} {roughest.task}",
    ]
