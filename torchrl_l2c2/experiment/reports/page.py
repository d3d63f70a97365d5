"""A report: tables, pictures and numbers of many runs in one folder, and one page of all of it."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.folder import make_folder, write_atomically, write_json
from torchrl_l2c2.experiment.reports.choice import choice_table
from torchrl_l2c2.experiment.reports.comparison import statistics_tables, summary
from torchrl_l2c2.experiment.reports.document import picture, whole_page
from torchrl_l2c2.experiment.reports.field import field_groups, field_table
from torchrl_l2c2.experiment.reports.figures import draw_front, draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.reports.front import front_table, searched
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.measures import measures_table
from torchrl_l2c2.experiment.reports.paper_table import paper_table
from torchrl_l2c2.experiment.reports.records import FIGURES, Record
from torchrl_l2c2.experiment.reports.runs import FinishedRun
from torchrl_l2c2.experiment.reports.score import readings
from torchrl_l2c2.experiment.reports.tables import Table, results_tables, runs_table, score_table

# What a front is drawn of: the policy's mean is what is deployed.
FRONT = "late_mean"


def _results(groups: Sequence[Group]) -> list[Table]:
    """What stands before the pictures."""
    of_paper = paper_table(groups)
    return [*([of_paper] if of_paper else []), *results_tables(groups)]


def _others(records: Sequence[Record], runs: Sequence[FinishedRun]) -> list[Table]:
    """What stands behind them: every other table that can be made, every run by itself at last."""
    groups = group_records(records)
    scored = readings(groups)
    more = (field_table(records), choice_table(records), measures_table(runs))
    return [
        *statistics_tables(groups),
        *(front_table(found, FRONT) for found in searched(groups)),
        *([score_table(scored)] if scored else []),
        *(table for table in more if table is not None),
        runs_table(records),
    ]


def write_report(
    folder: str | Path,
    records: Sequence[Record],
    runs: Sequence[FinishedRun] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Writes ``report.md``, ``report.html``, ``report.json`` and the pictures as SVG files.

    Args:
        folder (str or Path): made where it is not there.
        records (sequence of Record): what the tables are of, at least one.
        runs (sequence of FinishedRun): the same runs' folders, for their learning curves; without
            them there are none.
        notes (sequence of str): on what was left out.

    Returns:
        Path: of the page; it has its pictures in it and needs no other file.
    """
    folder = make_folder(folder)
    groups = group_records(records)
    results, others = _results(groups), _others(records, runs)
    pictures = _draw(folder, records, runs)
    text = "\n\n".join(
        [
            "# Runs",
            *notes,
            *(table.markdown() for table in (*results, *others)),
            *(f"![{path.stem.replace('_', ' ')}]({path.name})" for path in pictures),
        ]
    )
    write_atomically(folder / "report.md", f"{text}\n".encode())
    write_json(folder / "report.json", {"groups": summary(groups), "notes": list(notes)})
    page = folder / "report.html"
    write_atomically(page, _page(results, others, pictures, notes).encode())
    return page


def _draw(folder: Path, records: Sequence[Record], runs: Sequence[FinishedRun]) -> list[Path]:
    paths = []
    for task, algorithm in dict.fromkeys((run.task, run.algorithm) for run in runs):
        together = [run for run in runs if (run.task, run.algorithm) == (task, algorithm)]
        paths.append(folder / f"learning_curves_{task.replace('/', '_')}_{algorithm}.svg")
        draw_learning_curves(together, paths[-1])
    for figure in FIGURES:
        groups = [g for g in group_records(records) if len(g.scores(figure, "return"))]
        if groups:
            paths.append(folder / f"plane_{figure}.svg")
            draw_plane(groups, figure, paths[-1])
    if of_field := field_groups(records):
        paths.append(folder / "plane_field.svg")
        draw_plane(of_field, "last_mean", paths[-1], "sm_asap")
    for number, found in enumerate(searched(group_records(records)), 1):
        paths.append(folder / f"front_{number}_{found[0].first.task.replace('/', '_')}.svg")
        draw_front(found, FRONT, paths[-1])
    return paths


def _page(
    results: Sequence[Table],
    others: Sequence[Table],
    pictures: Sequence[Path],
    notes: Sequence[str],
) -> str:
    drawn = "\n".join(
        f"<p>{picture(path.stem.replace('_', ' '), path.read_bytes())}</p>" for path in pictures
    )
    parts = [
        "<h1>Runs</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        *(table.html() for table in results),
        f"<h2>Pictures</h2>\n{drawn}",
        *(table.html() for table in others),
    ]
    return whole_page("Runs", parts)
