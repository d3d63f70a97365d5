"""The table of ``results/relative.md``: presets with and without ``relative=True``."""

from __future__ import annotations

from studies.cells import number_range
from studies.field import TEST
from studies.files import records
from studies.td3 import failures
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.statistics import mean
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, improvement_cell, pipe_table

SHAKES = 0.2
"""Action variation above which a policy of InvertedDoublePendulum shakes."""

FAILURES = ("InvertedDoublePendulum-v5", "Pendulum-v1", "pendulum")
"""Tasks on which a run can fail by the rules of the page."""


def table() -> str:
    """Every setting on the seeds that decide, by the last policy, compared with the preset."""
    columns = ["task", "algorithm", "setting", "seeds", "return", "P(returns more)", "failed"]
    rows = [[*columns, "action variation", "P(smoother)", "Sm"]]
    groups = group_records(records("relative").query("seed >= 100"))
    presets = {_method(group): group for group in groups if is_preset(group)}
    for group in groups:
        task, algorithm, _ = _method(group)
        preset = presets.get(_method(group))  # Its runs may be missing.
        better = [""] * 2
        if preset is not None and group is not preset:
            quantities = ("return", "action_variation")
            better = [improvement_cell([group], [preset], TEST, each) for each in quantities]
        mark = " (the preset before)" if group is preset else ""
        cells = [task, algorithm, group.name + mark]
        cells += [number_range(group.seeds), _estimate(group, "return", "{:.1f}"), better[0]]
        cells += [f"{failed(group)} of {len(group.seeds)}" if task in FAILURES else ""]
        cells += [_estimate(group, "action_variation", "{:.3f}"), better[1]]
        rows.append([*cells, _estimate(group, "sm_asap", "{:.3f}")])
    return pipe_table(rows)


def is_preset(group: Group) -> bool:
    """Checks whether a group has the settings of the preset before these runs."""
    return group.first.method != "l2c2_ramp" and "regularizer.relative" not in group.settings


def _method(group: Group) -> tuple[str, str, str]:
    """The task, the algorithm and the method, without its settings."""
    return group.first.task, group.first.algorithm, group.first.method.removesuffix("_ramp")


def failed(group: Group) -> int:
    """The number of runs that fail or, on InvertedDoublePendulum, shake."""
    if group.first.task == "InvertedDoublePendulum-v5":
        return int((group.scores(TEST, "action_variation") > SHAKES).sum())
    return failures(group)


def _estimate(group: Group, quantity: str, form: str) -> str:
    found = Estimate.of(mean, group.scores(TEST, quantity))
    return "" if found is None else found.text(form.format)
