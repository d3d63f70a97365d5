"""Writing files so that a reader, or the next run, never meets half of one."""

from __future__ import annotations

import json
import os
import tempfile
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
            f"the run's folder {str(folder)!r} cannot be written to ({error.strerror}); "
            "choose another with outputs=FOLDER."
        ) from error
    return folder


def write_atomically(path: str | Path, content: bytes) -> None:
    """Writes a file whole or not at all: a temporary file, flushed to the disk, then renamed."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.partial")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: str | Path, value: Any) -> None:
    """Writes a value as indented JSON, whole or not at all."""
    write_atomically(path, (json.dumps(value, indent=2) + "\n").encode())
