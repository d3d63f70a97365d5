"""A report: tables, pictures and numbers of many runs in one folder, and one page of all of it."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from torchrl_l2c2.experiment.files import make_folder, write_atomically, write_json
from torchrl_l2c2.experiment.naming import plain
from torchrl_l2c2.experiment.reports.choice import choice_table
from torchrl_l2c2.experiment.reports.comparison import statistics_tables, summary
from torchrl_l2c2.experiment.reports.document import picture, whole_page
from torchrl_l2c2.experiment.reports.faster_targets import faster_targets_table
from torchrl_l2c2.experiment.reports.field import field_groups, field_table
from torchrl_l2c2.experiment.reports.figures import draw_front, draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.reports.front import front_table, front_test, searched
from torchrl_l2c2.experiment.reports.gain_targets import gain_targets_table
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.measures import measures_table
from torchrl_l2c2.experiment.reports.pairwise import pairwise_tables
from torchrl_l2c2.experiment.reports.paper_table import deployed_table, paper_table
from torchrl_l2c2.experiment.reports.records import TESTS, Record
from torchrl_l2c2.experiment.reports.runs import FinishedRun
from torchrl_l2c2.experiment.reports.score import readings
from torchrl_l2c2.experiment.reports.tables import Table, results_tables, runs_table, score_table


def _results(groups: Sequence[Group]) -> list[Table]:
    """What stands before the pictures."""
    of_paper = (paper_table(groups), deployed_table(groups))
    return [*(table for table in of_paper if table is not None), *results_tables(groups)]


def _others(records: Sequence[Record], runs: Sequence[FinishedRun]) -> list[Table]:
    """What stands behind them: every other table that can be made, every run by itself at last."""
    groups = group_records(records)
    scored = readings(groups)
    more = (
        faster_targets_table(records),
        gain_targets_table(records),
        field_table(records),
        choice_table(records),
        measures_table(runs),
    )
    return [
        *statistics_tables(groups),
        *(front_table(found, front_test(found)) for found in searched(groups)),
        *([score_table(scored)] if scored else []),
        *(table for table in more if table is not None),
        *pairwise_tables(records),
        runs_table(records),
    ]


def write_report(
    folder: str | Path,
    records: Sequence[Record],
    runs: Sequence[FinishedRun] = (),
    notes: Sequence[str] = (),
    first: Sequence[Table] = (),
) -> Path:
    """Writes ``report.md``, ``report.html``, ``report.json`` and the pictures as SVG files.

    All of it is made before any is written: what cannot be told or drawn leaves no half report.

    Args:
        folder (str or Path): made where it is not there.
        records (sequence of Record): what the tables are of, at least one.
        runs (sequence of FinishedRun): the same runs' folders, for their learning curves; without
            them there are none.
        notes (sequence of str): on what was left out.
        first (sequence of Table): what stands before the other tables.

    Returns:
        Path: of the page; it has its pictures in it and needs no other file.
    """
    groups = group_records(records)
    results, others = [*first, *_results(groups)], _others(records, runs)
    numbers = {"groups": summary(groups), "notes": list(notes)}
    with TemporaryDirectory() as drawn:
        paths = _draw(Path(drawn), records, runs)
        pictures = {path.name: path.read_bytes() for path in paths}
    text = "\n\n".join(
        [
            "# Runs",
            *notes,
            *(table.markdown() for table in (*results, *others)),
            *(f"![{_told(name)}]({name})" for name in pictures),
        ]
    )
    page = _page(results, others, pictures, notes)
    folder = make_folder(folder)
    for name, content in pictures.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "report.md", f"{text}\n".encode())
    write_json(folder / "report.json", numbers)
    write_atomically(folder / "report.html", page.encode())
    return folder / "report.html"


def _draw(folder: Path, records: Sequence[Record], runs: Sequence[FinishedRun]) -> list[Path]:
    paths = []
    for task, algorithm in dict.fromkeys((run.task, run.algorithm) for run in runs):
        together = [run for run in runs if (run.task, run.algorithm) == (task, algorithm)]
        paths.append(folder / f"learning_curves_{plain(task)}_{algorithm}.svg")
        draw_learning_curves(together, paths[-1])
    for test in TESTS:
        groups = [g for g in group_records(records) if len(g.scores(test, "return"))]
        if groups:
            paths.append(folder / f"plane_{test}.svg")
            draw_plane(groups, test, paths[-1])
    if of_field := field_groups(records):
        paths.append(folder / "plane_field.svg")
        draw_plane(of_field, "last_mean", paths[-1], "sm_asap")
    for number, found in enumerate(searched(group_records(records)), 1):
        paths.append(folder / f"front_{number}_{plain(found[0].first.task)}.svg")
        draw_front(found, front_test(found), paths[-1])
    return paths


def _page(
    results: Sequence[Table],
    others: Sequence[Table],
    pictures: Mapping[str, bytes],
    notes: Sequence[str],
) -> str:
    drawn = "\n".join(
        f"<p>{picture(_told(name), content)}</p>" for name, content in pictures.items()
    )
    parts = [
        "<h1>Runs</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        *(table.html() for table in results),
        f"<h2>Pictures</h2>\n{drawn}",
        *(table.html() for table in others),
    ]
    return whole_page("Runs", parts)


def _told(name: str) -> str:
    """What a picture shows, by its file."""
    return Path(name).stem.replace("_", " ")
