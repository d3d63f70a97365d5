"""Everything that a run writes and reads back: whole, noticing damage, and without running code.

Checkpoints are a short header (magic, format version, SHA-256 of the rest) and then a
``torch.save`` of tensors and plain values, which ``torch.load(weights_only=True)`` reads back.
"""

# torchrl.checkpoint (0.14) was tried in their place, on every damage of the tests. Its archives
# load no wrong numbers, but let changed bytes of the ZIP's headers pass and fail in many ways; its
# folders load wrong numbers silently. Entries that are no tensors are unpickled, which executes
# what a forged file says. Writing over a file leaves a moment without one, and flushes nothing.

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import math
import os
import pickle
import struct
import subprocess
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import torch

from torchrl_l2c2.experiment.loggers import close_logger, make_logger

VERSIONED = (
    *("torchrl-l2c2", "torch", "torchrl", "tensordict", "numpy", "gymnasium"),
    *("pybullet", "pybullet-envs-gymnasium", "mujoco"),
)
MAGIC = b"torchrl_l2c2\n"
FORMAT_VERSION = 1
HEADER = struct.Struct(f"<{len(MAGIC)}sI32s")
PATTERN = "checkpoint_*.pt"
README = """\
A run of torchrl_l2c2.

config.json           every setting
versions.json         of the packages that decide the numbers
metrics.csv           a line per training episode
train.log             what the run said
checkpoint_*.pt       what it continues from: the same command again, or resume=FOLDER
policy.pt             the acting policy at the end of training, a state_dict
policy_best.pt        the best one of evaluations.json, likewise (evaluate_every)
evaluations.json      tests during training (evaluate_every)
evaluation.json       test episodes at the end
learning_curves.png   a picture of metrics.csv
diagnosis.html        why the policy shakes (experiment.diagnose)
video.mp4             a test episode (record)
export/               the policy as ONNX and torch.export program (experiment.export)

To load the policy, a TorchRL actor, with an environment of its task:

    from torchrl.envs import set_exploration_type
    from torchrl_l2c2.experiment import load_policy
    policy, env, max_steps = load_policy("path of this folder")
    with set_exploration_type("deterministic"):  # the mean; without it, samples as in training
        rollout = env.rollout(max_steps, policy)

To play test episodes with it:

    python -m torchrl_l2c2.experiment.evaluate FOLDER --episodes 100
"""


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be used, and why."""


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers, as far as they are installed."""
    found = {}
    for name in VERSIONED:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def code_commit() -> str:
    """The commit of this code, ``-dirty`` if changed since; empty outside of a git checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    describe = ("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    try:
        done = subprocess.run(
            ("git", "-C", str(root), *describe), capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


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
        return torch.load(io.BytesIO(_payload(path)), "cpu", weights_only=True)
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
    magic, found, digest = HEADER.unpack_from(content)
    if magic != MAGIC:
        raise CheckpointError(f"{path}: is not a checkpoint of torchrl_l2c2.")
    if found != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: has format version {found}, this version of torchrl_l2c2 reads "
            f"{FORMAT_VERSION}; use the version that wrote it (versions.json beside it)."
        )
    payload = content[HEADER.size :]
    if hashlib.sha256(payload).digest() != digest:
        raise CheckpointError(f"{path}: is damaged, its checksum differs.")
    return payload


def save_policy(policy: torch.nn.Module, path: str | Path) -> None:
    """Writes the policy's ``state_dict``; read it with ``torch.load(path, weights_only=True)``."""
    content = io.BytesIO()
    torch.save({k: v.detach().clone() for k, v in policy.state_dict().items()}, content)
    write_atomically(path, content.getvalue())


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Writes what a run begins with: its settings, its versions, and what its files are."""
    write_json(folder / "config.json", settings)
    write_json(folder / "versions.json", {**versions(), "commit": code_commit()})
    (folder / "README.txt").write_text(README)


class MetricsLog:
    """Writes rows of numbers; a killed process leaves no half of a line.

    Args:
        folder (Path, optional): where ``metrics.csv`` goes, and what the logger writes; ``None``
            writes nothing.
        logger (str): one of :func:`~torchrl_l2c2.experiment.loggers.make_logger`.
    """

    def __init__(self, folder: Path | None, *, logger: str = "csv") -> None:
        self.path = None if folder is None else folder / "metrics.csv"
        self.columns: list[str] | None = None
        self._name = logger
        self._logger = None if folder is None else make_logger(logger, folder)

    def close(self) -> None:
        """Ends what the logger has open."""
        if self._logger is not None:
            self._logger = None
            close_logger(self._name)

    def write(self, row: Mapping[str, float]) -> None:
        """Adds one line; the first line fixes the columns.

        Raises:
            ValueError: the row's names differ from the first row's.
        """
        if self.path is None:
            return
        if self.columns is None:
            self.columns = list(row)
            _append(self.path, self.columns, "wb")
        if list(row) != self.columns:
            raise ValueError(f"the metrics changed from {self.columns} to {list(row)}.")
        _append(self.path, row.values(), "ab")
        if self._logger is not None:
            for name, value in row.items():
                self._logger.log_scalar(name, value, step=int(row["frames"]))

    def state_dict(self) -> dict[str, Any]:
        """How far the file goes."""
        size = 0 if self.path is None or self.columns is None else self.path.stat().st_size
        return {"columns": self.columns, "size": size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Cuts off what was written after the state was taken, so that no line comes twice.

        Raises:
            ValueError: the file is shorter than it was.
        """
        self.columns = state["columns"]
        if self.path is None or self.columns is None:
            return
        size = self.path.stat().st_size if self.path.exists() else 0
        if size < state["size"]:
            raise ValueError(
                f"{self.path} has {size} bytes, the checkpoint was taken at {state['size']}: it "
                "was changed since. Restore it, or choose another folder."
            )
        os.truncate(self.path, state["size"])


def _append(path: Path, cells: Iterable[object], mode: Literal["wb", "ab"]) -> None:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    # Unbuffered: one call of the system writes the whole line.
    with _named(path), open(path, mode, buffering=0) as file:
        file.write(line.getvalue().encode())
