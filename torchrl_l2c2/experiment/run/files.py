"""Functions that write files atomically, and read them with errors that state the file."""

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

REMEDY = "it was changed or truncated after it was written; restore it."
OF_A_RUN = ("config.json", "versions.json", "evaluation.json", "evaluations.json")
RETEST_HINT = " Or delete it: the run's command then tests the policy again."


def make_folder(path: str | Path) -> Path:
    """Creates a folder and checks that it is writable.

    Raises:
        OSError: If the folder cannot be created or is not writable.
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


def make_parent_folder(path: str | Path) -> None:
    """Creates the folder of an output file. Call it before a long computation of its content.

    Raises:
        OSError: If the path is a folder, and as :func:`make_folder`.
    """
    if Path(path).is_dir():
        raise OSError(f"expected a file, got the folder {str(path)!r}.")
    make_folder(Path(path).parent)


def check_output(path: str | Path, ending: str) -> None:
    """Checks that an output file has its ending and is no file of a run, and creates its folder.

    Args:
        path (str or Path): The file.
        ending (str): Ending of the file, such as ``".json"``.

    Raises:
        UserError: If the file has another ending, or is a file that a run needs.
        OSError: As :func:`make_parent_folder`.
    """
    path = Path(path)
    if path.suffix.lower() != ending:
        raise UserError(f"Expected a file that ends in {ending}, got {str(path)!r}. Rename it.")
    if path.name in OF_A_RUN and (path.parent / "config.json").exists():
        raise UserError(f"{str(path)!r} is a file of the run there. Choose another name.")
    make_parent_folder(path)


def write_atomically(path: str | Path, content: bytes) -> None:
    """Writes a file atomically, by renaming a temporary file that was flushed to the disk.

    Raises:
        OSError: If the file cannot be written. The old file is then unchanged.
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
    """Appends a line to a file, as a whole even if the process is killed.

    Raises:
        OSError: If the line cannot be written.
    """
    # Unbuffered: one system call writes the whole line.
    with _named(path), open(path, "ab", buffering=0) as file:
        content, before = line.encode(), file.tell()
        if file.write(content) != len(content):
            file.truncate(before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Adds the file's name to errors: a full disk raises one without a name."""
    try:
        yield
    except OSError as error:
        raise OSError(
            error.errno, f"{error.strerror or error}: the file could not be written", str(path)
        ) from error


def write_json(path: str | Path, value: Any) -> None:
    """Writes a value atomically as indented JSON; NaN and infinity become ``null``."""
    write_atomically(path, (to_json(value) + "\n").encode())


def to_json(value: Any) -> str:
    """Returns a value as indented JSON; NaN and infinity become ``null``."""
    return json.dumps(_strict(value), indent=2)


def _strict(value: Any) -> Any:
    """Replaces NaN and infinity, which JSON does not support, by ``None``."""
    if isinstance(value, Mapping):
        return {key: _strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def read_back(run: str | Path) -> Iterator[None]:
    """Converts errors about the content of a run's files to an error that states the folder.

    Raises:
        ValueError: If the block raises an error because of damaged content.
    """
    try:
        yield
    except UserError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        found = f"{type(error).__name__}: {error}"
        raise UserError(f"the run in {str(run)!r} is damaged ({found}): {REMEDY}") from error


def read_json(path: str | Path) -> dict[str, Any]:
    """Reads a JSON object from a file.

    Raises:
        ValueError: If the file has no JSON object.
    """
    try:
        value = json.loads(_read_text(path))
    except json.JSONDecodeError as error:
        again = RETEST_HINT if Path(path).name == "evaluation.json" else ""
        raise UserError(f"{path} is not valid JSON ({error}): {REMEDY}{again}") from None
    except RecursionError:
        raise UserError(f"{path} has too many nested brackets: {REMEDY}") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} must contain an object, {{...}}, got {value!r:.40}: {REMEDY}")
    return value


def read_rows(path: str | Path) -> tuple[list[str], list[dict[str, str]]]:
    """Reads a CSV file: its header, and its rows as dictionaries.

    Raises:
        ValueError: If a line has another number of cells than the header, or cannot be parsed.
    """
    lines = csv.reader(io.StringIO(_read_text(path)))
    rows = []
    try:
        header = next(lines, [])
        for cells in filter(None, lines):
            if len(cells) != len(header):
                counts = f"{len(cells)} cells, but the header has {len(header)}"
                raise UserError(f"{path}, line {lines.line_num}: {counts}: {REMEDY}")
            rows.append(dict(zip(header, cells, strict=True)))
    except csv.Error as error:
        raise UserError(f"{path}, line {lines.line_num}: {error}: {REMEDY}") from None
    return header, rows


def read_config(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``config.json``.

    Raises:
        ValueError: If the task, algorithm or regularizer is missing, and as :func:`read_json`.
    """
    path = Path(run) / "config.json"
    config = read_json(path)
    for group in ("task", "algorithm", "regularizer"):
        chosen = config.get(group)
        if not isinstance(chosen, dict) or "name" not in chosen:
            raise UserError(f"{path} has no {group}.name: {REMEDY}")
    return config


def read_evaluation(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``evaluation.json``.

    Raises:
        ValueError: If a summary has other values than finite numbers, and as :func:`read_json`.
    """
    path = Path(run) / "evaluation.json"
    evaluation = read_json(path)
    for test in (evaluation, evaluation.get("sampled") or {}):
        summary = test.get("summary", {}) if isinstance(test, dict) else None
        # Unknown values are null.
        numbers = isinstance(summary, dict) and all(
            value is None or (isinstance(value, int | float) and value not in (math.inf, -math.inf))
            for value in summary.values()
        )
        if not numbers:
            raise UserError(f"{path} must contain finite numbers, got {test!r:.40}: {REMEDY}")
    if not isinstance(evaluation.get("training", {}), dict):
        raise UserError(f"{path} must contain an object 'training': {REMEDY}")
    return evaluation


def _read_text(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8-sig")  # Excel may add a mark.
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is missing from the run's folder: restore it.") from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not valid UTF-8 ({error.reason}): {REMEDY}") from None
