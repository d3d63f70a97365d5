"""Forest plot of the README's rows: how probable it is that a run with L2C2 is better.

``python -m studies.forest`` reads the records in ``results/*.csv``. It writes
``results/forest.svg`` and the table of ``results/README.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from studies.field import TEST
from studies.pages import ROOT, fill, summarized
from torchrl_l2c2.experiment.analysis.reports.figures import save, subplots
from torchrl_l2c2.experiment.analysis.reports.groups import Group
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, improvement
from torchrl_l2c2.experiment.run.files import write_atomically

PAGE = ROOT / "results" / "README.md"
PICTURE = ROOT / "results" / "forest.svg"
# Quantities, and the titles of their panels and columns.
PANELS = {"action_variation": "smoother", "return": "returns more"}
COLORS = {"better": "#1f6fb4", "worse": "#c44e52", "noise": "#777777"}


class Row(NamedTuple):
    """A row of the plot: its label, and the probability of each panel with its 95% interval."""

    label: str
    better: tuple[Estimate, ...]


def rows(pairs: dict[str, tuple[Group, Group]]) -> list[Row]:
    """A row for each task, the roughest baseline first, and one for the mean over tasks.

    Args:
        pairs (dict): The groups with L2C2 and of the baseline, by label.
    """
    rough = {
        label: baseline.scores(TEST, "action_variation").mean()
        for label, (_, baseline) in pairs.items()
    }
    ordered = sorted(pairs, key=rough.__getitem__, reverse=True)
    found = [
        Row(f"{label} ({len(pairs[label][0].seeds)} seeds)", _better([pairs[label]]))
        for label in ordered
    ]
    return [*found, Row(f"Mean of the {len(pairs)} rows", _better(list(pairs.values())))]


def published() -> list[Row]:
    """The rows of the README's table."""
    pairs = {}
    for label, pair in summarized().items():
        algorithm, task = label.split(", ")
        pairs[f"{task}, {algorithm}"] = pair
    return rows(pairs)


def table(shown: Sequence[Row]) -> str:
    """The numbers of the plot as a table."""
    lines = [["", *(f"P({name})" for name in PANELS.values())], ["---"] * (1 + len(PANELS))]
    lines += [[row.label, *(each.text("{:.2f}".format) for each in row.better)] for row in shown]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


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
    """Writes the picture and the table."""
    shown = published()
    write_atomically(PAGE, fill(PAGE.read_text(), "forest", table(shown)).encode())
    draw(shown, PICTURE)


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
    axis.plot([better.value], [height], color=color, markerfacecolor=face, mew=1.8, **marker)
    text = better.text("{:.2f}".format)
    axis.text(1.06, height, text, va="center", fontsize=9, weight="bold" if overall else None)


if __name__ == "__main__":
    main()
