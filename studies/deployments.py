"""Tables and picture of filters, action-rate rewards and regularizers (results/filters.md).

``python -m studies.deployments`` reads ``results/filters.csv``, which ``studies.filters`` writes.
It writes ``results/filters.svg`` and the tables of ``results/filters.md``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from studies.cells import number_range
from studies.files import ROOT, write_parts
from studies.filters import CONDITIONS
from torchrl_l2c2.experiment.analysis.reports.figures import finish, save, subplots
from torchrl_l2c2.experiment.analysis.reports.statistics import mean, probability_of_improvement
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, pipe_table

PAGE = ROOT / "results" / "filters.md"
# Names of the deployments by method, weight of the action-rate reward, and cut-off.
NAMES = {
    ("none", 0.0, 0.0): "baseline",
    ("none", 0.0, 0.3): "baseline, filter 0.3",
    ("none", 0.0, 0.1): "baseline, filter 0.1",
    ("none", 0.0, 0.03): "baseline, filter 0.03",
    ("none", 0.1, 0.0): "action-rate reward 0.1",
    ("none", 1.0, 0.0): "action-rate reward 1",
    ("l2c2", 0.0, 0.0): "L2C2",
    ("l2c2", 0.0, 0.1): "L2C2, filter 0.1",
    ("cats", 0.0, 0.0): "CATS",
}
CONDITION_NAMES = {
    "as trained": "as trained",
    "noise": "with sensor noise",
    "delay": "with actions one step late",
}
# Measures, by column of the file: name, sign of better values, digits.
MEASURES = {
    "return": ("return", 1.0, 1),
    "action_variation": ("action variation", -1.0, 3),
    "high_frequency": ("high frequencies", -1.0, 3),
}
# Entries of the picture: color, marker and deployments, which a line connects. The strongest filter
# is left out: on Pendulum its return is so low that the others could not be told apart.
SERIES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "baseline": ("#555555", "o", ("baseline",)),
    "baseline with a filter": (
        *("#c47a1b", "s"),
        ("baseline, filter 0.3", "baseline, filter 0.1"),
    ),
    "action-rate reward": (
        *("#8a4fa3", "^"),
        ("action-rate reward 0.1", "action-rate reward 1"),
    ),
    "L2C2": ("#1f6fb4", "o", ("L2C2",)),
    "L2C2 with a filter": ("#1f6fb4", "s", ("L2C2, filter 0.1",)),
    "CATS": ("#2a7f62", "v", ("CATS",)),
}


def read(path: Path) -> pd.DataFrame:
    """The lines of the file, with the name of each deployment.

    Raises:
        KeyError: If the comparison has no such deployment.
    """
    found = pd.read_csv(path)
    keys = zip(found["method"], found["action_rate"], found["cutoff"].fillna(0.0), strict=True)
    return found.assign(deployment=[NAMES[key] for key in keys])


def table(found: pd.DataFrame) -> str:
    """A row for each deployment: means over seeds, and the probabilities of a better run.

    Args:
        found (DataFrame): Lines of one task and condition, from :func:`read`.
    """
    columns = ["", "seeds"]
    for name, sign, _ in MEASURES.values():
        columns += [name, "P(larger)" if sign > 0 else "P(smaller)"]
    lines = [columns]
    baseline = found[found["deployment"] == "baseline"]
    for deployment in NAMES.values():
        rows = found[found["deployment"] == deployment]
        if rows.empty:
            continue
        cells = [deployment, number_range(sorted(rows["seed"]))]
        for column, (_, sign, digits) in MEASURES.items():
            scores, theirs = (each[[column]].to_numpy(float) for each in (rows, baseline))
            value = Estimate.of(mean, scores)
            assert value is not None
            cells.append(value.text(f"{{:.{digits}f}}".format))
            better = Estimate.of(probability_of_improvement, sign * scores, sign * theirs)
            cells.append("" if better is None or deployment == "baseline" else better.text())
        lines.append(cells)
    return pipe_table(lines)


def tables(found: pd.DataFrame) -> str:
    """The table of every task and condition, each with its heading."""
    parts = []
    for task in found["task"].unique():
        for condition in CONDITIONS:
            rows = found[(found["task"] == task) & (found["condition"] == condition)]
            parts.append(f"## {task}, {CONDITION_NAMES[condition]}\n\n{table(rows)}")
    return "\n\n".join(parts)


def draw(found: pd.DataFrame, path: Path) -> None:
    """Draws return against action variation: a row for each task, a column for each condition."""
    tasks = list(found["task"].unique())
    size = (3.3 * len(CONDITIONS), 2.7 * len(tasks) + 0.8)
    figure, axes = subplots(len(CONDITIONS), len(tasks), size)
    figure.set_facecolor("white")
    for row, task in enumerate(tasks):
        for column, condition in enumerate(CONDITIONS):
            shown = found[(found["task"] == task) & (found["condition"] == condition)]
            axis = axes[row * len(CONDITIONS) + column]
            _draw_panel(axis, shown)
            axis.set_title(f"{task}, {CONDITION_NAMES[condition]}", fontsize=9)
            if column == 0:
                axis.set_ylabel("return")
            if row == len(tasks) - 1:
                axis.set_xlabel("action variation")
    finish(figure, axes, "Return against action variation, means over seeds; left is smoother")
    save(figure, path)


def _draw_panel(axis: Any, found: pd.DataFrame) -> None:
    means = found.groupby("deployment")[["action_variation", "return"]].mean()
    for name, (color, marker, deployments) in SERIES.items():
        known = means.reindex(deployments).dropna()
        if len(known):
            axis.plot(*known.to_numpy().T, marker=marker, color=color, linewidth=1, label=name)
    axis.set_xlim(left=0.0)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def main() -> None:
    """Writes the tables and the picture."""
    found = read(PAGE.with_suffix(".csv"))
    write_parts(PAGE, {"tables": tables(found)})
    draw(found, PAGE.with_suffix(".svg"))


if __name__ == "__main__":
    main()
