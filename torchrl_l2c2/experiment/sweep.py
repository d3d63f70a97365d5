"""What the jobs of a sweep and the process that began it tell each other.

A folder in the system's temporary one holds it: whether the sweep is to stop, and what failed.
"""

from __future__ import annotations

import _thread
import contextlib
import json
import math
import os
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from torchrl_l2c2.experiment.signals import FINISHING, SAME_SIGNAL_SECONDS, terminate

VARIABLE = "TORCHRL_L2C2_SWEEP"  # of the environment, which a launcher's processes inherit
POLL_SECONDS = 0.2


class Sweep:
    """A sweep, as the process that began it and its jobs see it.

    Attributes:
        begun_by: the process that began it.
        overrides: of its command.
        job_is_here: whether a job runs in this process.
    """

    job_is_here = False
    _following = False

    def __init__(self, folder: Path, begun_by: int, overrides: Sequence[str] = ()) -> None:
        self._folder, self.begun_by, self.overrides = folder, begun_by, overrides

    @classmethod
    def of_this_job(cls) -> Sweep:
        """The sweep that this job belongs to."""
        folder, begun_by, overrides = json.loads(os.environ[VARIABLE])
        return cls(Path(folder), begun_by, overrides)

    @property
    def stopped_by(self) -> int | None:
        """The signal that stopped it; ``None`` where it goes on."""
        path = self._folder / "stopped"
        return int(path.read_text()) if path.exists() else None

    def stop(self, signal_number: int) -> None:
        """No job is to begin any more; those that train are to save and end."""
        if self.stopped_by is not None:
            return
        partial = self._folder / f"stopped.{os.getpid()}"
        partial.write_text(str(signal_number))
        partial.replace(self._folder / "stopped")

    def add_failure(self, job: str, reason: str) -> None:
        """Keeps why a job failed until the sweep's end."""
        with open(self._folder / "failed", "a") as file:
            file.write(json.dumps([job, reason]) + "\n")

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Jobs that failed, with the reason in one line."""
        path = self._folder / "failed"
        lines = path.read_text().splitlines() if path.exists() else []
        return [(job, reason) for job, reason in map(json.loads, lines)]

    def add_finished(self, folder: Path, seconds: float) -> None:
        """Keeps where a finished run lies, and how long it took, until the sweep's end."""
        with open(self._folder / "finished", "a") as file:
            file.write(json.dumps([str(folder), seconds]) + "\n")

    @property
    def finished(self) -> list[Path]:
        """Folders of the runs that are finished, by this sweep or before."""
        return [Path(folder) for folder, _ in self._finished()]

    def standing(self, number: int, params: Mapping[str, str], at_once: int) -> str:
        """Where a sweep stands when a job begins, such as ``"run 3 of 72, about 4.1 h left"``.

        Args:
            number (int): of the job, from 1.
            params (Mapping): sweeps of the configuration, by setting.
            at_once (int): jobs that run at the same time.
        """
        total = count_jobs(self.overrides, params)
        seconds = [each for _, each in self._finished() if math.isfinite(each)]
        place = f"run {number} of {total}"
        if not seconds:
            return place
        rounds = math.ceil((total - number + 1) / at_once)
        return f"{place}, {_about(rounds * statistics.fmean(seconds))} left"

    def _finished(self) -> list[tuple[str, float]]:
        path = self._folder / "finished"
        lines = path.read_text().splitlines() if path.exists() else []
        return [(folder, seconds) for folder, seconds in map(json.loads, lines)]

    @contextlib.contextmanager
    def job(self) -> Iterator[None]:
        """A job of the sweep runs within it: a stop ends it in order, wherever it is."""
        if os.getpid() != self.begun_by:
            self._follow()
        Sweep.job_is_here = True
        try:
            yield
        finally:
            Sweep.job_is_here = False

    def _follow(self) -> None:
        """A stop reaches this process as SIGTERM, and it dies with the one that began the sweep.

        Also between two jobs, when it waits for one that will never come.
        """
        signal.signal(signal.SIGTERM, terminate)
        if Sweep._following:
            return
        Sweep._following = True

        def follow() -> None:
            told = False
            while True:
                time.sleep(POLL_SECONDS)
                if os.getppid() != self.begun_by:
                    os._exit(1)
                if not told and Sweep.job_is_here and self.stopped_by is not None:
                    told = True
                    _thread.interrupt_main(signal.SIGTERM)

        threading.Thread(target=follow, daemon=True).start()


def count_jobs(overrides: Sequence[str], params: Mapping[str, str]) -> int:
    """How many jobs a sweep has: a product of choices, where the command's go before.

    Examples:
        >>> count_jobs(["-m", "seed=0,1", "task=ant"], {"seed": "range(0,18)", "beta": "1,2,3"})
        6
    """
    given = {**params}
    for override in overrides:
        name, _, value = override.partition("=")
        if not override.startswith("-"):
            given[name] = value
    parser = OverridesParser.create()
    parsed = parser.parse_overrides([f"{name}={value}" for name, value in given.items()])
    sweeps = [each for each in parsed if each.is_sweep_override()]
    return math.prod(sum(1 for _ in each.sweep_string_iterator()) for each in sweeps)


def _about(seconds: float) -> str:
    hours = seconds / 3600
    return f"about {hours:.1f} h" if hours >= 1 else f"about {max(1, round(60 * hours))} min"


@contextlib.contextmanager
def begin_sweep(overrides: Sequence[str] = ()) -> Iterator[Sweep]:
    """Begins a sweep in this process: the first Ctrl-C or SIGTERM stops it in order.

    Args:
        overrides (sequence of str): of its command.
    """
    with tempfile.TemporaryDirectory(prefix="torchrl_l2c2_") as folder:
        sweep, first = Sweep(Path(folder), os.getpid(), overrides), 0.0

        def receive(number: int, frame: Any) -> None:
            nonlocal first
            if sweep.stopped_by is None:
                first = time.monotonic()
                sweep.stop(number)
                if Sweep.job_is_here:  # and not training, where it has a handler of its own
                    terminate(number, frame)
                print(f"\n{FINISHING}; once more: at once", file=sys.stderr, flush=True)
            elif time.monotonic() - first > SAME_SIGNAL_SECONDS:
                terminate(number, frame)

        os.environ[VARIABLE] = json.dumps([folder, os.getpid(), [*overrides]])
        previous = {n: signal.signal(n, receive) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield sweep
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
