"""Trains rsl_rl's PPO on a toy task and on a MuJoCo task, with and without L2C2.

``python -m studies.rsl_rl FILE.csv`` adds a line to the file after each run; runs that the file has
are skipped.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import pandas as pd

from studies.field import TEST
from studies.front_door import METHODS, add_runs
from torchrl_l2c2.experiment.analysis.reports.groups import Group

RECURRENT = "points, LSTM"
# Iterations of each task: 64,000 frames of points, and 1,001,472 of HalfCheetah.
ITERATIONS = {"points": 40, RECURRENT: 40, "HalfCheetah-v5": 489}
SEEDS = range(5)
CLASSES = dict(zip(METHODS, ("PPO", "torchrl_l2c2.rsl_rl:L2C2PPO"), strict=True))


def recorded(path: Path, task: str) -> tuple[Group, Group]:
    """The runs of a task with L2C2 and of the baseline, as groups for tables and pictures."""
    measures = ("return", "action_variation")
    runs = pd.read_csv(path).rename(columns={name: f"{TEST}_{name}" for name in measures})
    runs = runs[runs["algorithm"] == task]
    pairs = runs.groupby("seed")["method"].nunique()  # A seed without its pair is left out.
    runs = runs[runs["seed"].isin(pairs[pairs == len(METHODS)].index)]
    baseline, smooth = (Group(runs[runs["method"] == method], method) for method in METHODS)
    return smooth, baseline


def main(arguments: Sequence[str] | None = None) -> None:
    """Makes the runs that the file lacks."""
    parser = argparse.ArgumentParser(prog="python -m studies.rsl_rl", description=__doc__)
    parser.add_argument("file", type=Path, help="CSV file that gets the lines")
    chosen = parser.parse_args(arguments)
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    import rsl_rl_gymnasium
    import rsl_rl_l2c2

    def silent(seed: int, task: str, method: str) -> tuple[float, float]:
        if task in ("points", RECURRENT):
            model = "RNNModel" if task == RECURRENT else "MLPModel"
            return rsl_rl_l2c2.train(CLASSES[method], seed, ITERATIONS[task], model)
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            return rsl_rl_gymnasium.train(CLASSES[method], task, seed, ITERATIONS[task])

    add_runs(chosen.file, product(SEEDS, ITERATIONS, METHODS), silent)


if __name__ == "__main__":
    main()
