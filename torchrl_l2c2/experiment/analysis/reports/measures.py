"""The field's other measures of smoothness, for every group of runs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.groups import group_records
from torchrl_l2c2.experiment.analysis.reports.tables import Table, number_range, of_runs
from torchrl_l2c2.experiment.run.finished import FinishedRun

# As evaluation.json names them (experiment/evaluate.py): how they are told.
MEASURE_NAMES = {
    "action_rate": "action rate",
    "action_fluctuation_ratio": "AFR",
    "action_jerk": "jerk",
    "roughness": "roughness",
    "sm_caps": "Sm (CAPS)",
    "sm_asap": "Sm (ASAP)",
    "previous_action_gain": "gain on the action before",
    "saturation": "at the bounds",
    "noise_sensitivity": "sensitivity to noise",
}
LEGEND = (
    "Means over the test episodes of the last policy with its mean actions, over seeds; standard "
    "deviations over seeds in brackets. Definitions and units: torchrl_l2c2.metrics, at one action "
    "per unit of time. Sm (ASAP) grows with the length of the episodes; sensitivity is to noise of "
    ".01."
)


def measures_table(runs: Sequence[FinishedRun]) -> Table | None:
    """A row for every group of runs; ``None`` where no run has any of the measures."""
    summaries = {run.record.identity: run.evaluation.get("summary", {}) for run in runs}
    known = [
        name for name in MEASURE_NAMES if any(f"{name}_mean" in each for each in summaries.values())
    ]
    if not known:
        return None
    rows = []
    for group in group_records(run.record for run in runs):
        own = [summaries[record.identity] for record in group.records]
        cells = [_pooled([each.get(f"{name}_mean") for each in own]) for name in known]
        first = group.first
        rows.append([first.task, first.algorithm, group.name, number_range(group.seeds), *cells])
    columns = ["task", "algorithm", "method", "seeds", *(MEASURE_NAMES[name] for name in known)]
    return Table("Other measures of smoothness", columns, rows, [LEGEND])


def _pooled(values: Sequence[float | None]) -> str:
    present = [v for v in values if v is not None and not math.isnan(v)]
    if not present:
        return "-"
    cell = f"{np.mean(present):.3g}"
    if len(present) > 1:
        cell += f" ({np.std(present, ddof=1):.2g})"
    return cell + of_runs(len(present), len(values))
