"""Table of gains that follow a target: the target, the action variation, and the return."""

from __future__ import annotations

import math

import pandas as pd

from studies.cells import number_range, pooled, regrouped
from torchrl_l2c2.experiment.analysis.reports.groups import (
    Group,
    baseline_of,
    by_task,
    group_records,
)
from torchrl_l2c2.experiment.analysis.reports.table import Table, number, or_dash
from torchrl_l2c2.experiment.run.finished import QUANTITIES

# The gain follows the target in training episodes; a deployed policy should have it, too.
FOLLOWED, DEPLOYED = "late_sampled", "last_mean"
LEGEND = (
    "Means over seeds, standard deviations in brackets. Followed: the action variation of "
    "training's own episodes, with sampled actions, in its last tenth or late_share, by which "
    "the gain was set; off by: the distance of its mean from the target, relative to the target. "
    "Then the last policy's test, with its mean actions. Below the runs with a target are those "
    "of the baseline with the same other settings."
)


def gain_targets_table(records: pd.DataFrame) -> Table:
    """A row for every target of the action variation, and for the baseline of the same settings."""
    groups = group_records(records)
    following = [group for group in groups if _asked(group) is not None]
    baselines = (baseline_of(group, groups) for group in following)
    shown = dict.fromkeys(group for group in (*following, *baselines) if group is not None)
    # New names: only differences between these groups count. The baseline is the last row.
    named = group_records(regrouped(shown)) if shown else []
    rows = [
        _row(group)
        for together in by_task(named)
        for group in sorted(together, key=lambda group: group.first.method == "none")
    ]
    columns = ["task", "algorithm", "method", "seeds", "target", "followed", "off by", "return"]
    columns += ["policy scale", "last policy: action variation", "return"]
    return Table("Targets of the action variation", columns, rows, [LEGEND])


def _asked(group: Group) -> float | None:
    own = group.settings
    if own.get("regularizer.gain") != "target":
        return None
    return float(own["regularizer.gain_target"])


def _row(group: Group) -> list[str]:
    return [
        *(group.first.task, group.first.algorithm, group.name, number_range(group.seeds)),
        *_followed(group),
        *(pooled(group, FOLLOWED, quantity) for quantity in ("return", "policy_scale")),
        *(pooled(group, DEPLOYED, quantity) for quantity in reversed(QUANTITIES)),
    ]


def _followed(group: Group) -> list[str]:
    asked, scores = _asked(group), group.scores(FOLLOWED, "action_variation")
    reached = pooled(group, FOLLOWED, "action_variation")
    if asked is None:
        return ["", reached, ""]
    off = float(scores.mean()) / asked - 1 if len(scores) else math.nan
    # A sum with zero has no sign of its own: no "-0%".
    return [number(asked, "action_variation"), reached, or_dash(round(off, 2) + 0.0, "+.0%")]
