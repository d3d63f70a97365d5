"""Tables of groups of runs."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torchrl_l2c2.experiment.analysis.reports.groups import (
    Group,
    by_task,
    common_settings,
    differing_versions,
)
from torchrl_l2c2.experiment.analysis.reports.names import method_name
from torchrl_l2c2.experiment.analysis.reports.statistics import mean_and_deviation
from torchrl_l2c2.experiment.run.finished import QUANTITIES, TESTS, Record


@dataclass(frozen=True)
class Table:
    """Cells of text under a title, with notes below.

    Examples:
        >>> print(Table("Squares", ["n", "n²"], [["2", "4"]], ["by hand"]).markdown())
        **Squares**
        <BLANKLINE>
        | n | n² |
        | --- | --- |
        | 2 | 4 |
        <BLANKLINE>
        by hand
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = field(default_factory=list)

    def markdown(self) -> str:
        """As a pipe table."""
        lines = [self.columns, ["---"] * len(self.columns), *self.rows]
        table = "\n".join(
            "| " + " | ".join(_escape(cell) for cell in line) + " |" for line in lines
        )
        return "\n\n".join([f"**{self.title}**", table, *self.notes])

    def html(self) -> str:
        """As elements of a page."""

        def row(cells: Sequence[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

        body = "\n".join(row(cells, "td") for cells in self.rows)
        notes = "".join(f"<p>{_code(html.escape(note))}</p>" for note in self.notes)
        return (
            f"<h2>{html.escape(self.title)}</h2>\n<div class='wide'><table>"
            f"<thead>{row(self.columns, 'th')}</thead>\n<tbody>{body}</tbody></table></div>{notes}"
        )


def settings_notes(groups: Sequence[Group]) -> list[str]:
    """Notes on settings that differ from the defaults in every row, and on pooled versions."""
    notes = []
    for together in by_task(groups):
        task, algorithm = together[0].first.task, together[0].first.algorithm
        shared = common_settings(together)
        if shared:
            which = f"{task}, {algorithm}, other than the defaults in every row"
            notes.append(_settings_note(which, shared))
        for method in dict.fromkeys(group.first.method for group in together):
            common = common_settings([g for g in together if g.first.method == method])
            # What all of a method's rows have is not in their names.
            own = {k: common[k] for k in common if k.startswith("regularizer.") and k not in shared}
            if own:
                which = f"{task}, {algorithm}, {method_name(method)}, other than the defaults"
                notes.append(_settings_note(which, own))
    return notes + differing_versions(groups)


def _settings_note(which: str, settings: Mapping[str, str]) -> str:
    return f"{which}: {', '.join(f'`{name}={value}`' for name, value in settings.items())}."


def runs_table(records: Sequence[Record]) -> Table:
    """Every run by itself, with all of its tests."""
    columns = ["task", "algorithm", "method", "seed", "settings", "length", "frames", "updates"]
    columns += [f"{QUANTITIES[q]}: {name}" for q in QUANTITIES for name in TESTS.values()]
    columns += ["policy scale"]
    rows = [
        [
            *(r.task, r.algorithm, r.method, str(r.seed), r.settings, r.length),
            *(str(r.frames), str(r.updates)),
            *(number(r.value(f, q), q) for q in QUANTITIES for f in TESTS),
            number(r.policy_scale, "policy_scale"),
        ]
        for r in records
    ]
    return Table("Every run", columns, rows)


def number(value: float, quantity: str, like: float | None = None) -> str:
    """Formats a number with the digits of its quantity; a dash if it is unknown.

    Args:
        value (float): The number.
        quantity (str): returns of 100 and more have one digit, others two; all else has three.
        like (float, optional): The number whose digits it gets, such as the mean of an interval.
    """
    size = abs(value if like is None else like)
    digits = 3 if quantity != "return" else 1 if size >= 100 else 2
    return or_dash(value, f".{digits}f")


def number_range(values: Sequence[int]) -> str:
    """Whole numbers, three and more in a row shortened.

    Examples:
        >>> number_range([0, 1, 2, 3, 7, 8])
        '0-3, 7, 8'
    """
    spans: list[list[int]] = []
    for value in sorted(values):
        if spans and value == spans[-1][-1] + 1:
            spans[-1].append(value)
        else:
            spans.append([value])
    return ", ".join(
        f"{span[0]}-{span[-1]}" if len(span) > 2 else ", ".join(map(str, span)) for span in spans
    )


def pooled(group: Group, test: str, quantity: str) -> str:
    """The mean of a group, with the standard deviation over its seeds in brackets."""
    scores = group.scores(test, quantity)
    if not len(scores):
        return "-"
    center, deviation = mean_and_deviation(scores)
    cell = number(center.item(), quantity)
    if len(scores) > 1:
        cell += f" ({number(deviation.item(), quantity, center.item())})"
    return cell + of_runs(len(scores), len(group.records))


def of_runs(known: int, all_runs: int) -> str:
    """Behind a cell, of how many runs it is where some lack it."""
    return f", of {known} runs" if known < all_runs else ""


def or_dash(value: float, spec: str) -> str:
    """A number as it is to be written; a dash where it is not known."""
    return "-" if math.isnan(value) else format(value, spec)


def _escape(cell: str) -> str:
    return cell.replace("|", "\\|")


def _code(text: str) -> str:
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", text)
