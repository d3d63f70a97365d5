"""Plays trained policies with low-pass filters, sensor noise and delay (results/filters.md).

``python -m studies.filters FOLDER FILE.csv`` plays the runs below a folder, and adds a line to the
file for every run, deployment and condition; lines that the file has are skipped.
"""

from __future__ import annotations

import argparse
import csv
import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from itertools import product
from pathlib import Path

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_l2c2.experiment import ExperimentConfig, TaskConfig, load_policy
from torchrl_l2c2.experiment.analysis.reports import FinishedRun, find_runs
from torchrl_l2c2.experiment.envs.environments import time_limit
from torchrl_l2c2.metrics import action_variation, amplitude_spectrum

EPISODES = 10
SEED = 2_000_003
NOISE = 0.05
CUTOFFS = {"none": (None, 0.3, 0.1, 0.03), "l2c2": (None, 0.1)}
CONDITIONS = ("as trained", "noise", "delay")
COLUMNS = [
    *("task", "method", "action_rate", "seed", "cutoff", "condition"),
    *("return", "action_variation", "high_frequency", "commit"),
]
Actions = NDArray[np.float32]
Policy = Callable[[NDArray[np.float32]], Actions]


def smoothing(cutoff: float | None) -> float:
    """The weight of the new action in the filter; 1 without a filter.

    Args:
        cutoff (float, optional): cut-off frequency, as a share of the control rate.

    Examples:
        >>> round(smoothing(0.1), 3), smoothing(None)
        (0.467, 1.0)
    """
    return 1.0 if cutoff is None else 1.0 - math.exp(-2.0 * math.pi * cutoff)


def play(
    env: gymnasium.Env[NDArray[np.float32], Actions],
    policy: Policy,
    seed: int,
    *,
    weight: float = 1.0,
    noise: NDArray[np.float64] | None = None,
    delay: bool = False,
) -> tuple[float, Actions, NDArray[np.float32]]:
    """Plays an episode.

    Args:
        env (gymnasium.Env): the task, with bounded actions.
        policy (Callable): the mean action for an observation.
        seed (int): seed of the episode and of the noise.

    Keyword Args:
        weight (float): weight of the new action in the low-pass filter. Default 1, no filter.
        noise (array, optional): standard deviation of the noise on each feature.
        delay (bool): whether actions are applied one step late. Default ``False``.

    Returns:
        tuple: return, applied actions ``[T, A]`` and observations ``[T, F]`` without noise.
    """
    generator = np.random.default_rng(seed)
    seen, _ = env.reset(seed=seed)
    total, done = 0.0, False
    applied: list[Actions] = []
    observations: list[NDArray[np.float32]] = []
    filtered: Actions | None = None
    waiting: Actions | None = None
    while not done:
        observations.append(np.asarray(seen, np.float32))
        observed = observations[-1]
        if noise is not None:
            observed = (observed + noise * generator.standard_normal(noise.shape)).astype("f4")
        action = policy(observed)
        filtered = action if filtered is None else filtered + weight * (action - filtered)
        now = filtered if not delay or waiting is None else waiting
        waiting = filtered
        seen, reward, terminated, truncated, _ = env.step(now)
        total, done = total + float(reward), terminated or truncated
        applied.append(now)
    return total, np.stack(applied), np.stack(observations)


def high_frequency(actions: Actions, half_range: Actions) -> float:
    """Root mean square of the components above a third of the control rate, in half ranges.

    Examples:
        >>> flips = np.array([[1.0], [-1.0]] * 4, np.float32)
        >>> high_frequency(flips, np.array([2.0], np.float32))
        0.5
    """
    frequencies, amplitudes = amplitude_spectrum(torch.as_tensor(actions / half_range))
    # A sine of amplitude a has the mean square a ** 2 / 2, a flip from step to step a ** 2.
    power = torch.where(frequencies.unsqueeze(-1) == 0.5, 1.0, 0.5) * amplitudes.square()
    return math.sqrt(float(power[frequencies > 1 / 3].sum(0).mean()))


