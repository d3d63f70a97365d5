"""Compares this package's compiler of an update with ``torch.compile``.

``python -m benchmarks.compilers`` prints, for PPO-RPE and SAC with L2C2, the seconds until the
first update with an empty and with a filled compiler cache, and the time of an update, measured in
turns in one process. ``torch.compile`` runs with ``torch.compiler.skip_all_guards_unsafe``, the
public filter that removes all checks of a call.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, TaskConfig
from torchrl_l2c2.experiment.learn.update import ReplayUpdate
from torchrl_l2c2.experiment.settings.algorithms import ALGORITHMS

COMPILERS = ("own", "torch.compile")
UPDATES = 300


def make_update(algorithm: str, compiler: str) -> Callable[[], object]:
    """An update of a new agent with one batch.

    Args:
        algorithm (str): a name of the setting ``algorithm``.
        compiler (str): one of ``COMPILERS``.
    """
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=1)
    config = ExperimentConfig(task=task, algorithm=ALGORITHMS[algorithm])
    experiment = Experiment(replace(config, compile=False))
    learner = experiment.learner
    for _ in range(2):
        learner.remember(experiment.player.collector.rollout())
    update = ReplayUpdate(experiment.agent, learner.replay, compile=compiler == "own")
    draw = update.draw()
    if compiler == "own":
        return lambda: update.update(True, *draw)
    torch._dynamo.config.trace_autograd_ops = True
    compiled = torch.compile(
        update.update,
        fullgraph=True,
        options={
            "guard_filter_fn": torch.compiler.skip_all_guards_unsafe,
            "fallback_random": True,
            "size_asserts": False,
        },
    )
    return lambda: compiled(True, *draw)


def seconds_to_first_update(algorithm: str, compiler: str, cache: str) -> float:
    """Seconds of the first update in a process of its own, without imports."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.compilers", "--first", algorithm, compiler],
        env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    return float(done.stdout.splitlines()[-1])


def compare(algorithm: str, rounds: int) -> dict[str, dict[str, float]]:
    """Times of both compilers for an algorithm's update."""
    found: dict[str, dict[str, float]] = {}
    updates = {}
    for compiler in COMPILERS:
        with tempfile.TemporaryDirectory() as cache:
            cold, warm = (seconds_to_first_update(algorithm, compiler, cache) for _ in range(2))
        found[compiler] = {"first_cold_s": cold, "first_warm_s": warm}
        torch.manual_seed(0)
        updates[compiler] = make_update(algorithm, compiler)
        updates[compiler]()
    times: dict[str, list[float]] = {compiler: [] for compiler in COMPILERS}
    for _ in range(rounds):
        for compiler, update in updates.items():
            started = time.perf_counter()
            for _ in range(UPDATES):
                update()
            times[compiler].append((time.perf_counter() - started) / UPDATES * 1e6)
    for compiler, each in times.items():
        found[compiler]["update_us"] = statistics.median(each)
    return found


def main() -> None:
    """Prints the comparison as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--algorithms", nargs="+", default=["ppo_rpe", "sac"])
    parser.add_argument("--first", nargs=2, metavar=("ALGORITHM", "COMPILER"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    if chosen.first:
        update = make_update(*chosen.first)
        started = time.perf_counter()
        update()
        print(time.perf_counter() - started)
        return
    found = {name: compare(name, chosen.rounds) for name in chosen.algorithms}
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
