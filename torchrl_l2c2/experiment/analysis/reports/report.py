"""The results of a run or a sweep in lines, and the report of many runs as a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from torchrl_l2c2.experiment.analysis.document import data_uri, render
from torchrl_l2c2.experiment.analysis.reports.figures import draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records, settings_notes
from torchrl_l2c2.experiment.analysis.reports.records import find_runs, records_of
from torchrl_l2c2.experiment.analysis.reports.table import comparison_table, known_tests
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import make_folder, read_back, write_atomically
from torchrl_l2c2.experiment.run.finished import QUANTITIES, FinishedRun
from torchrl_l2c2.experiment.settings.naming import unique


def result_lines(run: FinishedRun) -> str:
    """Returns the return and the action variation of a run's test episodes, in lines.

    With sampled actions the variation is also of the mean actions, at the visited states.

    Raises:
        ValueError: the run's folder is damaged.
    """
    lines = [f"{'played with':>20}  {'return':>18}  {'variation of the mean actions':>30}"]
    tests = {"mean actions": run.evaluation, "sampled actions": run.evaluation.get("sampled")}
    for name, test in tests.items():
        own = (test or {}).get("summary")
        if own is not None:
            with read_back(run.folder):
                total, variation = ((own[f"{q}_mean"], own[f"{q}_std"]) for q in QUANTITIES)
                episodes = "episode" if own["episodes"] == 1 else "episodes"
                lines.append(
                    f"{name:>20}  {total[0]:>9.1f} ({total[1]:>6.1f})  {variation[0]:>22.3f} "
                    f"({variation[1]:.3f})   {own['episodes']} test {episodes}, seed {run.seed}"
                )
    return "\n".join(lines)


def printed_table(records: pd.DataFrame) -> str:
    """Returns the table of records and notes on their settings as Markdown.

    It has the test of the last policy with mean actions, or else the first recorded test.
    """
    groups = group_records(records)
    table = comparison_table(_shown_test(groups), groups)
    return "\n\n".join([table.markdown(), *settings_notes(groups)])


def _shown_test(groups: Sequence[Group]) -> str:
    """The last policy's test with mean actions, or else the first that was recorded.

    Raises:
        UserError: no run has a test.
    """
    if not (known := known_tests(groups)):
        raise UserError("no run among these has the results of a test: add runs with test episodes")
    return known[0]


def sweep_summary(folders: Sequence[str | Path]) -> str:
    """Returns a table of all runs below folders, and notes on unfinished runs, as Markdown.

    Args:
        folders (sequence of str or Path): Folders of runs, or folders that hold them.
    """
    found = find_runs(folders)
    if not found.runs:
        return "\n\n".join([f"No finished run below {', '.join(map(str, folders))}.", *found.notes])
    return "\n\n".join([printed_table(records_of(found.runs)), *found.notes])


def write_report(
    folder: str | Path,
    records: pd.DataFrame,
    runs: Sequence[FinishedRun] = (),
    notes: Sequence[str] = (),
) -> Path:
    """Writes ``report.md``, ``report.html`` and the pictures as SVG files.

    Everything is made before the first file is written, so an error leaves no partial report.

    Args:
        folder (str or Path): The report's folder, made if absent.
        records (DataFrame): The records of the runs, at least one.
        runs (sequence of FinishedRun): The same runs, for learning curves.
        notes (sequence of str): Lines about left out folders, for example.

    Returns:
        Path: The page, which contains its pictures and needs no other file.
    """
    groups = group_records(records)
    test = _shown_test(groups)
    table = comparison_table(test, groups)
    notes = [*notes, *settings_notes(groups)]
    titles = {"plane.svg": "plane"}
    with TemporaryDirectory() as drawn:
        for task, algorithm in dict.fromkeys((run.task, run.algorithm) for run in runs):
            together = [run for run in runs if (run.task, run.algorithm) == (task, algorithm)]
            name = f"learning_curves_{unique(task)}_{algorithm}.svg"
            titles[name] = f"learning curves {task}, {algorithm}"
            draw_learning_curves(together, Path(drawn) / name)
        tested = [group for group in groups if len(group.scores(test, "return"))]
        draw_plane(tested, test, Path(drawn) / "plane.svg")
        pictures = {path.name: path.read_bytes() for path in sorted(Path(drawn).iterdir())}
    shown = {titles[name]: data_uri(content) for name, content in pictures.items()}
    page = render("report.html", title="Runs", notes=notes, table=table, pictures=shown)
    links = [f"![{titles[name]}]({name})" for name in pictures]
    text = "\n\n".join(["# Runs", *notes, table.markdown(), *links])
    folder = make_folder(folder)
    for name, content in pictures.items():
        write_atomically(folder / name, content)
    write_atomically(folder / "report.md", f"{text}\n".encode())
    write_atomically(folder / "report.html", page.encode())
    return folder / "report.html"
