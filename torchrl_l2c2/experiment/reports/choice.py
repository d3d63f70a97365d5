"""Settings in order over several tasks: what each smooths there, and what it costs in return."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from torchrl_l2c2.experiment.reports.comparison import READING, improvement, probability
from torchrl_l2c2.experiment.reports.field import BETTER, field_groups
from torchrl_l2c2.experiment.reports.groups import Group, baseline_of, over_tasks
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table, number_range, or_dash

LEGEND = (
    "Compared with vanilla's runs of the same seeds and other settings, smoothest first; the "
    "last policy's test episodes, with its mean actions. Return: the difference of the means "
    "over seeds, relative to the size of vanilla's, averaged over tasks. Sm: the ratio of the "
    "means over seeds, geometric mean over tasks; 1 is no smoother. P: the probability that a "
    "run is better than a run of vanilla (all pairs of runs, ties count half), averaged over "
    f"tasks. {READING}"
)


class Beside(NamedTuple):
    """A setting beside vanilla, on one task."""

    group: Group
    vanilla: Group
    gained: float
    sm: float
    seeds: list[int]

    @property
    def task(self) -> str:
        """What both ran on."""
        return self.group.first.task


def choice_table(records: Sequence[Record]) -> Table | None:
    """A row for every setting of a regularizer that ran beside vanilla, over the field's tasks.

    Args:
        records (sequence of Record): of any tasks; others are passed over.

    Returns:
        Table: ``None`` where nothing is to be compared.
    """
    groups = field_groups(records)
    compared = {
        group: beside
        for group in groups
        if (vanilla := baseline_of(group, groups)) is not None
        and (beside := _beside(group, vanilla)) is not None
    }
    if not compared:
        return None
    settings = [
        (algorithm, name, [compared[group] for group in row])
        for algorithm, name, row in over_tasks(compared)
    ]
    # What ran on most tasks comes first: other means are of other tasks.
    settings.sort(
        key=lambda setting: (
            setting[0],
            -len(setting[2]),
            np.nan_to_num(_sm(setting[2]), nan=np.inf),
        )
    )
    rows = [[algorithm, name, *_cells(tasks)] for algorithm, name, tasks in settings]
    columns = ["algorithm", "method", "tasks", "seeds"]
    columns += [f"{what}{where}" for what in ("return", "Sm") for where in ("", ", worst task")]
    columns += BETTER.values()
    return Table("In order over tasks", columns, rows, [LEGEND])


def _beside(group: Group, vanilla: Group) -> Beside | None:
    values = [
        side.by_seed("last_mean", quantity)
        for quantity in ("return", "sm_asap")
        for side in (group, vanilla)
    ]
    seeds = sorted(set.intersection(*map(set, values)))
    if not seeds:
        return None
    total, their_total, sm, their_sm = (np.mean([f[seed] for seed in seeds]) for f in values)
    # Not beside nothing: that has no parts.
    gained = float((total - their_total) / abs(their_total)) if their_total else math.nan
    ours, theirs = (
        Group(tuple(r for r in side.records if r.seed in seeds), side.name)
        for side in (group, vanilla)
    )
    # Of policies that never move there is no ratio, or none that has a logarithm.
    return Beside(ours, theirs, gained, float(sm / their_sm) if sm * their_sm else math.nan, seeds)


def _sm(tasks: Sequence[Beside]) -> float:
    return float(np.exp(np.mean(np.log([each.sm for each in tasks]))))


def _cells(tasks: Sequence[Beside]) -> list[str]:
    ours, theirs = ([getattr(each, side) for each in tasks] for side in ("group", "vanilla"))
    gained, rough = [each.gained for each in tasks], [each.sm for each in tasks]
    # Of NumPy's, what is not a number is the worst: it may be.
    least, roughest = tasks[int(np.argmin(gained))], tasks[int(np.argmax(rough))]
    return [
        ", ".join(each.task for each in tasks),
        "; ".join(dict.fromkeys(number_range(each.seeds) for each in tasks)),
        or_dash(float(np.mean(gained)), "+.0%"),
        f"{or_dash(least.gained, '+.0%')} {least.task}",
        or_dash(_sm(tasks), ".2f"),
        f"{or_dash(roughest.sm, '.2f')} {roughest.task}",
        *(probability(improvement(ours, theirs, "last_mean", quantity)) for quantity in BETTER),
    ]
