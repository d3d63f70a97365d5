"""Rows about a whole run, from its start on, and about several at once."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from statistics import median

import torch

from benchmarks.setups import Effort, paper_config, play_episode
from benchmarks.timing import Row, alternate
from torchrl_l2c2.experiment import Experiment
from torchrl_l2c2.experiment.envs.environments import time_limit
from torchrl_l2c2.experiment.run.metrics_log import MetricsLog

ROOT = Path(__file__).parent.parent


def run_rows(effort: Effort) -> Iterable[Row]:
    """A whole run of the paper's experiment, in frames, against the sum of its parts."""
    with tempfile.TemporaryDirectory() as folder:
        config = paper_config(effort)
        run, parts = Experiment(config, folder), Experiment(config, Path(folder) / "parts")
        parts_episode = play_episode(parts)
        parts_episode()
        learner, row = parts.learner.update, parts.metrics[-1]
        log = MetricsLog(Path(folder) / "parts")
        draw = learner.draw()
        priority = torch.rand(len(draw.rows))
        episode = parts.player.collector.rollout()
        frames = time_limit(config.task)
        summed: dict[str, Callable[[], object]] = {
            "collect": partial(_of_episode, parts.player.collector.rollout, frames),
            "store": partial(_of_episode, lambda: parts.learner.remember(episode), frames),
            "learn": partial(_repeat, lambda: learner(True), frames),
            "log": partial(_of_episode, lambda: log.write(row), frames),
            "checkpoint": partial(_of_episode, parts.save, frames),
        }
        # Parts of learning, only shown: a loop of a single part is faster than in a run.
        detail: dict[str, Callable[[], object]] = {
            "draw": partial(_repeat, learner.draw, frames),
            "update": partial(_repeat, lambda: learner.update(True, *draw), frames),
            "prioritize": partial(_repeat, lambda: learner.prioritize(draw.rows, priority), frames),
        }
        times = alternate(
            {"run": play_episode(run), **summed, **detail}, repeats=max(1, effort.rounds // 3)
        )
    yield Row(
        "run",
        "whole Swingup run / sum of its parts, per frame",
        times["run"] / sum(times[name] for name in summed),
        at_most=1.15,
        parts={f"{name} us": 1e6 * seconds for name, seconds in times.items()},
    )
    yield Row(
        "run",
        "drawing rows and setting priorities / update",
        (times["draw"] + times["prioritize"]) / times["update"],
        at_most=0.15,
        parts={f"{name} us": 1e6 * times[name] for name in detail},
    )


def start_rows(effort: Effort) -> Iterable[Row]:
    """Time until the first update of a run with a filled compiler cache."""
    command = [sys.executable, "-c", START, "" if effort.compile else "--quick"]

    def seconds() -> float:
        done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
        return float(done.stdout.splitlines()[-1])

    first, later = seconds(), median(seconds() for _ in range(max(1, effort.rounds // 5)))
    yield Row(
        "start",
        "second run, from having imported torch to the first update",
        later,
        unit="s",
        at_most=8.0,
        # Earlier compilations on this machine speed it up, too.
        parts={"first run s": first, "second run s": later},
    )


START = """
import sys, time
import torch
start = time.perf_counter()
from benchmarks.setups import QUICK, Effort, paper_config
from torchrl_l2c2.experiment import Experiment
experiment = Experiment(paper_config(QUICK if sys.argv[1] else Effort(steps=100)))
experiment.learner.remember(experiment.player.collector.rollout())
experiment.learner.update(True)
print(time.perf_counter() - start)
"""


def process_rows(effort: Effort) -> Iterable[Row]:
    """Frames per second of two runs at once, by frames per second of one."""
    command = [sys.executable, "-m", "benchmarks.speed", "--worker"]
    command += [] if effort.compile else ["--quick"]
    pipe = subprocess.PIPE
    # One after the other: the second finds what the first has compiled.
    workers = []
    for _ in range(2):
        worker = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=ROOT)
        _answer(worker)
        workers.append(worker)

    def play(*chosen: subprocess.Popen[str]) -> int:
        for worker in chosen:
            print("go", file=worker.stdin, flush=True)
        return sum(int(_answer(worker)) for worker in chosen)

    times = alternate(
        {
            "one": lambda: play(workers[0]) + play(workers[1]),
            "two": lambda: play(*workers),
        },
        repeats=max(1, effort.rounds // 3),
    )
    for worker in workers:
        worker.communicate()
    yield Row(
        "processes",
        "two runs side by side / one, frames/s",
        times["one"] / times["two"],
        at_least=1.8,
        parts={"one frames/s": 1.0 / times["one"], "two frames/s": 1.0 / times["two"]},
    )


def work(effort: Effort) -> None:
    """Plays an episode for every line of the standard input, in a process of ``process_rows``."""
    play = play_episode(Experiment(paper_config(effort)))
    play()
    print("ready", flush=True)
    for _ in sys.stdin:
        print(play(), flush=True)


def import_rows(effort: Effort) -> Iterable[Row]:
    """Time that importing this package adds to importing TorchRL."""
    # The parts of TorchRL that the package builds on; `import torchrl` loads them late.
    parts_of_torchrl = "torchrl.data, torchrl.envs, torchrl.modules, torchrl.objectives"
    statements = {
        "import torchrl_l2c2 s": ("import torchrl", "import torchrl_l2c2"),
        "all names of torchrl_l2c2 after torchrl s": (
            f"import {parts_of_torchrl}",
            "from torchrl_l2c2 import *",
        ),
    }
    parts = {
        name: median(_import_seconds(*pair) for _ in range(max(1, effort.rounds // 3)))
        for name, pair in statements.items()
    }
    yield Row(
        "import",
        "import torchrl_l2c2 beyond import torchrl",
        parts["import torchrl_l2c2 s"],
        unit="s",
        at_most=0.2,
        parts=parts,
    )


def _import_seconds(before: str, statement: str) -> float:
    code = (
        f"import time; {before}; start = time.perf_counter()\n"
        f"{statement}; print(time.perf_counter() - start)"
    )
    command = [sys.executable, "-c", code]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def _answer(worker: subprocess.Popen[str]) -> str:
    assert worker.stdout is not None
    return worker.stdout.readline()


def _of_episode(action: Callable[[], object], frames: int) -> int:
    action()
    return frames


def _repeat(action: Callable[[], object], times: int) -> int:
    for _ in range(times):
        action()
    return times
