"""The tables of TD3's presets in ``results/td3.md``."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from studies.cells import seeds_table
from studies.field import TEST
from studies.files import records
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.statistics import mean
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, improvement_cell, pipe_table

FAILED = -300.0
"""Return below which a policy has failed."""

STRENGTHS = (1.0, 0.3, 0.1)
METHODS = {"l2c2": "L2C2", "l2c2_ramp": "L2C2", "cats": "CATS", "caps": "CAPS"}
FIRST_GAIN = {"L2C2": "lambda_min", "CATS": "lambda_temporal", "CAPS": "lambda_temporal"}
RELATIVE = ", relative"
"""Ends the names of methods whose penalty is relative to the action values."""

SETTINGS = {
    "L2C2": "`lambda_min={:g}`, ramp",
    "CATS": "`lambda_temporal={:g}`, ramp",
    "CAPS": "`lambda_temporal={:g}`, `lambda_spatial={:g}`",
    "L2C2, relative": "`lambda_min={:g}`",
    "CATS, relative": "`lambda_temporal={:g}`",
}
CHOSEN = ("L2C2", "CATS", "CAPS")
"""The methods whose strengths the rule of the page chooses."""

GAINS = {
    "L2C2": (10.0,),
    "CATS": (3.0,),
    "CAPS": (1.0, 5.0),
    "L2C2, relative": (0.04,),
    "CATS, relative": (0.04,),
}
"""Gains at strength 1."""

PRESETS = {
    "L2C2": ("L2C2, relative", 1.0),
    "CATS": ("CATS, relative", 1.0),
    "CAPS": ("CAPS", 1.0),
}
"""The settings of the presets: a method above and its strength."""

Setting = tuple[str, float]
"""A method and its strength; ``("baseline", 0.0)`` for the baseline."""

BASELINE: Setting = ("baseline", 0.0)


def name(setting: Setting) -> str:
    """The name of a setting in tables.

    Examples:
        >>> name(("CAPS", 0.1)), name(("baseline", 0.0))
        ('CAPS, `lambda_temporal=0.1`, `lambda_spatial=0.5`', 'baseline')
    """
    method, strength = setting
    if setting == BASELINE:
        return method
    return f"{method}, {SETTINGS[method].format(*(strength * gain for gain in GAINS[method]))}"


def by_setting(runs: pd.DataFrame) -> dict[Setting, Group]:
    """The runs of the candidates by setting, without the runs of the first choice."""
    found: dict[Setting, Group] = {}
    for group in group_records(runs):
        setting = BASELINE
        if group.first.method != "none":
            method = METHODS[group.first.method]
            gain = float(group.settings[f"regularizer.{FIRST_GAIN[method]}"])
            gain *= float(group.settings.get("regularizer.strength", 1.0))
            if "regularizer.relative" in group.settings:
                method += RELATIVE
            # Relative to a constant: the preset, whose strength is 1, has changed.
            setting = method, round(gain / GAINS[method][0], 6)
        if setting in found:
            raise ValueError(f"Expected one setting of {name(setting)}, got two.")
        found[setting] = group
    return found


def test_table() -> str:
    """Every strength that was run on seeds 0 to 9, by the last policy, next to the baseline."""
    groups = by_setting(records("td3").query("seed < 10"))
    columns = ["setting", "return", "failed", "action variation", "P(returns more)", "P(smoother)"]
    rows = [columns]
    for setting in (BASELINE, *((m, s) for m in GAINS for s in STRENGTHS if (m, s) in groups)):
        shown = name(setting)
        if setting in PRESETS.values():
            shown = f"**{shown}** (the preset)"
        rows.append([shown, *_cells(groups[setting], groups[BASELINE])])
    (again,) = group_records(records("td3_again"))
    rows.append(["L2C2, `lambda_min=3`, ramp, again", *_cells(again, groups[BASELINE])])
    return pipe_table(rows)


def _cells(group: Group, baseline: Group) -> list[str]:
    quantities = ("return", "action_variation")
    total, variation = (Estimate.of(mean, group.scores(TEST, each)) for each in quantities)
    assert total is not None and variation is not None
    better = [""] * 2
    if group is not baseline:
        better = [improvement_cell([group], [baseline], TEST, each) for each in quantities]
    failed = f"{failures(group)} of {len(group.seeds)}"
    return [total.text("{:.1f}".format), failed, variation.text("{:.3f}".format), *better]


def failures(group: Group) -> int:
    """The number of runs whose last policy has failed."""
    return int((group.scores(TEST, "return") < FAILED).sum())


def chosen(groups: Mapping[Setting, Group]) -> dict[str, float]:
    """The strength of each method by the rule of the page."""
    found = {}
    for method in CHOSEN:
        tried = [strength for strength in STRENGTHS if (method, strength) in groups]
        kept = [strength for strength in tried if qualifies(groups, (method, strength))]
        found[method] = min(
            kept or [min(tried)],
            key=lambda strength: _mean(groups[method, strength], "action_variation"),
        )
    return found


def qualifies(groups: Mapping[Setting, Group], setting: Setting) -> bool:
    """Checks the return and the failures of a setting."""
    group, baseline = groups[setting], groups[BASELINE]
    least = _mean(baseline, "return") - 0.05 * abs(_mean(baseline, "return"))
    return _mean(group, "return") >= least and failures(group) <= failures(baseline)


def last_policy_table() -> str:
    """The strengths on seeds 110 to 129, by the last policy."""
    groups = by_setting(records("td3").query("seed >= 110"))
    columns = ["setting", "seeds", "mean return", "failed", "mean action variation", "qualifies"]
    rows = [columns]
    for setting in (BASELINE, *((m, s) for m in CHOSEN for s in STRENGTHS)):
        group = groups[setting]
        cells = [str(len(group.seeds)), f"{_mean(group, 'return'):.1f}", str(failures(group))]
        cells.append(f"{_mean(group, 'action_variation'):.3f}")
        cells.append("" if setting == BASELINE else "yes" if qualifies(groups, setting) else "no")
        rows.append([name(setting), *cells])
    return pipe_table(rows)


def first_choice_table() -> str:
    """The candidates of the first choice by seed, of the policies of the last 10% of training."""
    return _by_seed(records("td3").query("100 <= seed < 110"), "late_mean")


def mujoco_strengths_table() -> str:
    """The strengths on InvertedDoublePendulum by seed, by the last policy."""
    return _by_seed(records("td3_mujoco_strength"), TEST)


def _by_seed(runs: pd.DataFrame, policy: str) -> str:
    found = {}
    for group in group_records(runs):
        returns, variations = (
            group.scores(policy, quantity).ravel().tolist()
            for quantity in ("return", "action_variation")
        )
        found[group.name] = returns, variations
    return seeds_table(found)


def _mean(group: Group, quantity: str) -> float:
    return float(group.scores(TEST, quantity).mean())
