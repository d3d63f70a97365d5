"""The command line: tables of runs, a report, a file of records, a page's results."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

from torchrl_l2c2.experiment.config import ExperimentConfig
from torchrl_l2c2.experiment.errors import told_in_a_line
from torchrl_l2c2.experiment.identity import of_length
from torchrl_l2c2.experiment.reports.against import against_table
from torchrl_l2c2.experiment.reports.groups import group_records
from torchrl_l2c2.experiment.reports.page import fill_pages
from torchrl_l2c2.experiment.reports.records import Record, merge, read_records, write_records
from torchrl_l2c2.experiment.reports.report import write_report
from torchrl_l2c2.experiment.reports.results import printed_tables
from torchrl_l2c2.experiment.reports.runs import FinishedRun, Found, find_runs
from torchrl_l2c2.experiment.reports.score import Reading, readings
from torchrl_l2c2.experiment.reports.tables import score_table

DESCRIPTION = """\
Reads every finished run below folders, prints their tables beside the paper's numbers, and writes a
report: tables, statistics and pictures, as one page, as Markdown, SVG and JSON.
"""
EXAMPLES = """\
examples:
  python -m torchrl_l2c2.experiment.reports outputs
  python -m torchrl_l2c2.experiment.reports outputs --csv results/runs.csv
  python -m torchrl_l2c2.experiment.reports --from results/runs.csv --page results/paper.md
  python -m torchrl_l2c2.experiment.reports outputs --length 200 300 --score
"""


def main(arguments: Iterable[str] | None = None) -> None:
    """Does what the command line says; an error is one line."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if bool(chosen.folders) == bool(chosen.records):
        parser.error("name folders of runs, or files of records with --from")
    if chosen.records and chosen.length:
        parser.error("--length needs the runs' folders: records have the end of training alone")
    if min(chosen.length or [1]) < 1:
        parser.error(f"--length must be at least 1, got {min(chosen.length)}")
    if chosen.rows and chosen.csv:
        parser.error("--csv writes all records; leave it or --rows out")
    if chosen.against and chosen.score:
        parser.error("--score prints scores alone; leave it or --against out")
    if chosen.records and chosen.csv:
        parser.error("--csv writes records of folders; --from has them already")
    with told_in_a_line():
        _report(chosen)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2.experiment.reports",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("folders", nargs="*", metavar="FOLDER", help="of runs, at any depth, e.g. outputs/swingup")
    add(
        "--from",
        dest="records",
        nargs="+",
        metavar="CSV",
        help="records of runs instead of their folders",
    )
    add(
        "--output",
        metavar="FOLDER",
        help="of the report (default: report/ in the first folder; with --from, --csv, --score or "
        "--page there is a report only if this is given)",
    )
    add("--csv", metavar="CSV", help="file that gets a line for every run, or its newer line")
    add("--score", action="store_true", help="print how near vanilla and CAPS come to the paper")
    add(
        "--length",
        nargs="+",
        type=int,
        metavar="N",
        help="what the results had been after so many episodes of training (frames, where runs are "
        "as long as so many frames); of a longer run by its training's own episodes",
    )
    add(
        "--rows",
        nargs="+",
        metavar="NAME",
        help="only these methods, as tables call them: --rows vanilla CAPS 'L2C2, mse 1, ramp'",
    )
    add(
        "--against",
        metavar="NAME",
        help="a table of this method against each other one, on each of the field's tasks",
    )
    add(
        "--page",
        nargs="+",
        metavar="FILE",
        help="make the results between these files' marks anew, of all records of --csv or --from",
    )
    return parser


