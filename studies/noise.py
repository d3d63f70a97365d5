"""Return and smoothness of finished runs at several levels of noise on observations.

``python -m studies.noise FOLDER...`` plays test episodes with the policies of all
runs below folders, and writes a table and pictures.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv
from tqdm import tqdm

from studies.cells import number_range
from torchrl_l2c2.experiment.analysis.reports.figures import finish, save, styles, subplots
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.records import find_runs, records_of
from torchrl_l2c2.experiment.analysis.reports.statistics import mean
from torchrl_l2c2.experiment.analysis.reports.table import (
    COMPARED,
    Estimate,
    Table,
    estimate_cell,
)
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.envs.frames import check_finite
from torchrl_l2c2.experiment.errors import UserError, one_line_errors
from torchrl_l2c2.experiment.run.evaluation import evaluate_policy
from torchrl_l2c2.experiment.run.files import make_folder, write_atomically, write_json
from torchrl_l2c2.experiment.run.finished import FinishedRun
from torchrl_l2c2.experiment.run.policies import load_policy, seed_of_test
from torchrl_l2c2.experiment.run.process import ProcessState
from torchrl_l2c2.experiment.settings.naming import plain
from torchrl_l2c2.transforms import ObservationNoise

LEVELS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
LEGEND = (
    "Uniform noise on every feature of the observation, up to the level times the feature's "
    "standard deviation either way, new at every step and instead of the task's own; the "
    "deviation is over the states that all runs of the task here visit without noise. Means over "
    "seeds of test episodes with mean actions, 95% intervals of the bootstrap over seeds in "
    "brackets. Sm is (2 / N) sum_i f_i |FFT_i|, a mean over the action's dimensions, as in the "
    "tables of results/field.md."
)


class UniformNoise(ObservationNoise):
    """:class:`~torchrl_l2c2.ObservationNoise` that is uniform in a box of half the width ``scale``.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> noise = UniformNoise(torch.tensor([0.0, 0.0, 5.0]))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), noise)
        >>> sine_and_cosine = env.rollout(3)["observation"][:, :2]
        >>> sine_and_cosine.norm(dim=-1).round(decimals=3)
        tensor([1., 1., 1.])
    """

    def _apply_transform(self, obs: Tensor) -> Tensor:
        noise = torch.rand(obs.shape, generator=self.generator, dtype=obs.dtype, device=obs.device)
        return noise.mul_(2.0).sub_(1.0).mul_(self.scale).add_(obs)


class Played(NamedTuple):
    """A run's test at every level of noise.

    Attributes:
        run: whose policy acted.
        summaries: of its test episodes, by level.
    """

    run: FinishedRun
    summaries: Mapping[float, Mapping[str, float]]


def play_with_noise(
    runs: Sequence[FinishedRun],
    levels: Sequence[float] = LEVELS,
    *,
    episodes: int = 10,
    progress: bool = False,
) -> list[Played]:
    """Plays the policies of runs at every level of noise, the same for all runs of a task.

    Each run has its own test's seed, at every level: at level 0 it plays its test again, where the
    task has no noise of its own.

    Args:
        runs (sequence of FinishedRun): Runs of any tasks.
        levels (sequence of float): Levels of noise in standard deviations of each feature, at
            least 0. Larger levels are harder.

    Keyword Args:
        episodes (int): Episodes of each run at each level, at least 1. More: a smaller error.
        progress (bool): Whether to show a progress bar.

    Raises:
        ValueError: a level below 0, fewer than one episode, or a single state in all of them.
        FileNotFoundError: a run's policy is not there.
    """
    if bad := [level for level in levels if not 0 <= level < math.inf]:
        raise UserError(f"levels must be finite and at least 0, got {bad[0]}.")
    if episodes < 1:
        raise UserError(f"episodes must be at least 1, got {episodes}.")
    bar = partial(tqdm, unit="run", disable=None if progress else True, leave=False)
    scales = {}
    for task in dict.fromkeys(map(_observed, runs)):
        together = [run for run in runs if _observed(run) == task]
        scales[task] = _visited_scale(bar(together, f"states of {task[0]}"), episodes)
    played = []
    for run in bar(runs, "noise"):
        scale = scales[_observed(run)]
        summaries = {level: _test(run, level * scale, episodes) for level in levels}
        played.append(Played(run, summaries))
    return played


def _observed(run: FinishedRun) -> tuple[Any, ...]:
    """The settings of the observation: runs with the same ones observe the same features."""
    return tuple(run.config["task"].get(name) for name in ("env_id", "flatten"))


def noise_table(played: Sequence[Played]) -> Table:
    """A row for every group of runs and measure, a column for every level."""
    groups, summaries = _grouped(played)
    levels = list(played[0].summaries)
    rows = [
        [
            *(group.first.task, group.first.algorithm, group.name, number_range(group.seeds), name),
            *(
                estimate_cell(_estimate(group, summaries, level, quantity), quantity)
                for level in levels
            ),
        ]
        for group in groups
        for quantity, (name, _) in COMPARED.items()
    ]
    columns = ["task", "algorithm", "method", "seeds", "measure", *(f"{x:g}" for x in levels)]
    return Table("Noise on the observations", columns, rows, [LEGEND])


def draw_noise(played: Sequence[Played], path: str | Path) -> None:
    """Draws every measure against the level, a line with its interval for every group of runs.

    Args:
        played (sequence of Played): Runs of one task and algorithm.
        path (str or Path): The file; its ending, ``.png`` or ``.svg``, is the format.
    """
    groups, summaries = _grouped(played)
    looks, levels = styles(groups), list(played[0].summaries)
    figure, axes = subplots(len(COMPARED), 1, (3.4 * len(COMPARED) + 0.6, 3.6))
    for axis, (quantity, (name, _)) in zip(axes, COMPARED.items(), strict=True):
        for group in groups:
            found = [_estimate(group, summaries, level, quantity) for level in levels]
            known = [(x, each) for x, each in zip(levels, found, strict=True) if each is not None]
            places, look = [x for x, _ in known], looks[group.name]
            axis.plot(places, [each.value for _, each in known], label=group.name, **look)
            ends = [each.interval or (each.value, each.value) for _, each in known]
            lower, upper = [low for low, _ in ends], [high for _, high in ends]
            band = {"color": look["color"], "alpha": 0.18, "linewidth": 0}
            axis.fill_between(places, lower, upper, **band)
        axis.set_xlabel("noise, in deviations of each feature")
        axis.set_ylabel(name)
    first = groups[0].first
    finish(figure, axes, f"{first.task}, {first.algorithm}: noise on the observations")
    save(figure, path)


def write_noise(folder: str | Path, played: Sequence[Played]) -> list[Path]:
    """Writes ``noise.md``, ``noise.json`` and a picture for every task and algorithm.

    Args:
        folder (str or Path): made where it is not there.
        played (sequence of Played): at least one, all at the same levels.

    Returns:
        list: of the files.
    """
    folder = make_folder(folder)
    kinds: dict[Path, list[Played]] = {}
    for each in played:
        named = f"noise_{plain(each.run.task)}_{each.run.algorithm}.svg"
        kinds.setdefault(folder / named, []).append(each)
    pictures, table = list(kinds), folder / "noise.md"
    shown = [f"![{path.stem.replace('_', ' ')}]({path.name})" for path in pictures]
    write_atomically(table, "\n\n".join([noise_table(played).markdown(), *shown, ""]).encode())
    tests = [
        {
            "folder": str(run.folder),
            "levels": {f"{level:g}": dict(summary) for level, summary in summaries.items()},
        }
        for run, summaries in played
    ]
    write_json(folder / "noise.json", {"runs": tests})
    # Last: an error in a picture loses no results.
    for picture, together in kinds.items():
        draw_noise(together, picture)
    return [table, folder / "noise.json", *pictures]


def _visited_scale(runs: Iterable[FinishedRun], episodes: int) -> Tensor:
    """Standard deviation of each feature over the states that runs visit without noise."""
    states = []
    for run in runs:
        with ProcessState(seed_of_test(run.folder)):
            policy, env, max_steps = load_policy(run.folder, noise_scale=0.0)
            for episode in play_episodes(policy, env, episodes, max_steps=max_steps):
                check_finite(episode, 0, test=True)
                states.append(episode["observation"])
        env.close()
    visited = torch.cat(states)
    if len(visited) < 2:
        raise UserError(
            "noise is in standard deviations of the states that are visited, of which there was "
            f"one in {episodes} episodes: play more."
        )
    return visited.std(0)


def _test(run: FinishedRun, scale: Tensor, episodes: int) -> dict[str, float]:
    seed = seed_of_test(run.folder)
    # Within, as some tasks draw from the global generators where they are made.
    with ProcessState(seed):
        policy, env, max_steps = load_policy(run.folder, noise_scale=0.0)
        noisy = _with_noise(env, scale, seed)
        summary = evaluate_policy(policy, noisy, episodes, max_steps=max_steps).summary()
    noisy.close()
    return dict(summary)


def _with_noise(env: EnvBase, scale: Tensor, seed: int) -> EnvBase:
    generator = torch.Generator().manual_seed(seed)
    return TransformedEnv(env, UniformNoise(scale, generator=generator))


Summaries = Mapping[tuple[str | int, ...], Mapping[float, Mapping[str, float]]]


def _grouped(played: Sequence[Played]) -> tuple[list[Group], Summaries]:
    groups = group_records(records_of(each.run for each in played))
    return groups, {each.run.record.identity: each.summaries for each in played}


def _estimate(group: Group, summaries: Summaries, level: float, quantity: str) -> Estimate | None:
    name = f"{quantity}_mean"
    found = [summaries[*group.kind, seed][level].get(name, np.nan) for seed in group.seeds]
    values = [value for value in found if not np.isnan(value)]
    return Estimate.of(mean, np.array(values).reshape(-1, 1))


def _levels(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        told = f"must be numbers with commas between them, such as 0,0.1, got {text!r}"
        raise argparse.ArgumentTypeError(told) from None


def main(arguments: Iterable[str] | None = None) -> None:
    """The command line: plays with noise, writes and prints the table."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.noise",
        description="Plays the policies of finished runs with noise on their observations.",
    )
    add = parser.add_argument
    add("folders", nargs="+", metavar="FOLDER", help="of runs, at any depth, e.g. outputs/pendulum")
    add(
        "--levels",
        type=_levels,
        default=list(LEVELS),
        help="of uniform noise: the farthest, in standard deviations of each feature (default: "
        f"{','.join(f'{level:g}' for level in LEVELS)})",
    )
    add("--episodes", type=int, default=10, help="of each run at each level (default: 10)")
    add("--output", metavar="FOLDER", help="of the files (default: noise/ in the first folder)")
    chosen = parser.parse_args(arguments)
    with one_line_errors():
        found = find_runs(chosen.folders, required=True)
        played = play_with_noise(found.runs, chosen.levels, episodes=chosen.episodes, progress=True)
        written = write_noise(chosen.output or Path(chosen.folders[0]) / "noise", played)
    paths = [f"written: {path}" for path in written]
    print("\n\n".join([noise_table(played).markdown(), *found.notes, "\n".join(paths)]))


if __name__ == "__main__":
    main()
