"""A report: tables, pictures and numbers of many runs in one folder, and one page of all of it."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from torchrl_l2c2.experiment.analysis.reports.comparison import (
    comparison_table,
    known_tests,
    summary,
)
from torchrl_l2c2.experiment.analysis.reports.document import picture, whole_page
from torchrl_l2c2.experiment.analysis.reports.figures import draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.measures import measures_table
from torchrl_l2c2.experiment.analysis.reports.tables import runs_table, settings_notes
from torchrl_l2c2.experiment.run.files import make_folder, write_atomically, write_json
from torchrl_l2c2.experiment.run.finished import FinishedRun, Record
from torchrl_l2c2.experiment.settings.naming import plain

Draw = Callable[[Path], None]


def write_report(
    folder: str | Path,
    records: Sequence[Record],
    runs: Sequence[FinishedRun] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Writes ``report.md``, ``report.html``, ``report.json`` and the pictures as SVG files.

    Everything is made before anything is written: an error leaves no half report.

    Args:
        folder (str or Path): The report's folder, made if absent.
        records (sequence of Record): The runs of the tables, at least one.
        runs (sequence of FinishedRun): The folders of the same runs, for learning curves and
            further measures.
        notes (sequence of str): Lines about left out folders, for example.

    Returns:
        Path: The page, which contains its pictures and needs no other file.
    """
    groups = group_records(records)
    notes = [*notes, *settings_notes(groups)]
    tables = [comparison_table(test, groups) for test in known_tests(groups)]
    details = [table for table in (measures_table(runs), runs_table(records)) if table is not None]
    numbers = {"groups": summary(groups), "notes": notes}
    with TemporaryDirectory() as drawn:
        for name, draw in _pictures(groups, runs).items():
            draw(Path(drawn) / name)
        shown = {path.name: path.read_bytes() for path in sorted(Path(drawn).iterdir())}
    text = "\n\n".join(
        [
            "# Runs",
            *notes,
            *(table.markdown() for table in (*tables, *details)),
            *(f"![{_title(name)}]({name})" for name in shown),
        ]
    )
    parts = [
        "<h1>Runs</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        *(table.html() for table in tables),
        "<h2>Pictures</h2>",
        *(f"<p>{picture(_title(name), content)}</p>" for name, content in shown.items()),
        *(table.html() for table in details),
    ]
    page = whole_page("Runs", parts)
    folder = make_folder(folder)
    for name, content in shown.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "report.md", f"{text}\n".encode())
    write_json(folder / "report.json", numbers)
    write_atomically(folder / "report.html", page.encode())
    return folder / "report.html"


def _pictures(groups: Sequence[Group], runs: Sequence[FinishedRun]) -> dict[str, Draw]:
    found: dict[str, Draw] = {}
    for task, algorithm in dict.fromkeys((run.task, run.algorithm) for run in runs):
        together = [run for run in runs if (run.task, run.algorithm) == (task, algorithm)]
        name = f"learning_curves_{plain(task)}_{algorithm}.svg"
        found[name] = partial(draw_learning_curves, together)
    for test in known_tests(groups):
        tested = [group for group in groups if len(group.scores(test, "return"))]
        found[f"plane_{test}.svg"] = partial(draw_plane, tested, test)
    return found


def _title(name: str) -> str:
    """What a picture shows, by its file."""
    return Path(name).stem.replace("_", " ")
