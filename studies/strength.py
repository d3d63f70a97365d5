"""Picture and table of the strength against smoothness and return.

``python -m studies.strength`` reads ``strength.csv`` in ``results/``. It writes ``strength.svg``,
and the tables of ``results/strength.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from studies.cells import number_range
from studies.field import TEST
from studies.files import ROOT, records, write_parts
from studies.methods import choice_table
from torchrl_l2c2.experiment.analysis.reports.figures import save, subplots
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.records import merge
from torchrl_l2c2.experiment.analysis.reports.table import COMPARED, number, pipe_table

PAGE = ROOT / "results" / "strength.md"
PICTURE = ROOT / "results" / "strength.svg"
MEASURES = ("action_variation", "sm_asap", "return")
SEEDS = 3
CANDIDATES = range(100, 105)  # Seeds that choose a preset.
SETTING = "regularizer.strength"


class Curve(NamedTuple):
    """The runs of a task, from the baseline to the largest strength.

    Attributes:
        label: Task and algorithm.
        groups: Groups by strength; 0 is the baseline.
    """

    label: str
    groups: dict[float, Group]

    def means(self, measure: str) -> list[float]:
        """The mean over seeds for each strength."""
        return [float(group.scores(TEST, measure).mean()) for group in self.groups.values()]


def shown() -> pd.DataFrame:
    """The records of the strengths, the baselines of other tables, and the preset on Hopper."""
    own, others = records("strength"), records("field", "sac_pendulum")
    own = own[own["seed"] < SEEDS]
    others = merge(others[others["method"] == "none"], _references("hopper"))
    settings = ["task", "algorithm", "length"]
    same = pd.MultiIndex.from_frame(others[settings]).isin(pd.MultiIndex.from_frame(own[settings]))
    return merge(own, others[same & (others["seed"] < SEEDS)])


def candidates() -> pd.DataFrame:
    """The records that choose a preset, also from other tables with the same settings."""
    found = merge(records("strength"), _references("one_gain", "hopper_targets"))
    return found[found["seed"].isin(CANDIDATES)]


def _references(*names: str) -> pd.DataFrame:
    """The baselines in these files, and the runs with PPO's preset under its former name."""
    found = records(*names)
    preset = found["differences"].str.contains("lambda_min=1 .*=mse")
    return found[(found["method"] == "none") | ((found["method"] == "l2c2_ramp") & preset)]


def curves(found: pd.DataFrame) -> list[Curve]:
    """A curve for each task and algorithm, on the first seeds."""
    by_task: dict[str, dict[float, Group]] = {}
    for group in group_records(found[found["seed"] < SEEDS]):
        first = group.first
        strength = 0.0 if first.method == "none" else float(group.settings.get(SETTING, 1.0))
        label = f"{first.task}, {first.algorithm}"
        if strength in by_task.setdefault(label, {}):
            raise ValueError(f"Expected one setting of {label} at strength {strength:g}, got two.")
        by_task[label][strength] = group
    return [Curve(label, dict(sorted(groups.items()))) for label, groups in by_task.items()]


def table(drawn: Sequence[Curve]) -> str:
    """A row for each task and strength: the means over seeds."""
    columns = ["task", "strength", "seeds", *(COMPARED[name][0] for name in COMPARED)]
    lines = [columns]
    for curve in drawn:
        for strength, group in curve.groups.items():
            cells = [curve.label, f"{strength:g}" if strength else "0 (baseline)"]
            cells.append(number_range(group.seeds))
            for name in COMPARED:
                cells.append(number(float(group.scores(TEST, name).mean()), name))
            lines.append(cells)
    return pipe_table(lines)


def draw(drawn: Sequence[Curve], path: Path) -> None:
    """Draws a row of three panels for each task."""
    size = (3.4 * len(MEASURES), 2.5 * len(drawn) + 0.6)
    figure, axes = subplots(len(MEASURES), len(drawn), size)
    figure.set_facecolor("white")
    for row, curve in enumerate(drawn):
        for column, measure in enumerate(MEASURES):
            axis = axes[row * len(MEASURES) + column]
            _draw_panel(axis, curve, measure)
            axis.set_title(curve.label, fontsize=10)
            axis.set_ylabel(COMPARED[measure][0])
            if row == len(drawn) - 1:
                axis.set_xlabel("strength (0: baseline)")
    save(figure, path, table(drawn))


def _draw_panel(axis: Any, curve: Curve, measure: str) -> None:
    places = np.arange(len(curve.groups))
    for place, group in zip(places, curve.groups.values(), strict=True):
        values = group.scores(TEST, measure).ravel()
        axis.plot([place] * len(values), values, "o", color="#1f6fb4", alpha=0.35, markersize=5)
    means = curve.means(measure)
    axis.axhline(means[0], color="#777777", linewidth=1, linestyle="--")
    axis.plot(places, means, color="#1f6fb4", linewidth=2)
    axis.set_xticks(places, [f"{strength:g}" for strength in curve.groups])
    axis.grid(axis="y", alpha=0.25)
    if measure != "return":
        axis.set_ylim(bottom=0.0)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def main() -> None:
    """Writes the picture and the tables."""
    found = curves(shown())
    choice = choice_table(candidates()).markdown()
    write_parts(PAGE, {"strength": table(found), "choice": choice})
    draw(found, PICTURE)


if __name__ == "__main__":
    main()
