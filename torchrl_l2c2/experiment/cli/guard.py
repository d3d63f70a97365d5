"""Program that ends the processes of a sweep after the process that started it has ended.

``python guard.py MARK``, with the standard library only. MARK is in the environment of all
processes of the sweep. Without it, a launcher's worker would wait for further jobs forever.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

# Training jobs end by themselves.
GRACE_SECONDS = 1.0


def marked(mark: str) -> list[int]:
    """Returns the other processes of the same Slurm job with this text in their environment."""
    found = []
    own_job = _slurm_job(Path("/proc/self/environ").read_bytes())
    for path in Path("/proc").glob("[0-9]*/environ"):
        try:
            environment = path.read_bytes()
        except OSError:  # The process has ended or belongs to another user.
            continue
        number = int(path.parent.name)
        belongs = mark.encode() in environment and _slurm_job(environment) == own_job
        if belongs and number != os.getpid():
            found.append(number)
    return found


def _slurm_job(environment: bytes) -> list[bytes]:
    return [entry for entry in environment.split(b"\0") if entry.startswith(b"SLURM_JOB_ID=")]


def main() -> None:
    """Waits until the other end of the input is closed, then ends the remaining processes."""
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
