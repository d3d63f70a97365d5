"""Lock of a run's folder, for one process at a time."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
import weakref
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from torchrl_l2c2.experiment.errors import UserError


class FolderInUseError(UserError):
    """Another process uses the folder."""


def lock_folder(folder: Path, holder: Any) -> weakref.finalize[..., Any]:
    """Locks a folder until the holder is garbage-collected or the process ends.

    The operating system holds the lock (``flock``) and releases it when the process ends, also if
    it is killed. On shared file systems that support such locks, it applies to all machines. The
    same process may lock a folder several times.

    Args:
        folder (Path): Existing folder. It gets the files ``.lock`` and, while locked,
            ``.lock_owner``.
        holder (object): Object whose garbage collection releases the lock.

    Returns:
        weakref.finalize: Function that releases the lock earlier. Later calls do nothing.

    Raises:
        FolderInUseError: If another process has the lock; states the process and the time.

    Examples:
        >>> import tempfile
        >>> class Run:
        ...     pass
        >>> run = Run()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     release = lock_folder(Path(folder), run)
        ...     _ = release()
    """
    lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
    owner = folder / ".lock_owner"
    try:
        lock.acquire()
    except Timeout:
        raise FolderInUseError(
            f"the folder {str(folder)!r} is in use by {_describe_owner(owner)}: wait for it, end "
            "it, or choose another folder. Nothing was changed."
        ) from None
    # Not write_atomically: this file is only for messages, not worth a flush of the disk.
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    who = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
    with contextlib.suppress(OSError):  # A full disk is reported with a more important file.
        owner.write_text(json.dumps(who))
    return weakref.finalize(holder, _release, lock, owner)


def wait_for_folder(folder: Path, seconds: float) -> None:
    """Waits until a folder is unlocked, without locking it.

    File servers release the lock of a crashed machine with a delay, NFS usually after 90 seconds.

    Args:
        folder (Path): Folder.
        seconds (float): Maximum waiting time in seconds.
    """
    if seconds > 0 and (folder / ".lock").exists():
        lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
        with contextlib.suppress(Timeout), lock.acquire(timeout=seconds):
            pass


def _release(lock: FileLock, owner: Path) -> None:
    if lock.lock_counter == 1:
        owner.unlink(missing_ok=True)
    lock.release()


def _describe_owner(owner: Path) -> str:
    time.sleep(0.1)  # The owner's file is written shortly after the lock is acquired.
    try:
        known = json.loads(owner.read_text())
        return f"process {known['pid']} on {known['host']} since {known['since']}"
    except (OSError, ValueError, KeyError):
        return "another process"
