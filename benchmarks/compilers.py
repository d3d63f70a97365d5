"""Times an update that this package's compiler, or ``torch.compile``, has compiled.

``python -m benchmarks.compilers ppo_rpe own`` prints the seconds of the first update and the time
of later ones, with L2C2; ``torch.compile`` instead of ``own`` runs with the public filter
``torch.compiler.skip_all_guards_unsafe``, which removes all checks of a call.
"""

from __future__ import annotations

import argparse
import json
import statistics
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
    vars(update_module)["clear_detached_parameters"] = lambda loss: None
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


def main() -> None:
    """Prints the times of one compiler as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithm", choices=ALGORITHMS)
    parser.add_argument("compiler", choices=COMPILERS)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    measure(chosen.algorithm, chosen.compiler)


if __name__ == "__main__":
    main()
