"""Messages between the jobs of a sweep and the process that started it, also across machines.

A folder next to the runs has one file per message, because several machines cannot append to one
file: requests to stop, and running, finished and failed jobs.
"""

from __future__ import annotations

import _thread
import atexit
import contextlib
import hashlib
import itertools
import json
import math
import os
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from torchrl_l2c2.experiment.errors import UserError, one_line_errors
from torchrl_l2c2.experiment.run.files import make_folder
from torchrl_l2c2.experiment.run.signals import FINISHING, SAME_SIGNAL_SECONDS, terminate
from torchrl_l2c2.experiment.settings.fields import SettingError

VARIABLE = "TORCHRL_L2C2_SWEEP"  # Environment variable, inherited by a launcher's processes.
POLL_SECONDS = 0.2
REMOTE_POLL_SECONDS = 2.0  # Hundreds of machines may share the file system.
LOST = "lost with its process or machine, or still running"
GUARD = Path(__file__).with_name("guard.py")


class Sweep:
    """A sweep, in the process that started it or in one of its jobs.

    Args:
        folder (Path): Folder of the messages.
        started_by (tuple): Host name and process id of the process that started the sweep.
        overrides (sequence of str): Overrides of its command.

    Attributes:
        started_here: Sweep that this process started, or ``None``.
        job_is_here: Whether a job runs in this process.
    """

    started_here: Sweep | None = None
    job_is_here = False
    _watching = False

    def __init__(self, folder: Path, started_by: tuple[str, int], overrides: Sequence[str]) -> None:
        self._folder, self.started_by, self.overrides = folder, started_by, overrides

    @classmethod
    def of_this_job(cls) -> Sweep:
        """Returns the sweep of this job, from the environment.

        Raises:
            UserError: If the launcher did not pass on the environment variable, or this machine
                does not have the folder.
        """
        if VARIABLE not in os.environ:
            raise UserError(
                f"the launcher did not pass the environment variable {VARIABLE} to the job: "
                "configure it to pass the environment."
            )
        folder, (host, process), overrides, _ = json.loads(os.environ[VARIABLE])
        if not Path(folder).parent.is_dir():
            raise UserError(
                f"{str(Path(folder).parent)!r} does not exist on {socket.gethostname()}: choose an "
                "outputs folder on a file system that all machines share."
            )
        return cls(Path(folder), (host, process), overrides)

    @property
    def is_remote(self) -> bool:
        """Checks whether another program, such as a cluster's scheduler, started this process."""
        host, process = self.started_by
        return host != socket.gethostname() or process not in (os.getpid(), os.getppid())

    @property
    def stopped_by(self) -> int | None:
        """Signal that stopped the sweep; ``None`` while it continues."""
        try:
            return int((self._folder / "stopped").read_text())
        except OSError:
            # Without a folder the sweep has ended, and this job was still waiting.
            return None if self._folder.is_dir() else signal.SIGTERM

    def stop(self, signal_number: int) -> None:
        """Stops the sweep: no job starts, and running jobs save and end."""
        if self.stopped_by is None:
            self._put("stopped", str(signal_number))

    def share(self, outputs: Path) -> None:
        """Moves the messages to a folder that all machines can read, before any job starts.

        Args:
            outputs (Path): Parent folder of the messages.

        Raises:
            OSError: If the folder is not writable.
        """
        stopped, self._folder = self.stopped_by, make_folder(outputs) / f".{self._folder.name}"
        self._folder.mkdir()
        self.publish()
        if stopped is not None:
            self.stop(stopped)

    def publish(self) -> None:
        """Passes the sweep to all later child processes, by the environment."""
        values = [str(self._folder), self.started_by, [*self.overrides], os.getcwd()]
        os.environ[VARIABLE] = json.dumps(values)

    def end(self) -> None:
        """Removes the messages: jobs that are still running save and end."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def add_failure(self, number: int, job: str, reason: str) -> None:
        """Stores the reason for a job's failure until the end of the sweep."""
        self._put(f"failed_{number:06d}", json.dumps([job, reason]))
        self._ended(number)

    @property
    def failures(self) -> list[tuple[str, str]]:
        """Failed and lost jobs, with the reason in one line."""
        failed = {number: (job, reason) for number, (job, reason) in self._all("failed")}
        if self.stopped_by is None:
            lost = f"{LOST}; the same command continues it"
            failed |= {number: (job, lost) for number, job in self._all("running")}
        return [failed[number] for number in sorted(failed)]

    def claim(self, number: int, folder: Path) -> None:
        """Reserves a run's folder for one job of the sweep.

        Args:
            number (int): Number of the job.
            folder (Path): Run folder.

        Raises:
            SettingError: If another job has the folder: its results would be replaced.
        """
        claim = self._folder / f"claim_{hashlib.sha256(str(folder).encode()).hexdigest()[:16]}"
        try:
            # Mode "x": if two jobs start at once, only one of them creates the file.
            with open(claim, "x") as file:
                file.write(str(number))
        except FileExistsError:
            if (other := claim.read_text()) != str(number):
                raise SettingError(
                    "outputs",
                    f"must differ between jobs {other} and {number} of the sweep, which have the "
                    f"same folder {folder}: their settings are the same, or differ only in "
                    "settings that are not part of the folder's name (length of training and "
                    "tests, threads, ...). Leave one job out, sweep over outputs as well, or run "
                    "two commands.",
                ) from None
        except FileNotFoundError:  # The sweep has ended.
            return

    def add_finished(self, number: int, folder: Path, seconds: float) -> None:
        """Stores the folder and the duration of a finished run until the end of the sweep."""
        self._put(f"finished_{number:06d}", json.dumps([str(folder), seconds]))

    @property
    def finished(self) -> list[Path]:
        """Folders of the finished runs, including runs that were finished before the sweep."""
        return [Path(folder) for _, (folder, _) in self._all("finished")]

    def status(self, number: int, params: Mapping[str, str]) -> str:
        """Returns the progress at the start of a job, such as ``"run 3 of 72, about 4.1 h left"``.

        Args:
            number (int): Number of the job, from 1.
            params (Mapping): Sweeps in the configuration, by setting.
        """
        try:
            jobs = list_jobs(self.overrides, params)
        except HydraException:  # A glob: only Hydra knows the number of jobs.
            return f"run {number}"
        # Durations differ between tasks; tasks without a finished run count with the mean.
        tasks = [(job.get("task"), job.get("task.env_id")) for job in jobs]
        seconds: dict[tuple[str | None, ...], list[float]] = defaultdict(list)
        for finished, (_, each) in self._all("finished"):
            if math.isfinite(each):
                seconds[tasks[finished]].append(each)
        place = f"run {number} of {len(jobs)}"
        if not seconds:
            return place
        of_task = {task: statistics.fmean(each) for task, each in seconds.items()}
        mean = statistics.fmean(of_task.values())
        left = sum(of_task.get(task, mean) for task in tasks[number - 1 :])
        return f"{place}, {_about(left / max(1, len(self._all('running'))))} left"

    @contextlib.contextmanager
    def job(self, number: int, job: str) -> Iterator[bool]:
        """Context manager for a job of the sweep. Stopping the sweep ends the job in order.

        Args:
            number (int): Number of the job, the same if it is started again.
            job (str): Name of the job.

        Yields:
            bool: Whether the job was started before and lost.
        """
        started_before = (self._folder / f"running_{number:06d}").exists()
        self._put(f"running_{number:06d}", json.dumps(job))
        if self.started_by != (socket.gethostname(), os.getpid()):
            self._watch()
        Sweep.job_is_here = True
        try:
            yield started_before
            self._ended(number)
        finally:
            Sweep.job_is_here = False

    def _ended(self, number: int) -> None:
        (self._folder / f"running_{number:06d}").unlink(missing_ok=True)

    def _put(self, name: str, content: str) -> None:
        """Writes a message atomically, unless the sweep has ended."""
        partial = self._folder / f".{name}.{socket.gethostname()}.{os.getpid()}"
        with contextlib.suppress(FileNotFoundError):
            partial.write_text(content)
            partial.replace(self._folder / name)

    def _all(self, kind: str) -> list[tuple[int, Any]]:
        """Returns the messages of a kind, with the numbers of their jobs."""
        messages = []
        for path in sorted(self._folder.glob(f"{kind}_*")):
            with contextlib.suppress(FileNotFoundError):  # The job has just ended.
                messages.append((int(path.name.rpartition("_")[2]), json.loads(path.read_text())))
        return messages

    def _watch(self) -> None:
        """Watches the sweep in a thread: after a stop, this process gets SIGTERM.

        A local process also ends with the process that started the sweep.
        """
        signal.signal(signal.SIGTERM, terminate)
        if Sweep._watching:
            return
        Sweep._watching = True
        remote = self.is_remote

        def watch() -> None:
            interrupted = False
            while True:
                time.sleep(REMOTE_POLL_SECONDS if remote else POLL_SECONDS)
                if not remote and os.getppid() != self.started_by[1]:
                    os._exit(1)
                if not interrupted and Sweep.job_is_here and self.stopped_by is not None:
                    interrupted = True
                    _thread.interrupt_main(signal.SIGTERM)

        threading.Thread(target=watch, daemon=True).start()


