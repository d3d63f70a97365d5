"""Pictures of runs: learning curves, and return against smoothness."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from torchrl_l2c2.experiment.analysis.reports.groups import Group, by_task, group_records
from torchrl_l2c2.experiment.analysis.reports.names import METHODS
from torchrl_l2c2.experiment.analysis.reports.records import records_of
from torchrl_l2c2.experiment.analysis.reports.statistics import curve_band, mean
from torchrl_l2c2.experiment.analysis.reports.table import COMPARED, Estimate
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import write_atomically
from torchrl_l2c2.experiment.run.finished import TESTS, FinishedRun

PANELS = {
    "return": "return",
    "action_variation": "action variation",
    "policy_scale": "policy scale",
}
POINTS = 200
_OTHER_COLORS = ("#2a7f62", "#b0416b", "#8a6d1d", "#444444")
_LINES, _MARKERS = ("-", "--", ":", "-."), "os^vP*X<>"


def draw_learning_curves(runs: Sequence[FinishedRun], path: str | Path) -> None:
    """Draws return, action variation and the policy's scale of training episodes against frames.

    A single run has a thin line of its episodes and their moving average. Several seeds have the
    mean of their moving averages, with its 95% bootstrap interval as a band.

    Args:
        runs (sequence of FinishedRun): Runs of one task and algorithm.
        path (str or Path): The file; its ending, ``.png`` or ``.svg``, is the format.
    """
    groups = group_records(records_of(runs))
    if len(by_task(groups)) > 1:
        tasks = ", ".join(sorted({f"{run.task}, {run.algorithm}" for run in runs}))
        raise UserError(
            f"Expected runs of one task and algorithm, got {tasks}. Draw a picture for each."
        )
    runs_of = {run.record.identity: run for run in runs}
    looks = styles(groups)
    known = [name for name in PANELS if any(np.isfinite(run.column(name)).any() for run in runs)]
    window = max(10, max(len(run.metrics) for run in runs) // 40)
    figure, axes = subplots(len(known), 1, (3.4 * len(known) + 0.6, 3.6))
    for axis, name in zip(axes, known, strict=True):
        for group in groups:
            members = [run for key, run in runs_of.items() if key[:-1] == group.kind]
            style = {k: looks[group.name][k] for k in ("color", "linestyle")}
            _draw_curve(axis, members, name, window, label=group.name, **style)
        axis.set_xlabel("thousand frames")
        axis.xaxis.set_major_formatter(lambda frames, _: f"{frames / 1000:g}")
        axis.set_ylabel(PANELS[name])
    if runs[0].solved_at is not None:
        axes[0].axhline(runs[0].solved_at, color="black", linestyle=":", linewidth=1)
    title = f"{runs[0].task}, {runs[0].algorithm}: training episodes, moving mean of {window}"
    finish(figure, axes, title)
    save(figure, path)


def draw_plane(
    groups: Sequence[Group],
    test: str,
    path: str | Path,
    measure: str = "action_variation",
    *,
    more: Callable[[Any, Group, str], str | None] | None = None,
    description: str | None = None,
) -> None:
    """Draws return against smoothness: up is better, left is smoother.

    Each group is a dot, the mean over its seeds, with 95% bootstrap intervals.

    Args:
        groups (sequence of Group): Groups of any tasks; each task and algorithm has a panel.
        test (str): One of ``TESTS``, such as ``"late_mean"``.
        path (str or Path): The file; its ending, ``.png`` or ``.svg``, is the format.
        measure (str): ``"action_variation"`` or ``"sm_asap"``.

    Keyword Args:
        more (callable, optional): Draws more about a group on its axes in its color, and returns
            a note for the title, or ``None``.
        description (str, optional): Description that is stored in the file.
    """
    panels = by_task(groups)
    across = min(4, len(panels))
    down = -(-len(panels) // across)
    figure, axes = subplots(across, down, (max(3.4 * across, 5.4), 3.2 * down + 0.6))
    # One legend for all panels: a name looks the same in each panel.
    looks = styles(groups)
    title = {TESTS[test]: None}
    for axis, together in zip(axes, panels, strict=False):
        for group in together:
            look = looks[group.name]
            _draw_point(axis, group, test, measure, look)
            if more is not None and (note := more(axis, group, look["color"])):
                title[note] = None
        panel = f"{together[0].first.task}, {together[0].first.algorithm}"
        axis.set_title(panel, fontsize=10, parse_math=False)
        axis.set_xlabel(COMPARED[measure][0])
        axis.set_ylabel("return")
        axis.locator_params(axis="x", nbins=5)  # Long labels would touch.
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    finish(figure, axes, "; ".join(title))
    save(figure, path, description)


def _draw_curve(
    axis: Any, runs: Sequence[FinishedRun], name: str, window: int, **style: Any
) -> None:
    curves = []
    for run in runs:
        values = pd.Series(run.column(name), index=run.column("frames"))
        curves.append(values.rolling(window, min_periods=1).mean())
    if len(runs) == 1:
        (average,) = curves
        axis.plot(values, color=style["color"], alpha=0.25, linewidth=0.7)
        axis.plot(average, linewidth=1.6, **style)
        return
    # The frames that every run has reached.
    start, end = max(c.index[0] for c in curves), min(c.index[-1] for c in curves)
    shared = np.linspace(start, end, POINTS)
    matrix = np.stack([np.interp(shared, curve.index, curve) for curve in curves])
    lower, upper = curve_band(matrix, generator=np.random.default_rng(0))
    axis.fill_between(shared, lower, upper, color=style["color"], alpha=0.18, linewidth=0)
    axis.plot(shared, matrix.mean(0), linewidth=1.6, **style)


def _draw_point(axis: Any, group: Group, test: str, measure: str, style: dict[str, str]) -> None:
    values, bars = [], []
    for quantity in (measure, "return"):
        estimate = Estimate.of(mean, group.scores(test, quantity))
        if estimate is None:
            return
        values.append([estimate.value])
        # A percentile interval can exclude the mean of few, skewed scores.
        signed = zip((-1.0, 1.0), estimate.interval or (), strict=False)
        ends = [[max(0.0, sign * (end - estimate.value))] for sign, end in signed]
        bars.append(ends or None)
    shape = {"fmt": style["marker"], "markersize": 6, "elinewidth": 1.6, "capsize": 3}
    axis.errorbar(*values, *bars[::-1], label=group.name, color=style["color"], **shape)


def styles(groups: Sequence[Group]) -> dict[str, dict[str, str]]:
    """Returns a color for each method, and a line and a marker for each of its names."""
    others = sorted({g.first.method for g in groups} - METHODS.keys())
    colors = {name: color for name, (_, color) in METHODS.items()}
    colors |= {name: _OTHER_COLORS[i % len(_OTHER_COLORS)] for i, name in enumerate(others)}
    seen: Counter[str] = Counter()
    found: dict[str, dict[str, str]] = {}
    for group in groups:
        method = group.first.method
        if group.name in found:  # on another task
            continue
        found[group.name] = {
            "color": colors[method],
            "linestyle": _LINES[seen[method] % len(_LINES)],
            "marker": _MARKERS[seen[method] % len(_MARKERS)],
        }
        seen[method] += 1
    return found


def subplots(across: int, down: int, size: tuple[float, float]) -> tuple[Any, list[Any]]:
    """Makes a figure without a window, and its axes row by row.

    Args:
        across (int): Number of axes per row.
        down (int): Number of rows.
        size (tuple): Width and height in inches.
    """
    # Matplotlib takes a second to import, and most tables need no picture.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(down, across, squeeze=False).flat)


def finish(figure: Any, axes: Sequence[Any], title: str) -> None:
    """Gives a figure its grid, title and legend.

    Args:
        figure: Figure of :func:`subplots`.
        axes: Axes of :func:`subplots`.
        title (str): Title above all axes.
    """
    named: dict[str, Any] = {}
    for axis in axes:
        axis.grid(alpha=0.25)
        handles, names = axis.get_legend_handles_labels()
        named.update(zip(names, handles, strict=True))
    # The name of a task is no formula.
    figure.suptitle(title, fontsize=11, parse_math=False)
    if named:
        # About 14 letters an inch.
        width = figure.get_figwidth() / (0.7 + max(map(len, named)) / 14)
        columns = max(1, min(len(named), int(width)))
        # A long legend needs room of its own.
        lines = -(-len(named) // columns)
        figure.set_figheight(figure.get_figheight() + 0.22 * max(0, lines - 2))
        legend = {"loc": "outside lower center", "frameon": False, "ncols": columns}
        figure.legend(named.values(), named.keys(), **legend)


def save(figure: Any, path: str | Path, description: str | None = None) -> None:
    """Writes a picture in one step; the same picture gives the same bytes."""
    write_atomically(path, drawn(figure, Path(path).suffix[1:], description))


def drawn(figure: Any, kind: str = "svg", description: str | None = None) -> bytes:
    """Returns a picture as the content of a file; the same picture gives the same bytes.

    Letters in SVG files are outlines, which look the same without the font.
    """
    from matplotlib import rc_context

    content = io.BytesIO()
    # Without these an SVG file contains the date and random names.
    dated = ("Date", "Creator") if kind == "svg" else ("Software",)
    metadata = {**dict.fromkeys(dated), "Description": description}
    with rc_context({"svg.hashsalt": "torchrl_l2c2", "svg.fonttype": "path"}):
        figure.savefig(content, dpi=110, format=kind, metadata=metadata)
    return content.getvalue()
