"""Checkpoints that hold a whole run, notice damage, and load without executing code.

A file is a short header (magic, format version, SHA-256 of the rest) and then a ``torch.save`` of
tensors and plain values, which ``torch.load(weights_only=True)`` reads back.
"""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import random
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torchrl.data import TensorDictPrioritizedReplayBuffer, TensorDictReplayBuffer

from torchrl_l2c2.experiment.files import write_atomically

MAGIC = b"torchrl_l2c2\n"
FORMAT_VERSION = 1
HEADER = struct.Struct(f"<{len(MAGIC)}sI32s")
PATTERN = "checkpoint_*.pt"


class CheckpointError(RuntimeError):
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
    for old in list_checkpoints(folder)[keep:]:
        old.unlink()
    return path


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Reads one checkpoint.

    Raises:
        CheckpointError: missing, empty, cut short, changed, or of another format version.
    """
    path = Path(path)
    try:
        return torch.load(io.BytesIO(_payload(path)), weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        if isinstance(error, CheckpointError):
            raise
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
    magic, version, digest = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise CheckpointError(f"{path}: is not a checkpoint of torchrl_l2c2.")
    if version != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: has format version {version}, this version of torchrl_l2c2 reads "
            f"{FORMAT_VERSION}; use the version that wrote it (versions.json beside it)."
        )
    payload = content[HEADER.size :]
    if hashlib.sha256(payload).digest() != digest:
        raise CheckpointError(f"{path}: is damaged, its checksum differs.")
    return payload


def global_rng_state() -> dict[str, Any]:
    """The states of Python's, NumPy's and PyTorch's global generators."""
    name, keys, *rest = np.random.get_state()
    return {
        "python": json.dumps(random.getstate()),
        "numpy": json.dumps([name, keys.tolist(), *rest]),
        "torch": torch.get_rng_state(),
    }


def set_global_rng_state(state: Mapping[str, Any]) -> None:
    """Restores what :func:`global_rng_state` gave."""
    version, internal, gauss = json.loads(state["python"])
    random.setstate((version, tuple(internal), gauss))
    np.random.set_state(tuple(json.loads(state["numpy"])))
    torch.set_rng_state(state["torch"])


def replay_state(replay: TensorDictReplayBuffer) -> dict[str, Any]:
    """A replay buffer's ``state_dict`` with the priorities as tensors instead of C++ objects."""
    state = dict(replay.state_dict())
    if isinstance(replay, TensorDictPrioritizedReplayBuffer):
        sampler = dict(state["_sampler"])
        index = torch.arange(len(replay))
        for tree in ("_sum_tree", "_min_tree"):
            sampler[tree] = torch.as_tensor(sampler[tree][index])
        state["_sampler"] = sampler
    return state


def load_replay_state(replay: TensorDictReplayBuffer, state: Mapping[str, Any]) -> None:
    """Restores what :func:`replay_state` gave into a buffer made with the same settings."""
    state = dict(state)
    if isinstance(replay, TensorDictPrioritizedReplayBuffer):
        sampler = dict(state["_sampler"])
        empty = replay._sampler.state_dict()
        for tree in ("_sum_tree", "_min_tree"):
            values = sampler[tree]
            sampler[tree] = empty[tree]
            if len(values):
                sampler[tree][torch.arange(len(values))] = values
        state["_sampler"] = sampler
    replay.load_state_dict(state)