class ShareSweep(Callback):
    """Hydra callback that moves a sweep's messages next to its runs, for all machines."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Moves the messages before Hydra's launcher starts.

        Raises:
            SystemExit: If the folder is not writable. Hydra would swallow other errors.
        """
        if Sweep.started_here is not None:
            with one_line_errors():
                Sweep.started_here.share(Path(config.hydra.sweep.dir).absolute())


def enter_folder() -> None:
    """Changes to the sweep's working directory, for launchers that start jobs elsewhere."""
    os.chdir(json.loads(os.environ[VARIABLE])[-1])


def start_guard(mark: str) -> None:
    """Starts a guard, which ends the processes with this mark when this process has ended."""
    if not Path("/proc/self/environ").exists():
        return
    command = [sys.executable, "-I", "-S", str(GUARD), mark]
    guard = subprocess.Popen(command, stdin=subprocess.PIPE)
    assert guard.stdin is not None
    # Exit handlers run in reverse order: this one, registered first, runs after the launcher's.
    atexit.register(guard.stdin.close)


def list_jobs(overrides: Sequence[str], params: Mapping[str, str]) -> list[dict[str, str]]:
    """Returns the swept settings of each job of a sweep.

    Args:
        overrides (sequence of str): Overrides of the command, which replace ``params``.
        params (Mapping): Sweeps in the configuration, by setting.

    Raises:
        HydraException: If a sweep has no list of values, as a glob or an interval.

    Examples:
        >>> jobs = list_jobs(["-m", "seed=0,1", "task=ant"], {"seed": "range(0,18)", "beta": "1,2"})
        >>> [" ".join(f"{name}={value}" for name, value in job.items()) for job in jobs]
        ['seed=0 beta=1', 'seed=0 beta=2', 'seed=1 beta=1', 'seed=1 beta=2']
    """
    sweeps = _parse_sweeps(overrides, params)
    choices = itertools.product(*(each.sweep_string_iterator() for each in sweeps.values()))
    return [dict(zip(sweeps, chosen, strict=True)) for chosen in choices]


