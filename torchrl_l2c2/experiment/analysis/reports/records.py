"""Records of runs as lines of a CSV file, from which every table can be made."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.analysis.reports.names import method_order
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import make_folder, read_rows, write_atomically
from torchrl_l2c2.experiment.run.finished import Record
from torchrl_l2c2.experiment.settings.identity import read_differences
from torchrl_l2c2.experiment.settings.tasks import TASKS


def place(record: Record) -> tuple[Any, ...]:
    """The key by which tables are sorted: the order of tasks, then the fewest changed settings.

    Records that differ only in the regularizer, and so are compared, come together.
    """
    task = list(TASKS).index(record.task) if record.task in TASKS else len(TASKS)
    words = {k: f"{k}={v}" for k, v in record.settings_without_length.items()}
    own = [word for name, word in words.items() if name.startswith("regularizer.")]
    others = [word for word in words.values() if word not in own]
    amount, unit = record.length.split()
    reading = (len(others), others, unit, int(amount))
    method = (*method_order(record.method), len(own), own, record.settings)
    return (task, record.task, record.algorithm, *reading, *method, record.seed)


def read_records(path: str | Path) -> list[Record]:
    """Reads what :func:`write_records` wrote; an empty or absent file has none.

    Raises:
        UserError: the file has other columns, a line that is cut, or a cell that is no number
            where one must be.
    """
    path = Path(path)
    columns, lines = read_rows(path) if path.exists() else ([], [])
    names = [field.name for field in fields(Record)]
    if columns and columns != names:
        raise UserError(f"{path} has the columns {columns}; they must be {names}.")
    return merge([], (_parse(path, number, line) for number, line in enumerate(lines, start=2)))


def write_records(path: str | Path, records: Iterable[Record]) -> None:
    """Writes records as CSV, sorted, whole or not at all; the same records give the same bytes."""
    make_folder(Path(path).parent)
    write_atomically(path, _written(records))


def digest(records: Iterable[Record]) -> str:
    """What tells these records from all others, as a picture of them says in its description."""
    return hashlib.sha256(_written(records)).hexdigest()[:12]


def _written(records: Iterable[Record]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(Record))
    for record in sorted(records, key=place):
        writer.writerow(_cell(getattr(record, field.name)) for field in fields(Record))
    return text.getvalue().encode()


def merge(old: Iterable[Record], new: Iterable[Record]) -> list[Record]:
    """Old and new records, sorted; a run's newer record takes the place of its older one.

    But not one without its last policy's tests: that of a longer run, cut to the same length.
    """
    merged: dict[tuple[str | int, ...], Record] = {}
    for record in (*old, *new):
        older = merged.get(record.identity)
        if older is None or record.is_tested or not older.is_tested:
            merged[record.identity] = record
    return sorted(merged.values(), key=place)


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if math.isnan(value) else f"{value:.6g}"


def _number(cell: str) -> float:
    """NaN of an empty cell: what is not known."""
    if cell and not math.isfinite(float(cell)):
        raise ValueError(f"a cell must be a finite number or empty, got {cell!r}")
    return float(cell or "nan")


def _parse(path: Path, number: int, line: dict[str, str]) -> Record:
    readers: dict[str, Callable[[str], Any]] = {"int": int, "float": _number, "str": str}
    try:
        read_differences(line["differences"])
        if not re.fullmatch(r"\d+ (episodes|frames)", line["length"]):
            raise ValueError(f"length must be '<N> episodes' or frames, got {line['length']!r}")
        return Record(**{f.name: readers[str(f.type)](line[f.name]) for f in fields(Record)})
    except ValueError as error:
        raise UserError(f"{path}, line {number}: {error}.") from None
