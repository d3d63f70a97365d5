"""Forest plot of the summary: how probable it is that a run with L2C2 is better.

``python -m studies.forest`` reads the records in ``results/*.csv`` and writes
``results/forest.svg``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from studies.field import TEST
from studies.files import ROOT
from studies.summary import benchmarks
from torchrl_l2c2.experiment.analysis.reports.figures import save, subplots
from torchrl_l2c2.experiment.analysis.reports.groups import Group
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, improvement, pipe_table

PICTURE = ROOT / "results" / "forest.svg"
# Quantities, and the titles of their panels and columns.
PANELS = {"action_variation": "smoother", "return": "returns more"}
COLORS = {"better": "#1f6fb4", "worse": "#c44e52", "noise": "#777777"}


class Row(NamedTuple):
    """A row of the plot: its label, and the probability of each panel with its 95% interval."""

    label: str
    better: tuple[Estimate, ...]


def rows(pairs: Mapping[tuple[str, str], tuple[Group, Group]]) -> list[Row]:
    """A row for each benchmark, and one for the mean over them.

    Args:
        pairs (Mapping): The groups with L2C2 and of the baseline, by task and algorithm.
    """
    found = [
        Row(f"{', '.join(names)} ({len(pair[0].seeds)} seeds)", _better([pair]))
        for names, pair in pairs.items()
    ]
    return [*found, Row(f"Mean of the {len(pairs)} rows", _better(list(pairs.values())))]


def table(shown: Sequence[Row]) -> str:
    """The numbers of the plot as a table."""
    lines = [["", *(f"P({name})" for name in PANELS.values())]]
    lines += [[row.label, *(each.text() for each in row.better)] for row in shown]
    return pipe_table(lines)


def draw(shown: Sequence[Row], path: Path) -> None:
    """Draws the plot."""
    figure, axes = subplots(len(PANELS), 1, (9.5, 0.42 * len(shown) + 1.5))
    figure.set_facecolor("white")
    figure.suptitle("Probability that a run with L2C2 is better than a run of the baseline")
    heights = [*range(len(shown) - 1), len(shown) - 0.6]
    for number, (axis, name) in enumerate(zip(axes, PANELS.values(), strict=True)):
        _decorate(axis, name, heights)
        axis.set_yticks(heights, [row.label for row in shown] if number == 0 else [])
        for height, row in zip(heights, shown, strict=True):
            _draw_row(axis, height, row.better[number], overall=row is shown[-1])
    save(figure, path, table(shown))


def main() -> None:
    """Draws the picture of the summary."""
    draw(rows(benchmarks()), PICTURE)


def _better(pairs: Sequence[tuple[Group, Group]]) -> tuple[Estimate, ...]:
    found = []
    for quantity in PANELS:
        estimate = improvement([o for o, _ in pairs], [b for _, b in pairs], TEST, quantity)
        if estimate is None:
            raise ValueError(f"Expected the {quantity} of every group, got a group without it.")
        found.append(estimate)
    return tuple(found)


def _decorate(axis: Any, title: str, heights: Sequence[float]) -> None:
    axis.set(xlim=(-0.02, 1.5), ylim=(heights[-1] + 0.6, -0.6))
    axis.axvline(0.5, color="black", linewidth=1)
    axis.axhline(heights[-1] - 0.7, color="black", linewidth=0.6)
    axis.grid(axis="x", alpha=0.25)
    axis.tick_params(axis="y", length=0)
    axis.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "0.25", "0.5", "0.75", "1"])
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
    axis.spines["bottom"].set_bounds(0, 1)
    ends = (-0.6 - 0.15, heights[-1] + 0.6 + 0.75)
    for text, x, y, look in (
        (title, 0.5, ends[0], {"ha": "center", "weight": "bold", "fontsize": 12}),
        ("baseline \u2190", 0.46, ends[1], {"ha": "right", "fontsize": 9}),
        ("\u2192 with L2C2", 0.54, ends[1], {"ha": "left", "fontsize": 9}),
    ):
        axis.text(x, y, text, **look)


def _draw_row(axis: Any, height: float, better: Estimate, *, overall: bool) -> None:
    low, high = better.interval or (better.value, better.value)
    kind = "better" if low > 0.5 else "worse" if high < 0.5 else "noise"
    color = COLORS[kind]
    axis.plot([low, high], [height] * 2, color=color, linewidth=2.5, solid_capstyle="butt")
    marker = {"marker": "D" if overall else "o", "markersize": 9 if overall else 8}
    # Hollow: the interval contains 0.5.
    face = "white" if kind == "noise" else color
    axis.plot([better.value], [height], color=color, mfc=face, mew=1.8, clip_on=False, **marker)
    text = better.text()
    axis.text(1.06, height, text, va="center", fontsize=9, weight="bold" if overall else None)


if __name__ == "__main__":
    main()
