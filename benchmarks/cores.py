"""Time of the paper's table by the number of cores: ``python -m benchmarks.cores``.

An estimate from the times of runs in ``results/runs.csv``. If a task and a method have no run yet,
a short run gives the pace. Runs share nothing but the file system, and every free core takes the
next run of the sweep.
"""

from __future__ import annotations

import argparse
import heapq
import logging
import statistics
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from benchmarks.timing import machine
from studies.paper import is_as_usual
from torchrl_l2c2.experiment import Experiment, ExperimentConfig
from torchrl_l2c2.experiment.analysis.reports import group_records, read_records
from torchrl_l2c2.experiment.cli.composition import CONF
from torchrl_l2c2.experiment.envs.environments import time_limit
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS
from torchrl_l2c2.experiment.settings.tasks import TASKS

RECORDS = Path(__file__).parents[1] / "results" / "runs.csv"
CORES = (1, 2, 4, 16, 64, 128, 256, 512)
WARM_UPDATES, PACE_SECONDS = 500, 20.0


def makespan(seconds: Sequence[float], cores: int) -> float:
    """Time until the last of these runs ends, if every free core takes the next one.

    Examples:
        >>> makespan([3.0, 3.0, 2.0, 4.0], 2)
        7.0
        >>> makespan([3.0, 3.0, 2.0, 4.0], 8)
        4.0
    """
    free = [0.0] * cores
    for each in seconds:
        heapq.heapreplace(free, free[0] + each)
    return max(free)


def sweep() -> list[tuple[str, str]]:
    """Task and regularizer of every run of ``experiment=table3``, in its order."""
    params = OmegaConf.load(CONF / "experiment" / "table3.yaml").hydra.sweeper.params
    parse = OverridesParser.create().parse_override
    choices = {
        name: [str(v) for v in parse(f"{name}={value}").sweep_string_iterator()]
        for name, value in params.items()
    }
    return [
        (one["task"], one["regularizer"])
        for one in (dict(zip(choices, each, strict=True)) for each in product(*choices.values()))
    ]


def recorded(records: pd.DataFrame, task: str, method: str) -> list[float]:
    """Seconds of the runs of a task and a method that had the table's length and settings."""
    found = records[(records["task"] == task) & (records["method"] == method)]
    usual = [group.runs["seconds"] for group in group_records(found) if is_as_usual(group)]
    return [float(seconds) for each in usual for seconds in each.dropna()]


def paced(task: str, method: str) -> float:
    """Seconds that a run would take whose episodes are all as long as they may be.

    By the processor's time of this process: what else the machine does is not in it.
    """
    config = ExperimentConfig(
        task=TASKS[task], regularizer=REGULARIZERS[method], late_share=0.0, test_episodes=0
    )
    begun = time.process_time()
    experiment = Experiment(config)
    # Some first episodes are too short to learn from, and the first updates are compiled.
    while experiment.learner.updates < WARM_UPDATES:
        experiment.train(len(experiment.metrics) + 1)
    start, frames = time.process_time(), experiment.player.frames
    while time.process_time() - start < PACE_SECONDS:
        experiment.train(len(experiment.metrics) + 1)
    took = time.process_time() - start
    pace = (experiment.player.frames - frames) / took
    experiment.close()
    return start - begun + config.task.episodes * time_limit(config.task) / pace


def main() -> None:
    """Prints the table and its sources."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cores", description=__doc__)
    parser.add_argument("--records", default=RECORDS, help="default: results/runs.csv")
    chosen = parser.parse_args()
    logging.getLogger("torchrl").setLevel(logging.ERROR)
    records, runs, where = read_records(chosen.records), sweep(), machine()
    lines = ["| task | method | minutes | from |", "| --- | --- | --- | --- |"]
    seconds: dict[tuple[str, str], float] = {}
    for task, method in dict.fromkeys(runs):
        known = recorded(records, task, method)
        seconds[task, method] = statistics.median(known) if known else paced(task, method)
        source = f"the median of {len(known)} runs" if known else "pace, at most"
        lines.append(f"| {task} | {method} | {seconds[task, method] / 60:.0f} | {source} |")
    print(report([seconds[each] for each in runs], lines, where))


def report(seconds: Sequence[float], sources: Sequence[str], where: Mapping[str, Any]) -> str:
    """The page: hours by cores, where more cores stop to help, and what a run takes."""
    total, longest = sum(seconds), max(seconds)
    table = ["| cores | hours | cores in use |", "| --- | --- | --- |"]
    for cores in CORES:
        whole = makespan(seconds, cores)
        table.append(f"| {cores} | {whole / 3600:.1f} | {total / whole / cores:.0%} |")
    enough = next(n for n in range(1, len(seconds) + 1) if makespan(seconds, n) <= 1.001 * longest)
    return "\n".join(
        [
            "# The paper's table on many cores",
            "",
            f"The paper's table has {len(seconds)} runs of one core each, {total / 3600:.0f} hours "
            f"in all. The longest takes {longest / 3600:.1f} hours,\nand from {enough} cores on, "
            "more cores change nothing.",
            "",
            *table,
            "",
            "**What this does not show:** a sweep on so many cores. The hours are an estimate from "
            "the times of single runs.\nRuns share only the file system, and every free core "
            "takes the next run.",
            "",
            "Minutes of a run:",
            "",
            *sources,
            "",
            f"Commit {where['commit']}: {where['cpu']}, {where['cores']} cores, "
            f"load {where['load']:.1f}.",
            "",
            "```bash",
            "python -m benchmarks.cores > results/cores.md",
            "```",
        ]
    )


if __name__ == "__main__":
    main()
