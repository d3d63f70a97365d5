"""Files that are written whole or not at all, and read back with errors that name them."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.errors import UserError

REMEDY = "it was changed or cut since it was written; restore it."
ANEW = " Or delete it: the command that made the run tests its policy again."


def make_folder(path: str | Path) -> Path:
    """Makes a folder that can be written to.

    Raises:
        OSError: where it cannot be made or written to; says which and what to do.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(
            f"the folder {str(folder)!r} cannot be written to ({error.strerror}); choose another."
        ) from error
    return folder


def make_folder_of(path: str | Path) -> None:
    """Makes the folder of a file, before there is anything that could be lost with it.

    Raises:
        OSError: As :func:`make_folder`, or the path is a folder.
    """
    if Path(path).is_dir():
        raise OSError(f"{str(path)!r} is a folder; name a file.")
    make_folder(Path(path).parent)


def write_atomically(path: str | Path, content: bytes) -> None:
    """Writes a file in one step: a temporary file, flushed to the disk, then renamed.

    Raises:
        OSError: Names the file; the old file is unchanged.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.partial")
    with _named(path):
        try:
            with open(temporary, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def append_line(path: Path, line: str) -> None:
    """Adds a line to a file; a killed process leaves no half of it.

    Raises:
        OSError: names the file.
    """
    # Unbuffered: one call of the system writes the whole line.
    with _named(path), open(path, "ab", buffering=0) as file:
        content, before = line.encode(), file.tell()
        if file.write(content) != len(content):
            file.truncate(before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """A full disk says no name by itself."""
    try:
        yield
    except OSError as error:
        raise OSError(
            error.errno, f"{error.strerror or error}: this could not be written", str(path)
        ) from error


def write_json(path: str | Path, value: Any) -> None:
    """Writes a value as indented JSON in one step; NaN and infinity become ``null``."""
    write_atomically(path, (to_json(value) + "\n").encode())


def to_json(value: Any) -> str:
    """Returns a value as indented JSON; NaN and infinity become ``null``."""
    return json.dumps(_strict(value), indent=2)


def _strict(value: Any) -> Any:
    """Replaces NaN and infinity, which JSON does not know, by ``None``."""
    if isinstance(value, Mapping):
        return {key: _strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def read_back(run: str | Path) -> Iterator[None]:
    """Turns errors in reading a run's files into an error that names the folder.

    Raises:
        ValueError: names the folder, instead of the original error.
    """
    try:
        yield
    except UserError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        found = f"{type(error).__name__}: {error}"
        raise UserError(f"the run in {str(run)!r} is damaged ({found}): {REMEDY}") from error


def read_json(path: str | Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        ValueError: names the file, which is no JSON or no object.
    """
    try:
        value = json.loads(_read_text(path))
    except json.JSONDecodeError as error:
        again = ANEW if Path(path).name == "evaluation.json" else ""
        raise UserError(f"{path} is no JSON ({error}): {REMEDY}{again}") from None
    except RecursionError:
        raise UserError(f"{path} has brackets within brackets without end: {REMEDY}") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} must hold an object, {{...}}, got {value!r:.40}: {REMEDY}")
    return value


def read_rows(path: str | Path) -> tuple[list[str], list[dict[str, str]]]:
    """Reads the header of a CSV file, and its lines by the names in it.

    Raises:
        ValueError: names the file, and the line that has fewer or more cells than the header.
    """
    lines = csv.reader(io.StringIO(_read_text(path)))
    rows = []
    try:
        header = next(lines, [])
        for cells in filter(None, lines):
            if len(cells) != len(header):
                many = f"{len(cells)} cells, where the header has {len(header)}"
                raise UserError(f"{path}, line {lines.line_num}: {many}: {REMEDY}")
            rows.append(dict(zip(header, cells, strict=True)))
    except csv.Error as error:
        raise UserError(f"{path}, line {lines.line_num}: {error}: {REMEDY}") from None
    return header, rows


def read_config(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``config.json``.

    Raises:
        ValueError: As :func:`read_json`, or the file lacks the task, algorithm or regularizer.
    """
    path = Path(run) / "config.json"
    config = read_json(path)
    for group in ("task", "algorithm", "regularizer"):
        chosen = config.get(group)
        if not isinstance(chosen, dict) or "name" not in chosen:
            raise UserError(f"{path} does not name its {group}: {REMEDY}")
    return config


def read_evaluation(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``evaluation.json``.

    Raises:
        ValueError: as :func:`read_json`; or its tests have other than numbers in their summaries.
    """
    path = Path(run) / "evaluation.json"
    evaluation = read_json(path)
    for test in (evaluation, evaluation.get("sampled") or {}):
        summary = test.get("summary", {}) if isinstance(test, dict) else None
        # Values that could not be measured are null.
        numbers = isinstance(summary, dict) and all(
            value is None or isinstance(value, int | float) for value in summary.values()
        )
        if not numbers:
            raise UserError(f"{path} has no numbers where it must, but {test!r:.40}: {REMEDY}")
    if not isinstance(evaluation.get("training", {}), dict):
        raise UserError(f"{path} must say of training what is known: {REMEDY}")
    return evaluation


def _read_text(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{path} is not there, which a run's folder has: restore it."
        ) from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text in UTF-8 ({error.reason}): {REMEDY}") from None
