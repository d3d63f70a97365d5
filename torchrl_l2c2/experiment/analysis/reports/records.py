"""Finished runs below folders, and their records as a table with a row for each run."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from torchrl_l2c2.experiment.analysis.reports.names import method_order
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import make_folder, read_rows, write_atomically
from torchrl_l2c2.experiment.run.finished import FinishedRun, Record
from torchrl_l2c2.experiment.settings.identity import BUDGETS, read_differences
from torchrl_l2c2.experiment.settings.tasks import TASKS

TYPES = {field.name: str(field.type) for field in fields(Record)}
# Runs that share these differ only in their seeds.
KIND = ["task", "algorithm", "method", "settings", "length"]


@dataclass(frozen=True)
class Found:
    """The runs below some folders.

    Attributes:
        runs: finished runs, in the order of tables.
        notes: lines about folders that are unfinished, unreadable, repeated or untrained.
    """

    runs: list[FinishedRun]
    notes: list[str]


def find_runs(folders: Iterable[str | Path], *, required: bool = False) -> Found:
    """Reads every finished run below folders, at any depth, also behind symbolic links.

    If several runs have the same settings and seed, the most recent run is used.

    Args:
        folders (iterable of str or Path): The folders.

    Keyword Args:
        required (bool): Whether a result without runs is an error. Default ``False``.

    Raises:
        FileNotFoundError: a folder does not exist, or no run was found and one is required.
    """
    searched = [Path(folder) for folder in folders]
    if absent := [str(folder) for folder in searched if not folder.is_dir()]:
        found = "is a file" if Path(absent[0]).exists() else "does not exist"
        raise FileNotFoundError(
            f"Expected a folder of runs, got {absent[0]!r}, which {found}. Check the path."
        )
    unfinished, unreadable, repeated = [], [], []
    newest: dict[tuple[Any, ...], FinishedRun] = {}
    for folder in sorted(walk_runs(searched), key=_finished_at):
        if not (folder / "evaluation.json").exists():
            unfinished.append(str(folder))
            continue
        try:
            run = FinishedRun.read(folder)
            identity = run.record.identity
        except (OSError, ValueError, KeyError, TypeError, ArithmeticError) as error:
            unreadable.append(f"{folder} ({error})")
            continue
        if identity in newest:
            repeated.append(f"{newest[identity].folder} (as {folder})")
        newest[identity] = run
    runs = sorted(newest.values(), key=lambda run: _place(run.record))
    named = {
        "without test results (running, interrupted, failed, or with test_episodes=0)": sorted(
            unfinished
        ),
        "unreadable": sorted(unreadable),
        "the same settings and seed as a newer one, left out": repeated,
        "untrained (without an update, or with random actions only)": [
            str(run.folder) for run in runs if run.is_untrained
        ],
    }
    notes = [f"{len(names)} {kind}: {', '.join(names)}" for kind, names in named.items() if names]
    if required and not runs:
        places = ", ".join(repr(str(folder)) for folder in searched)
        text = f"Expected finished runs (evaluation.json) below {places}, got none."
        reasons = [f"{note}." for note in notes] or ["Name an output folder of train.py."]
        if unfinished:
            reasons.append("The command that began a run continues it.")
        raise FileNotFoundError(" ".join([text, *reasons]))
    return Found(runs, notes)


def walk_runs(folders: Iterable[str | Path]) -> Iterator[Path]:
    """Yields each folder of a run once, finished or not, also behind symbolic links."""
    walked = set()
    for top in folders:
        for place, inner, files in os.walk(top, followlinks=True):
            real = os.path.realpath(place)
            if real in walked:  # Links may form a loop.
                inner.clear()
                continue
            walked.add(real)
            if not {"config.json", "evaluation.json"}.isdisjoint(files):
                yield Path(place)


def read_runs(folder: str | Path) -> list[FinishedRun]:
    """Reads every finished run below a folder, at least one.

    Raises:
        FileNotFoundError: there is none.
    """
    return find_runs([folder], required=True).runs


def records_of(runs: Iterable[FinishedRun]) -> pd.DataFrame:
    """Makes the table of runs: a row for each run, a column for each field of its record."""
    return _ordered(pd.DataFrame([asdict(run.record) for run in runs], columns=list(TYPES)))


def read_records(path: str | Path) -> pd.DataFrame:
    """Reads a CSV file of :func:`write_records`; an empty or absent file has no rows.

    Raises:
        UserError: a column is missing or unknown, a line is cut, or a cell has a wrong value.
    """
    path = Path(path)
    columns, lines = read_rows(path) if path.exists() else ([], [])
    if columns and columns != list(TYPES):
        odd = ", ".join(sorted(set(columns) ^ TYPES.keys())) or "another order"
        raise UserError(
            f"Expected the columns of records in {path}, got missing or unknown columns: {odd}. "
            "Write the file with report --csv."
        )
    read: dict[str, Callable[[str], Any]] = {"int": _whole, "float": _number, "str": str}
    rows = []
    for number, line in enumerate(lines, start=2):
        try:
            rows.append({name: read[kind](line[name]) for name, kind in TYPES.items()})
            read_differences(line["differences"])
            if not re.fullmatch(r"\d+ (episodes|frames)", line["length"]):
                raise ValueError(f"Expected '<N> episodes' or frames, got {line['length']!r}")
        except ValueError as error:
            raise UserError(f"{path}, line {number}: {error}. Mend the line.") from None
    return merge(pd.DataFrame(rows, columns=list(TYPES)))


def _whole(text: str) -> int:
    value = int(text)
    if not 0 <= value < 2**63:
        raise ValueError(f"Expected a whole number from 0 to 2^63 - 1, got {text}")
    return value


def write_records(path: str | Path, records: pd.DataFrame) -> None:
    """Writes records as CSV, sorted; the same records give the same bytes."""
    make_folder(Path(path).parent)
    write_atomically(path, to_csv(records))


def to_csv(records: pd.DataFrame) -> bytes:
    """Returns records as the content of a CSV file."""
    text = io.StringIO()
    _ordered(records).to_csv(text, index=False, float_format="%.6g", lineterminator="\n")
    return text.getvalue().encode()


def merge(*records: pd.DataFrame) -> pd.DataFrame:
    """Joins tables of records, sorted; a run's last record replaces its earlier ones.

    A record without tests of the last policy, as of a run that was cut to a length, never replaces
    a record with tests.
    """
    together = pd.concat([each for each in records if len(each)] or records[:1], ignore_index=True)
    tested = together[["last_mean_return", "last_sampled_return"]].notna().any(axis=1)
    by_tests = together.loc[tested.sort_values(kind="stable").index]
    return _ordered(by_tests.drop_duplicates([*KIND, "seed"], keep="last"))


def other_settings(record: Any) -> dict[str, str]:
    """The settings of a record that differ from the defaults, except for the training's length."""
    settings = read_differences(record.differences)
    return {name: value for name, value in settings.items() if name not in BUDGETS}


