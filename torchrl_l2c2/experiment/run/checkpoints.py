"""Checkpoints that are written atomically, detect damage, and are loaded without executing code.

A checkpoint has a short header (magic, format version, SHA-256 of the rest), followed by a
``torch.save`` of tensors and plain values for ``torch.load(weights_only=True)``.
"""

# Not torchrl.checkpoint (0.14), which was tested with the same damaged files: its archives miss
# changed bytes in ZIP headers, its folders silently load wrong numbers, entries other than tensors
# are unpickled, which may execute code, and overwriting a file is neither atomic nor flushed.

from __future__ import annotations

import hashlib
import io
import pickle
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import write_atomically

MAGIC = b"torchrl_l2c2\n"
FORMAT_VERSION = 1
HEADER = struct.Struct(f"<{len(MAGIC)}sI32s")
PATTERN = "checkpoint_[0-9]*.pt"


class CheckpointError(UserError):
    """A checkpoint is missing, damaged, or of another format."""


def save_checkpoint(folder: str | Path, episode: int, state: Mapping[str, Any], keep: int) -> Path:
    """Writes a checkpoint, checks that it can be read, and then removes the oldest checkpoints.

    Args:
        folder (str or Path): Folder of the checkpoints.
        episode (int): Number in the file's name. Larger numbers are newer.
        state (Mapping): Nested tensors and plain values.
        keep (int): Number of latest checkpoints to keep, at least 1. With 2, one may be damaged.

    Returns:
        Path: Path of the checkpoint.

    Raises:
        OSError: If the checkpoint could not be written or is damaged on the disk. Older checkpoints
            remain.
    """
    import torch

    content = io.BytesIO()
    torch.save(dict(state), content)
    payload = content.getvalue()
    header = HEADER.pack(MAGIC, FORMAT_VERSION, hashlib.sha256(payload).digest())
    path = Path(folder) / f"checkpoint_{episode:08d}.pt"
    write_atomically(path, header + payload)
    try:
        _payload(path)
    except CheckpointError as error:
        path.unlink()
        raise OSError(f"the checkpoint was damaged while it was written: {error}") from error
    # Checkpoints with larger numbers are damaged, otherwise the run would have continued from them.
    for old in [each for each in list_checkpoints(folder) if each.name <= path.name][keep:]:
        old.unlink()
    return path


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Loads a checkpoint.

    Raises:
        CheckpointError: If the checkpoint is missing, incomplete, damaged or of another format
            version.
    """
    import torch

    path = Path(path)
    payload = _payload(path)
    try:
        return torch.load(io.BytesIO(payload), "cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise CheckpointError(f"{path}: its content cannot be read ({error}).") from error


def list_checkpoints(folder: str | Path) -> list[Path]:
    """Returns a folder's checkpoints, the latest first."""
    return sorted(Path(folder).glob(PATTERN), reverse=True)


def load_newest(folder: str | Path) -> tuple[Path, dict[str, Any], list[str]] | None:
    """Loads the latest intact checkpoint.

    Returns:
        tuple: Path, state, and a message for each newer, damaged checkpoint; ``None`` if the folder
        has no checkpoints.

    Raises:
        CheckpointError: If all checkpoints are damaged.
    """
    damaged: list[str] = []
    for path in list_checkpoints(folder):
        try:
            return path, load_checkpoint(path), damaged
        except CheckpointError as error:
            damaged.append(str(error))
    if damaged:
        raise CheckpointError("all checkpoints are damaged: " + " ".join(damaged))
    return None


def _payload(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}).") from error
    if len(content) < HEADER.size:
        raise CheckpointError(f"{path}: is incomplete, with only {len(content)} bytes.")
    magic, found, digest = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise CheckpointError(f"{path}: is not a checkpoint of torchrl_l2c2.")
    if found != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: has format version {found}, but this version of torchrl_l2c2 reads only "
            f"version {FORMAT_VERSION}: use the version that wrote it (see versions.json)."
        )
    payload = content[HEADER.size :]
    if hashlib.sha256(payload).digest() != digest:
        raise CheckpointError(f"{path}: is damaged, its checksum differs.")
    return payload
