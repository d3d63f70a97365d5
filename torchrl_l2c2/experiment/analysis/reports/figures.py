"""Pictures of runs: learning curves, and return against smoothness."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l2c2.experiment.analysis.reports.comparison import COMPARED, Estimate
from torchrl_l2c2.experiment.analysis.reports.groups import Group, by_task, group_records
from torchrl_l2c2.experiment.analysis.reports.names import METHODS
from torchrl_l2c2.experiment.analysis.reports.records import digest
from torchrl_l2c2.experiment.analysis.reports.statistics import Scores, curve_band, mean
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

    Of a single run, its episodes as a thin line and their moving average; of several seeds, the
    mean of their moving averages with its 95% bootstrap interval as a band.

    Args:
        runs (sequence of FinishedRun): of one task and algorithm.
        path (str or Path): of the file; its ending, ``.png`` or ``.svg``, decides what it is.
    """
    groups = group_records(run.record for run in runs)
    runs_of = {run.record.identity: run for run in runs}
    looks = styles(groups)
    known = [name for name in PANELS if any(np.isfinite(run.column(name)).any() for run in runs)]
    window = max(10, max(len(run.metrics) for run in runs) // 40)
    figure, axes = subplots(len(known), 1, (3.4 * len(known) + 0.6, 3.6))
    for axis, name in zip(axes, known, strict=True):
        for group in groups:
            members = [runs_of[record.identity] for record in group.records]
            style = {k: looks[group.name][k] for k in ("color", "linestyle")}
            _draw_curve(axis, members, name, window, label=group.name, **style)
        axis.set_xlabel("thousand frames")
        axis.xaxis.set_major_formatter(lambda frames, _: f"{frames / 1000:g}")
        axis.set_ylabel(PANELS[name])
    if runs[0].solved_at is not None:
        axes[0].axhline(runs[0].solved_at, color="black", linestyle=":", linewidth=1)
    title = f"{runs[0].task}, {runs[0].algorithm}: training episodes, moving mean of {window}"
    finish(figure, axes, title, path)


def draw_plane(
    groups: Sequence[Group],
    test: str,
    path: str | Path,
    measure: str = "action_variation",
    *,
    more: Callable[[Any, Group, str], str | None] | None = None,
) -> None:
    """Draws return against smoothness: up and to the left is better and smoother.

    A dot for each group, the mean over its seeds with 95% bootstrap intervals.

    Args:
        groups (sequence of Group): a panel is drawn for each task and algorithm.
        test (str): one of ``TESTS``, such as ``"late_mean"``.
        path (str or Path): of the file; its ending, ``.png`` or ``.svg``, decides what it is.
        measure (str): ``"action_variation"`` or ``"sm_asap"``.

    Keyword Args:
        more (callable, optional): Draws more about a group on its axes in its color, and returns
            what the title says of it, or ``None``.
    """
    panels = by_task(groups)
    across = min(4, len(panels))
    down = -(-len(panels) // across)
    picture, axes = subplots(across, down, (max(3.4 * across, 5.4), 3.2 * down + 0.6))
    # There is one legend for all panels: a name looks the same in each.
    looks = styles(groups)
    title = {TESTS[test]: None}
    for axis, together in zip(axes, panels, strict=False):
        for group in together:
            _draw_point(axis, group, test, measure, looks[group.name])
            if more is not None and (note := more(axis, group, looks[group.name]["color"])):
                title[note] = None
        panel = f"{together[0].first.task}, {together[0].first.algorithm}"
        axis.set_title(panel, fontsize=10, parse_math=False)
        axis.set_xlabel(COMPARED[measure][0])
        axis.set_ylabel("return")
    for axis in axes[len(panels) :]:
        axis.set_visible(False)
    drawn_of = digest(record for group in groups for record in group.records)
    finish(picture, axes, "; ".join(title), path, description=f"records {drawn_of}")


def _draw_curve(
    axis: Any, runs: Sequence[FinishedRun], name: str, window: int, **style: Any
) -> None:
    curves = [
        (np.array(run.column("frames")), _moving_average(np.array(run.column(name)), window))
        for run in runs
    ]
    if len(runs) == 1:
        ((frames, average),) = curves
        axis.plot(frames, runs[0].column(name), color=style["color"], alpha=0.25, linewidth=0.7)
        axis.plot(frames, average, linewidth=1.6, **style)
        return
    # Where every run has been.
    start, end = max(f[0] for f, _ in curves), min(f[-1] for f, _ in curves)
    shared = np.linspace(start, end, POINTS)
    matrix = np.stack([np.interp(shared, frames, average) for frames, average in curves])
    lower, upper = curve_band(matrix, generator=np.random.default_rng(0))
    axis.fill_between(shared, lower, upper, color=style["color"], alpha=0.18, linewidth=0)
    axis.plot(shared, matrix.mean(0), linewidth=1.6, **style)


def _moving_average(values: Scores, window: int) -> Scores:
    """Mean of the last ``window`` values, of fewer at the start."""
    sums = np.concatenate([[0.0], values.cumsum()])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    averages: Scores = (sums[ends] - sums[starts]) / (ends - starts)
    return averages


def _draw_point(axis: Any, group: Group, test: str, measure: str, style: dict[str, str]) -> None:
    estimates = [Estimate.of(mean, group.scores(test, name)) for name in (measure, "return")]
    if None not in estimates:
        (x, x_bars), (y, y_bars) = ((e.value, _bars(e)) for e in estimates if e is not None)
        shape = {"fmt": style["marker"], "markersize": 6, "elinewidth": 1.6, "capsize": 3}
        axis.errorbar([x], [y], y_bars, x_bars, label=group.name, color=style["color"], **shape)


def _bars(estimate: Estimate) -> list[list[float]] | None:
    if estimate.interval is None:
        return None
    lower, upper = estimate.interval
    # A percentile interval may leave the mean of a skewed few just outside.
    return [[max(0.0, estimate.value - lower)], [max(0.0, upper - estimate.value)]]


def styles(groups: Sequence[Group]) -> dict[str, dict[str, str]]:
    """By name: a color for each method, and a line and a marker for each of its names."""
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
    """A figure without a window, and its axes row by row.

    Args:
        across (int): number of axes per row.
        down (int): number of rows.
        size (tuple): width and height in inches.
    """
    # Imported here: drawing takes a second to import and no other function needs it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(down, across, squeeze=False).flat)


def finish(
    figure: Any, axes: Sequence[Any], title: str, path: str | Path, description: str | None = None
) -> None:
    """Gives a figure its grid, title and legend, and writes it.

    Args:
        figure: figure of :func:`subplots`.
        axes: axes of :func:`subplots`.
        title (str): title above all axes.
        path (str or Path): the file; its ending is the format.
        description (str, optional): description that is stored in the file.
    """
    named: dict[str, Any] = {}
    for axis in axes:
        axis.grid(alpha=0.25)
        handles, names = axis.get_legend_handles_labels()
        named.update(zip(names, handles, strict=True))
    # What a user calls a task is no formula.
    figure.suptitle(title, fontsize=11, parse_math=False)
    if named:
        # A longer name, at some 14 letters an inch, leaves fewer beside one another.
        width = figure.get_figwidth() / (0.7 + max(map(len, named)) / 14)
        columns = max(1, min(len(named), int(width)))
        # Long legends would leave nothing to the axes.
        lines = -(-len(named) // columns)
        figure.set_figheight(figure.get_figheight() + 0.22 * max(0, lines - 2))
        legend = {"loc": "outside lower center", "frameon": False, "ncols": columns}
        figure.legend(named.values(), named.keys(), **legend)
    save(figure, path, description)


def save(figure: Any, path: str | Path, description: str | None = None) -> None:
    """Writes a picture whole or not at all; the same picture gives the same bytes."""
    write_atomically(path, drawn(figure, Path(path).suffix[1:], description))


def drawn(figure: Any, kind: str = "svg", description: str | None = None) -> bytes:
    """A picture as the content of a file; the same picture gives the same bytes."""
    from matplotlib import rc_context

    content = io.BytesIO()
    # Without these an SVG file has the date and random names in it.
    dated = ("Date", "Creator") if kind == "svg" else ("Software",)
    metadata = {**dict.fromkeys(dated), "Description": description}
    with rc_context({"svg.hashsalt": "torchrl_l2c2", "svg.fonttype": "none"}):
        figure.savefig(content, dpi=110, format=kind, metadata=metadata)
    return content.getvalue()
