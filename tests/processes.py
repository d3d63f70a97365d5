"""The command in processes of its own, whose imports, seconds for each, one process makes for all.

They are forked from it: each has its number, its signals and its end, as if a shell had begun it.
"""

from __future__ import annotations

import atexit
import multiprocessing
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).parent.parent
TRAIN = ROOT / "train.py"
IMPORTED = multiprocessing.get_context("forkserver")
IMPORTED.set_forkserver_preload(
    [
        "matplotlib.figure",
        "pybullet_envs_gymnasium",
        "torchrl.objectives",
        "torchrl_l2c2.experiment.cli.train",
        "torchrl_l2c2.experiment.analysis.diagnosis",
        "torchrl_l2c2.experiment.run.experiment",
    ]
)


class Started:
    """A process, with as much of ``subprocess.Popen`` as tests use."""

    def __init__(self, process: multiprocessing.Process) -> None:
        self._process = process
        self.pid = process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout)
        return self.returncode

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


def start_train(
    *overrides: str,
    output: Path,
    errors: Path | None = None,
    cwd: Path | None = None,
    session: bool = False,
    script: Path = TRAIN,
) -> Started:
    """Begins ``python train.py`` with what it says going to files; a pipe might be full.

    Args:
        overrides (str): its arguments.

    Keyword Args:
        output (Path): gets what is printed.
        errors (Path, optional): likewise. Default: the same file.
        cwd (Path, optional): where it is begun. Default: here.
        session (bool): whether it has a session of its own, as a terminal has one.
        script (Path): what is run instead of ``train.py``.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    files = [str(output), str(errors or output)]
    arguments = (overrides, files, str(cwd or Path.cwd()), environment, session, str(script))
    process = IMPORTED.Process(target=_train, args=arguments)
    process.start()
    return Started(process)


def run_train(
    *overrides: str, cwd: Path, check: bool = True, script: Path = TRAIN
) -> subprocess.CompletedProcess[str]:
    """Runs ``python train.py`` to its end, as ``subprocess.run`` does with ``capture_output``."""
    with tempfile.TemporaryDirectory() as folder:
        output, errors = (Path(folder) / name for name in ("output", "errors"))
        process = start_train(*overrides, output=output, errors=errors, cwd=cwd, script=script)
        code = process.wait()
        done = subprocess.CompletedProcess(overrides, code, output.read_text(), errors.read_text())
    if check:
        assert code == 0, done.stderr
    return done


def _train(
    overrides: tuple[str, ...],
    files: list[str],
    cwd: str,
    environment: Mapping[str, str],
    session: bool,
    script: str,
) -> None:
    if session:
        os.setsid()
    for descriptor, file in enumerate(files, 1):
        opened = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(cwd)
    sys.argv = [script, *overrides]
    paths = environment.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = [str(ROOT), *filter(None, paths)]
    try:
        runpy.run_path(script, run_name="__main__")
    finally:
        # A process that Python's multiprocessing has begun does without.
        atexit._run_exitfuncs()
