"""One process at a time writes a run's folder."""

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
    """Another process writes this folder."""


def lock_folder(folder: Path, holder: Any) -> weakref.finalize[..., Any]:
    """Takes a folder for this process until the holder is gone, or the process is.

    The operating system holds the lock (``flock``) and frees it when the process ends, however it
    ends; on a shared file system that passes such locks on it holds for all machines. Within one
    process a folder can be taken several times.

    Args:
        folder (Path): exists; gets the files ``.lock`` and, for the time being, ``.lock_owner``.
        holder (object): the folder is free again when it is collected.

    Returns:
        weakref.finalize: called, it gives the folder back before that; a second call does nothing.

    Raises:
        FolderInUseError: another process has it; says which, since when, and changes nothing.

    Examples:
        >>> import tempfile
        >>> class Run:
        ...     pass
        >>> run = Run()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     give_back = lock_folder(Path(folder), run)
        ...     _ = give_back()
    """
    lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
    owner = folder / ".lock_owner"
    try:
        lock.acquire()
    except Timeout:
        raise FolderInUseError(
            f"the folder {str(folder)!r} is in use by {_described(owner)}: wait for it or end it, "
            "or choose another folder. Nothing was changed."
        ) from None
    # Not write_atomically: this file is for people, and not worth a flush of the disk.
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    who = {"pid": os.getpid(), "host": socket.gethostname(), "since": since}
    with contextlib.suppress(OSError):  # A full disk is told with what is worth something.
        owner.write_text(json.dumps(who))
    return weakref.finalize(holder, _release, lock, owner)


def wait_for_folder(folder: Path, seconds: float) -> None:
    """Waits until no process has a folder, for so long at most; takes nothing.

    A file server holds the lock of a machine that was lost until it notices: NFS after 90 seconds,
    as it is usually set.
    """
    if seconds > 0 and (folder / ".lock").exists():
        lock = FileLock(folder / ".lock", timeout=0, is_singleton=True)
        with contextlib.suppress(Timeout), lock.acquire(timeout=seconds):
            pass


def _release(lock: FileLock, owner: Path) -> None:
    if lock.lock_counter == 1:
        owner.unlink(missing_ok=True)
    lock.release()


def _described(owner: Path) -> str:
    time.sleep(0.1)  # Who has just taken the lock writes its name a moment later.
    try:
        known = json.loads(owner.read_text())
        return f"process {known['pid']} on {known['host']} since {known['since']}"
    except (OSError, ValueError, KeyError):
        return "another process"