def _ordered(records: pd.DataFrame) -> pd.DataFrame:
    places = [_place(record) for record in records.itertuples()]
    order = sorted(range(len(places)), key=places.__getitem__)
    return records.iloc[order].reset_index(drop=True).astype(TYPES)


def _place(record: Any) -> tuple[Any, ...]:
    """Sort key of tables: the order of tasks, then the fewest changed settings.

    Records that differ only in the regularizer come together.
    """
    task = list(TASKS).index(record.task) if record.task in TASKS else len(TASKS)
    words = [f"{name}={value}" for name, value in other_settings(record).items()]
    own = [word for word in words if word.startswith("regularizer.")]
    others = [word for word in words if word not in own]
    amount, unit = record.length.split()
    setup = (len(others), others, unit, int(amount))
    method = (*method_order(record.method), len(own), own, record.settings)
    return (task, record.task, record.algorithm, *setup, *method, record.seed)


def _finished_at(folder: Path) -> tuple[float, str]:
    mark = folder / "evaluation.json"
    return (mark.stat().st_mtime if mark.exists() else 0.0, str(folder))


def _number(cell: str) -> float:
    value = float(cell or "nan")
    if cell and not np.isfinite(value):
        raise ValueError(f"Expected a finite number or an empty cell, got {cell!r}")
    return value