def _report(chosen: argparse.Namespace) -> None:
    records, runs, notes = _read(chosen)
    if chosen.rows:
        records, runs = _narrowed(records, runs, chosen.rows)
    kept = merge(read_records(chosen.csv), records) if chosen.csv else records
    # Of all records that are kept, and before anything is written, as it may be refused.
    against = [against_table(kept, chosen.against)] if chosen.against else []
    written = []
    # Before the records, as it may be refused.
    if chosen.page:
        fill_pages(chosen.page, kept, against)
        written.append(f"results: {', '.join(chosen.page)}")
    if chosen.csv:
        write_records(chosen.csv, kept)
        written.append(f"records: {chosen.csv}")
    alone = not (chosen.records or chosen.csv or chosen.score or chosen.page)
    if chosen.output or alone:
        folder = Path(chosen.output or Path(chosen.folders[0]) / "report")
        written.append(f"report: {write_report(folder, records, runs, notes, against)}")
    scores = [score_table(_scored(records))] if chosen.score else None
    tables = scores or [*printed_tables(records), *against]
    # Last: who reads but the first lines of it has the files all the same.
    print("\n\n".join([*(table.markdown() for table in tables), *notes, *written]))


def _narrowed(
    records: Sequence[Record], runs: Sequence[FinishedRun], names: Sequence[str]
) -> tuple[Sequence[Record], Sequence[FinishedRun]]:
    """The records, and the runs, of groups with these names."""
    groups = group_records(records)
    known = dict.fromkeys(group.name for group in groups)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"--rows: there is no {unknown[0]!r} here, but {'; '.join(known)}.")
    kept = [record for group in groups if group.name in names for record in group.records]
    return kept, [run for run in runs if run.record in kept]


def _scored(records: Sequence[Record]) -> list[Reading]:
    if found := readings(group_records(records)):
        return found
    raise ValueError(
        "--score is of runs of vanilla and of CAPS with the same other settings, on one of the "
        "paper's tasks by its algorithm: there are none of both."
    )


def _read(
    chosen: argparse.Namespace,
) -> tuple[Sequence[Record], Sequence[FinishedRun], Sequence[str]]:
    if chosen.records:
        for file in chosen.records:
            if not Path(file).exists():
                raise FileNotFoundError(f"there is no file {file!r}; make it with --csv.")
        records = merge([], chain.from_iterable(map(read_records, chosen.records)))
        if not records:
            named = ", ".join(map(repr, chosen.records))
            raise ValueError(f"no record of a run in {named}; make them with --csv.")
        return records, [], []
    found = find_runs(chosen.folders, required=True)
    if chosen.length:
        return _shortened(found, chosen.length)
    return [run.record for run in found.runs], found.runs, found.notes


def _shortened(
    found: Found, lengths: Sequence[int]
) -> tuple[Sequence[Record], Sequence[FinishedRun], Sequence[str]]:
    cut = [run.until(length) for length in sorted(set(lengths)) for run in found.runs]
    long = [run for run in cut if run is not None]
    if not long:
        raise ValueError(f"no run is as long as {min(lengths)} episodes, or frames; ask for less.")
    runs: dict[tuple[str | int, ...], FinishedRun] = {}
    # One that ended just then was tested, and comes before a longer one with the same settings.
    for run in sorted(long, key=lambda run: not run.record.is_tested):
        runs.setdefault(run.record.identity, run)
    notes = list(found.notes)
    if len(long) < len(cut):
        notes.append(f"{len(cut) - len(long)} runs are not as long as a length that was asked for")
    going = [
        of_length(ExperimentConfig.from_dict(run.config)) for run in long if not run.evaluation
    ]
    for setting, many in Counter(chain.from_iterable(going)).items():
        as_longer = "as in their own, longer training: so short a one would give other numbers"
        notes.append(f"{many} runs, cut to a length, have {setting} {as_longer}")
    if len(runs) < len(long):
        what = "have the settings, seed and length of another, left out"
        notes.append(f"{len(long) - len(runs)} runs, cut to a length, {what}")
    kept = sorted(runs.values(), key=lambda run: run.record.place)
    return [run.record for run in kept], kept, notes


if __name__ == "__main__":
    main()
