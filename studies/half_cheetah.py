"""Share of an episode that policies of HalfCheetah-v5 spend on their backs.

``python -m studies.half_cheetah FOLDER FILE.csv`` plays the runs below a folder, and writes a line
for each of them. Lines of other runs stay.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from studies.cells import number_range
from studies.filters import EPISODES, SEED, act, make_task, play
from torchrl_l2c2.experiment import ExperimentConfig
from torchrl_l2c2.experiment.analysis.reports import find_runs
from torchrl_l2c2.experiment.analysis.reports.table import pipe_table

COLUMNS = ["method", "seed", "return", "on_back", "commit"]
METHODS = {"none": "baseline", "l2c2": "L2C2", "cats": "CATS"}
PITCH = 1
"""Entry of the observation with the trunk's pitch, in radians; 0 is upright."""


def share_on_back(observations: NDArray[np.floating]) -> float:
    """Share of the steps in which the trunk is turned by more than a quarter of a circle.

    Args:
        observations (array): Observations of an episode, ``[T, 17]``.

    Examples:
        >>> pitch = np.array([0.1, -1.5, 1.6, 3.3, 6.2])
        >>> share_on_back(np.stack([0 * pitch, pitch], 1))
        0.4
    """
    return float((np.cos(observations[:, PITCH]) < 0).mean())


def main(folder: Path, path: Path) -> None:
    """Plays the runs of HalfCheetah-v5 below a folder, and adds or replaces their lines."""
    rows = {}
    if path.exists():
        with path.open(newline="") as file:
            rows = {(row[0], int(row[1])): row for row in list(csv.reader(file))[1:]}
    for run in find_runs([folder], required=True).runs:
        if run.task != "HalfCheetah-v5":
            continue
        policy, env = act(run.folder), make_task(ExperimentConfig.from_dict(run.config).task)
        played = [play(env, policy, SEED + episode) for episode in range(EPISODES)]
        env.close()
        total = np.mean([episode[0] for episode in played])
        on_back = np.mean([share_on_back(episode[2]) for episode in played])
        commit = run.versions.get("commit", "")
        row = [run.regularizer, str(run.seed), f"{total:.6g}", f"{on_back:.4g}", commit]
        rows[run.regularizer, run.seed] = row
        print(*row, flush=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *(rows[key] for key in sorted(rows))])


def table(path: Path) -> str:
    """The returns by seed and the shares of steps on the back, as Markdown."""
    runs = pd.read_csv(path).sort_values("seed")
    seeds = number_range(runs["seed"].unique().tolist())
    rows = [["method", f"return, seeds {seeds}", "steps on the back"]]
    for method, name in METHODS.items():
        own = runs[runs["method"] == method]
        shares = [f"{math.floor(100 * share + 0.5)}%" for share in own["on_back"]]
        returns = [f"{total:.0f}" for total in own["return"]]
        rows.append([name, ", ".join(returns), ", ".join(shares)])
    return pipe_table(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m studies.half_cheetah", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of runs")
    parser.add_argument("file", type=Path, help="CSV file that gets the lines")
    chosen = parser.parse_args()
    main(chosen.folder, chosen.file)
