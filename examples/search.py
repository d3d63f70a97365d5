"""Optuna's search for gains with a large return and a small action variation.

``python examples/search.py`` shows in seconds that it runs;
``python examples/search.py 30 100`` makes 30 trials of 100 episodes. The same command continues.
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, L2C2Config, TaskConfig

FOLDER = Path("outputs/search")
SEEDS = (0, 1)
SPACE: dict[str, BaseDistribution] = {
    "lambda_min": FloatDistribution(1e-3, 1e-1, log=True),
    "beta": FloatDistribution(1e-2, 1.0, log=True),
}


def open_study(episodes: int) -> optuna.Study:
    """The study in the folder's journal, lines of JSON that Optuna's own tools read, too."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name=f"{episodes} episodes",  # Trials of other lengths are not comparable.
        storage=optuna.storages.JournalStorage(JournalFileBackend(str(FOLDER / "journal.log"))),
        directions=["maximize", "minimize"],
        load_if_exists=True,
    )
    # A continued search must not propose the first trials again.
    study.sampler = optuna.samplers.TPESampler(seed=len(study.trials))
    return study


def measure(number: int, gains: dict[str, Any], episodes: int) -> list[float]:
    """Trains a trial's seeds; returns the means of their return and action variation."""
    found = []
    for seed in SEEDS:
        config = ExperimentConfig(
            task=TaskConfig("pendulum", "Pendulum-v1", episodes=episodes),
            regularizer=L2C2Config(**gains),
            seed=seed,
            late_share=0.0,
            compile=episodes > 10,  # It takes longer than a few episodes.
        )
        # A run that was interrupted continues from its checkpoint.
        folder = FOLDER / f"{episodes}_episodes" / f"trial_{number:04d}" / f"seed_{seed}"
        experiment = Experiment(config, folder)
        experiment.train()
        found.append(experiment.test(episodes=min(10, episodes)).summary())
        experiment.close()
    keys = ("return_mean", "action_variation_mean")
    return [statistics.fmean(float(test[key]) for test in found) for key in keys]


def main(trials: int = 2, episodes: int = 1) -> None:
    study = open_study(episodes)
    for lost in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(lost.number, measure(lost.number, lost.params, episodes))
    while len(study.trials) < trials:
        trial = study.ask(SPACE)
        study.tell(trial, measure(trial.number, trial.params, episodes))
    for best in study.best_trials:  # No other trial is better in both. Run them on new seeds.
        names = ("return", "action variation", *best.params)
        print(f"\ntrial {best.number}")
        for name, value in zip(names, [*best.values, *best.params.values()], strict=True):
            print(f"{name} {value:.4g}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