def list_jobs_to_check(overrides: Sequence[str], params: Mapping[str, str]) -> list[dict[str, str]]:
    """Returns jobs of :func:`list_jobs` that show every wrong value, and names that do not fit.

    Values that are names, such as algorithms, occur in all combinations. Numbers occur once each,
    in the first combination; a range has its first and its last number.

    Examples:
        >>> sweep = ["seed=range(0,18)", "beta=1,-3", "algorithm=ppo,td3", "task=ant,hopper"]
        >>> jobs = list_jobs_to_check(sweep, {})
        >>> for job in jobs:
        ...     print(" ".join(job.values()))
        0 1 ppo ant
        0 1 ppo hopper
        0 1 td3 ant
        0 1 td3 hopper
        17 1 ppo ant
        0 -3 ppo ant
    """
    sweeps = _parse_sweeps(overrides, params)
    values = {name: list(each.sweep_string_iterator()) for name, each in sweeps.items()}
    numbers = {name for name, each in values.items() if all(map(_is_number, each))}
    tried = [each[:1] if name in numbers else each for name, each in values.items()]
    jobs = [dict(zip(values, chosen, strict=True)) for chosen in itertools.product(*tried)]
    first = jobs[0]
    for name in values:
        if name in numbers:
            further = values[name][-1:] if sweeps[name].is_range_sweep() else values[name][1:]
            jobs += [{**first, name: value} for value in further]
    return jobs


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parse_sweeps(overrides: Sequence[str], params: Mapping[str, str]) -> dict[str, Override]:
    """Returns the overrides that have several values, by setting."""
    given = {**params}
    for override in overrides:
        name, _, value = override.partition("=")
        if not override.startswith("-"):
            given[name] = value
    parser = OverridesParser.create()
    parsed = parser.parse_overrides([f"{name}={value}" for name, value in given.items()])
    return {each.get_key_element(): each for each in parsed if each.is_sweep_override()}


def _about(seconds: float) -> str:
    hours = seconds / 3600
    return f"about {hours:.1f} h" if hours >= 1 else f"about {max(1, round(60 * hours))} min"


@contextlib.contextmanager
def begin_sweep(overrides: Sequence[str] = ()) -> Iterator[Sweep]:
    """Starts a sweep in this process. The first Ctrl-C or SIGTERM stops it in order.

    Args:
        overrides (sequence of str): Overrides of the command. Default: none.
    """
    # A temporary folder, until the folder of the runs is known.
    with tempfile.TemporaryDirectory(prefix="torchrl_l2c2_") as folder:
        started_by = (socket.gethostname(), os.getpid())
        sweep, first = Sweep(Path(folder), started_by, overrides), 0.0

        def receive(number: int, frame: Any) -> None:
            nonlocal first
            if sweep.stopped_by is None:
                first = time.monotonic()
                sweep.stop(number)
                if Sweep.job_is_here:  # Not training, which has its own handler.
                    terminate(number, frame)
                print(f"\n{FINISHING}; a second signal ends at once", file=sys.stderr, flush=True)
            elif time.monotonic() - first > SAME_SIGNAL_SECONDS:
                terminate(number, frame)

        start_guard(Path(folder).name)
        sweep.publish()
        Sweep.started_here = sweep
        previous = {n: signal.signal(n, receive) for n in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield sweep
        finally:
            sweep.end()
            for number, handler in previous.items():
                signal.signal(number, handler)
            Sweep.started_here = None