def make_task(task: TaskConfig) -> gymnasium.Env[NDArray[np.float32], Actions]:
    """The Gymnasium environment of a task."""
    return gymnasium.make(task.env_id, max_episode_steps=time_limit(task))


def act(run: Path) -> Policy:
    """The mean action of a run's policy."""
    policy, env, _ = load_policy(run, noise_scale=0.0)
    env.close()

    @torch.no_grad()
    def mean(observation: NDArray[np.float32]) -> Actions:
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = policy(TensorDict({"observation": torch.as_tensor(observation)}))
        action: Actions = written["action"].numpy()
        return action

    return mean


def measure(
    run: FinishedRun, deviation: NDArray[np.float64], done: set[tuple[str, ...]]
) -> Iterator[list[str]]:
    """Lines of a run that are not done.

    Args:
        run (FinishedRun): the run.
        deviation (array): standard deviation of each feature over the baselines' states.
        done (set): first six cells of the lines that the file has.
    """
    config = ExperimentConfig.from_dict(run.config)
    rate = config.task.action_rate
    cutoffs: Sequence[float | None] = CUTOFFS.get(run.regularizer, (None,))
    policy, env = act(run.folder), make_task(config.task)
    space = env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    for cutoff, condition in product((None,) if rate else cutoffs, CONDITIONS):
        name = [run.task, run.regularizer, f"{rate:g}", str(run.seed)]
        name += ["" if cutoff is None else f"{cutoff:g}", condition]
        if tuple(name) in done:
            continue
        found = []
        for episode in range(EPISODES):
            total, actions, _ = play(
                env,
                policy,
                SEED + episode,
                weight=smoothing(cutoff),
                noise=NOISE * deviation if condition == "noise" else None,
                delay=condition == "delay",
            )
            half_range = ((space.high - space.low) / 2).astype(np.float32)
            variation = action_variation(torch.as_tensor(actions)).item()
            found.append((total, variation, high_frequency(actions, half_range)))
        means = np.mean(found, 0)
        yield [*name, *(f"{value:.6g}" for value in means), str(run.versions.get("commit", ""))]
    env.close()


def deviation_of(runs: Sequence[FinishedRun]) -> NDArray[np.float64]:
    """Standard deviation of each feature over the states that baselines visit."""
    states = []
    for run in runs:
        env = make_task(ExperimentConfig.from_dict(run.config).task)
        states += [play(env, act(run.folder), SEED + i)[2] for i in range(EPISODES)]
        env.close()
    deviation: NDArray[np.float64] = np.concatenate(states).std(0)
    return deviation


def main(folder: Path, path: Path) -> None:
    """Measures the runs below a folder that the file lacks."""
    torch.set_num_threads(1)
    runs = find_runs([folder], required=True).runs
    done: set[tuple[str, ...]] = set()
    if path.exists():
        with path.open(newline="") as file:
            done = {tuple(row[name] for name in COLUMNS[:6]) for row in csv.DictReader(file)}
    else:
        with path.open("w", newline="") as file:
            csv.writer(file).writerow(COLUMNS)

    @cache
    def deviation(task: str) -> NDArray[np.float64]:
        baselines = [run for run in runs if run.task == task and run.regularizer == "none"]
        configs = [ExperimentConfig.from_dict(run.config) for run in baselines]
        plain = [r for r, c in zip(baselines, configs, strict=True) if not c.task.action_rate]
        return deviation_of(plain)

    for run in runs:
        for row in measure(run, deviation(run.task), done):
            with path.open("a", newline="") as file:
                csv.writer(file).writerow(row)
            print(*row, flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m studies.filters", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of runs")
    parser.add_argument("file", type=Path, help="CSV file that gets the lines")
    chosen = parser.parse_args()
    main(chosen.folder, chosen.file)
