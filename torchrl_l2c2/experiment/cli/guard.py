"""Ends the processes of a sweep once the one that began it is gone, however it went.

A program of its own, for the standard library alone: ``python guard.py MARK``, where MARK is in the
environment of every process that belongs to the sweep. A launcher's process that waits for a job
would not notice by itself that none will come.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

# Jobs that train notice by themselves.
GRACE_SECONDS = 1.0


def marked(mark: str) -> list[int]:
    """Other processes with this text in their environment; Slurm's other jobs are Slurm's own."""
    found = []
    own_job = _slurm_job(Path("/proc/self/environ").read_bytes())
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            environment = path.read_bytes()
        except OSError:  # ended, or another user's
            continue
        number = int(path.parent.name)
        belongs = mark.encode() in environment and _slurm_job(environment) == own_job
        if belongs and number != os.getpid():
            found.append(number)
    return found


def _slurm_job(environment: bytes) -> list[bytes]:
    return [entry for entry in environment.split(b"\0") if entry.startswith(b"SLURM_JOB_ID=")]


def main() -> None:
    """Waits until nobody holds the other end of the input, then ends what is left."""
    sys.stdin.buffer.read()
    time.sleep(GRACE_SECONDS)
    while left := marked(sys.argv[1]):
        for number in left:
            try:
                os.kill(number, signal.SIGKILL)
            except OSError:
                continue
        time.sleep(0.1)


if __name__ == "__main__":
    main()
