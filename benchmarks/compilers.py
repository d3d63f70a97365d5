"""Compares this package's compiler of an update with ``torch.compile``.

``python -m benchmarks.compilers`` prints, for PPO-RPE and SAC with L2C2, the seconds of the first
update with an empty and with a filled compiler cache, and the time of a later update; processes of
the two compilers alternate. ``torch.compile`` runs with the public filter
``torch.compiler.skip_all_guards_unsafe``, which removes all checks of a call.
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
from torchrl_l2c2.experiment.learn import update as update_module
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
    # Traced, TorchRL's losses keep detached parameters, which our own compiler has them forget;
    # torch.compile would replay the forgetting at every call, where there is nothing to forget.
    vars(update_module)["forget_traced"] = lambda loss: None
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


def measure(algorithm: str, compiler: str) -> None:
    """Prints the seconds of the first update, and the median microseconds of later ones."""
    update = make_update(algorithm, compiler)
    started = time.perf_counter()
    update()
    first = time.perf_counter() - started
    times = []
    for _ in range(UPDATES):
        started = time.perf_counter()
        update()
        times.append(time.perf_counter() - started)
    print(json.dumps({"first_s": first, "update_us": 1e6 * statistics.median(times)}))


def in_a_process(algorithm: str, compiler: str, cache: str) -> dict[str, float]:
    """The numbers of :func:`measure`, from a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.compilers", "--one", algorithm, compiler],
        env={**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def compare(algorithm: str, rounds: int) -> dict[str, dict[str, float]]:
    """Medians of both compilers for an algorithm's update; the processes alternate."""
    found: dict[str, list[tuple[float, float, float]]] = {name: [] for name in COMPILERS}
    for _ in range(rounds):
        for compiler in COMPILERS:
            with tempfile.TemporaryDirectory() as cache:
                cold, warm = (in_a_process(algorithm, compiler, cache) for _ in range(2))
            found[compiler].append((cold["first_s"], warm["first_s"], warm["update_us"]))
    names = ("first_cold_s", "first_warm_s", "update_us")
    return {
        compiler: dict(zip(names, map(statistics.median, zip(*each, strict=True)), strict=True))
        for compiler, each in found.items()
    }


def main() -> None:
    """Prints the comparison as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--algorithms", nargs="+", default=["ppo_rpe", "sac"])
    parser.add_argument("--one", nargs=2, metavar=("ALGORITHM", "COMPILER"))
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    if chosen.one:
        measure(*chosen.one)
        return
    print(json.dumps({name: compare(name, chosen.rounds) for name in chosen.algorithms}, indent=2))


if __name__ == "__main__":
    main()
