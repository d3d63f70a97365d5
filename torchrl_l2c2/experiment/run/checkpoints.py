"""Checkpoints: whole, noticing damage, and read back without running code.

A short header (magic, format version, SHA-256 of the rest) and then a ``torch.save`` of tensors and
plain values, which ``torch.load(weights_only=True)`` reads back.
"""

# torchrl.checkpoint (0.14) was tried in their place, on every damage of the tests. Its archives
# load no wrong numbers, but let changed bytes of the ZIP's headers pass and fail in many ways; its
# folders load wrong numbers silently. Entries that are no tensors are unpickled, which executes
# what a forged file says. Writing over a file leaves a moment without one, and flushes nothing.

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
PATTERN = "checkpoint_*.pt"


class CheckpointError(UserError):
    """A checkpoint that cannot be used, and why."""


def save_checkpoint(folder: str | Path, episode: int, state: Mapping[str, Any], keep: int) -> Path:
    """Writes a checkpoint, proves it readable, and only then removes the oldest ones.

    Args:
        folder (str or Path): where checkpoints lie.
        episode (int): the number in the file's name; larger is newer.
        state (Mapping): tensors and plain values, nested.
        keep (int): how many of the newest stay, at least 1. Two survive a disk that damages one.

    Raises:
        OSError: it could not be written, or reads back differently; older ones are untouched.
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
        raise OSError(f"the checkpoint did not survive being written: {error}") from error
    # One with a larger number is damaged, or it would have been gone on from: it counts as none.
    for old in [each for each in list_checkpoints(folder) if each.name <= path.name][keep:]:
        old.unlink()
    return path


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads one checkpoint.

    Raises:
        CheckpointError: missing, empty, cut short, changed, or of another format version.
    """
    import torch

    path = Path(path)
    payload = _payload(path)
    try:
        return torch.load(io.BytesIO(payload), "cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise CheckpointError(f"{path}: its content cannot be read ({error}).") from error


def list_checkpoints(folder: str | Path) -> list[Path]:
    """A folder's checkpoints, the newest first."""
    return sorted(Path(folder).glob(PATTERN), reverse=True)


def load_newest(folder: str | Path) -> tuple[Path, dict[str, Any], list[str]] | None:
    """Reads the newest checkpoint that is whole.

    Returns:
        Its path, its state and a message for every newer one that was damaged; ``None`` where
        the folder holds no checkpoint at all.

    Raises:
        CheckpointError: there are checkpoints, and all of them are damaged.
    """
    damaged: list[str] = []
    for path in list_checkpoints(folder):
        try:
            return path, load_checkpoint(path), damaged
        except CheckpointError as error:
            damaged.append(str(error))
    if damaged:
        raise CheckpointError("no checkpoint can be read: " + " ".join(damaged))
    return None


def _payload(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror}).") from error
    if len(content) < HEADER.size:
        raise CheckpointError(f"{path}: is cut short, {len(content)} bytes are left.")
    magic, found, digest = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise CheckpointError(f"{path}: is not a checkpoint of torchrl_l2c2.")
    if found != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: has format version {found}, this version of torchrl_l2c2 reads "
            f"{FORMAT_VERSION}; use the version that wrote it (see versions.json in the folder)."
        )
    payload = content[HEADER.size :]
    if hashlib.sha256(payload).digest() != digest:
        raise CheckpointError(f"{path}: is damaged, its checksum differs.")
    return payload
