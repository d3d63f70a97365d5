"""Files that are written whole or not at all, with errors that name them."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any


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
        OSError: as :func:`make_folder`, or the path is that of a folder.
    """
    if Path(path).is_dir():
        raise OSError(f"{str(path)!r} is a folder; name a file.")
    make_folder(Path(path).parent)


def write_atomically(path: str | Path, content: bytes) -> None:
    """Writes a file whole or not at all: a temporary file, flushed to the disk, then renamed.

    Raises:
        OSError: names the file; what was there before is untouched.
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
    """Writes a value as indented JSON, whole or not at all; what is no number is ``null`` there."""
    write_atomically(path, (to_json(value) + "\n").encode())


def to_json(value: Any) -> str:
    """A value as indented JSON; what is no number is ``null`` there."""
    return json.dumps(_strict(value), indent=2)


def _strict(value: Any) -> Any:
    """JSON knows neither NaN nor infinity; Python writes them all the same."""
    if isinstance(value, Mapping):
        return {key: _strict(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
