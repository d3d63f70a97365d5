"""``report``: tables and learning curves of runs."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_l2c2.experiment.errors import UserError, one_line_errors

if TYPE_CHECKING:
    import pandas as pd

    from torchrl_l2c2.experiment.run.finished import FinishedRun

DESCRIPTION = """\
Reads all finished runs below folders, prints a table, and writes a report with tables and pictures,
as one HTML page and as Markdown and SVG.
"""
EXAMPLES = """\
examples:
  python -m torchrl_l2c2 report outputs
  python -m torchrl_l2c2 report outputs --csv runs.csv
  python -m torchrl_l2c2 report --from runs.csv --output report
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints a table of runs and writes a report."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if bool(chosen.folders) == bool(chosen.records):
        parser.error("expected either folders of runs, or CSV files with --from")
    if chosen.records and chosen.csv:
        parser.error("--csv works only with folders: leave out --csv or --from")
    with one_line_errors():
        _report(chosen)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 report",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "folders",
        nargs="*",
        metavar="FOLDER",
        help="folders that contain runs at any depth, such as outputs/swingup",
    )
    add(
        "--from",
        dest="records",
        nargs="+",
        metavar="CSV",
        help="CSV files of --csv, instead of folders",
    )
    add(
        "--output",
        metavar="FOLDER",
        help="folder of the report (default: report/ in the first folder; with --from or --csv, no "
        "report without this option)",
    )
    add("--csv", metavar="CSV", help="CSV file to which runs are added, one line per run")
    return parser


def _report(chosen: argparse.Namespace) -> None:
    from torchrl_l2c2.experiment.analysis.reports.records import merge, read_records, write_records
    from torchrl_l2c2.experiment.analysis.reports.report import printed_table, write_report

    records, runs, notes = _read(chosen)
    written = []
    if chosen.csv:
        write_records(chosen.csv, merge(read_records(chosen.csv), records))
        written.append(f"records: {chosen.csv}")
    if chosen.output or not (chosen.records or chosen.csv):
        folder = Path(chosen.output or Path(chosen.folders[0]) / "report")
        written.append(f"report: {write_report(folder, records, runs, notes)}")
    # Printed last: a closed output, as with head, must not prevent the files.
    print("\n\n".join([printed_table(records), *notes, *written]))


def _read(chosen: argparse.Namespace) -> tuple[pd.DataFrame, Sequence[FinishedRun], Sequence[str]]:
    from torchrl_l2c2.experiment.analysis.reports.records import (
        find_runs,
        merge,
        read_records,
        records_of,
    )

    if chosen.folders:
        found = find_runs(chosen.folders, required=True)
        return records_of(found.runs), found.runs, found.notes
    for file in chosen.records:
        if not Path(file).exists():
            raise FileNotFoundError(
                f"Expected a file of records, got {file!r}, which does not exist. Make it with "
                "--csv."
            )
    records = merge(*map(read_records, chosen.records))
    if not len(records):
        named = ", ".join(map(repr, chosen.records))
        raise UserError(f"Expected records of runs in {named}, got none. Make them with --csv.")
    return records, [], []
