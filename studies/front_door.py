"""Trains SAC, TD3 and PPO in plain TorchRL loops, with and without ``smooth(loss)``.

``python -m studies.front_door FILE.csv`` makes 10 seeds of each on Pendulum, and adds a line to the
file after each run; runs that the file has are skipped. The loops are like TorchRL's own scripts,
which sum the losses by name. With the regularizer they have a line more, ``smooth``, and with PPO
and SAC a second one, ``set_progress``.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import (
    ExplorationType,
    GymEnv,
    RewardScaling,
    TransformedEnv,
    set_exploration_type,
)
from torchrl.modules import MLP, Actor, AdditiveGaussianModule, TanhModule, ValueOperator
from torchrl.objectives import ClipPPOLoss, LossModule, SACLoss, SoftUpdate, TD3Loss
from torchrl.objectives.value import GAE

from studies.cells import seeds_table
from torchrl_l2c2 import action_variation, make_actor, make_critic, smooth
from torchrl_l2c2.experiment.analysis.reports.statistics import mean, probability_of_improvement
from torchrl_l2c2.experiment.analysis.reports.table import Estimate, pipe_table

SEEDS = range(10)
FRAMES, PPO_FRAMES = 5_000, 30_720
TEST_EPISODES = 10
METHODS = ("baseline", "smooth")
RELATIVE = {"relative": True, "ramp": None, "lambda_min": 0.2, "lambda_max": 20.0}
COLUMNS = ["algorithm", "method", "seed", "return", "action_variation", "seconds", "commit"]


def train_sac(seed: int, settings: dict[str, Any] | None, gamma: float = 0.95) -> torch.nn.Module:
    """SAC, an update every other frame, on losses that are summed by name."""
    env = pendulum(seed)
    actor, qvalue = make_actor(3, env.action_spec, hidden=(64, 64)), make_qvalue()
    loss: LossModule = SACLoss(actor, qvalue, action_spec=env.action_spec)
    loss.make_value_estimator(gamma=gamma)
    if settings is not None:
        loss = smooth(loss, **settings)
    updater = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(FRAMES), batch_size=64)
    collector = Collector(
        env, actor, frames_per_batch=50, total_frames=FRAMES, init_random_frames=500
    )
    for number, collected in enumerate(collector):
        if settings is not None:
            loss.set_progress(number * 50 / FRAMES)
        replay.extend(collected)
        for _ in range(25 if len(replay) >= 500 else 0):
            terms = loss(replay.sample())
            (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            updater.step()
    collector.shutdown()
    return actor


def train_td3(seed: int, settings: dict[str, Any] | None, gamma: float = 0.95) -> torch.nn.Module:
    """TD3, which calls the parts of the loss by themselves."""
    env = pendulum(seed)
    network = MLP(in_features=3, out_features=1, num_cells=[64, 64])
    squash = TanhModule(in_keys=["action"], out_keys=["action"], spec=env.action_spec)
    actor = TensorDictSequential(Actor(network, out_keys=["action"]), squash)
    noise = AdditiveGaussianModule(env.action_spec, sigma_init=0.2, sigma_end=0.2)
    loss: LossModule = TD3Loss(actor, make_qvalue(), action_spec=env.action_spec)
    loss.make_value_estimator(gamma=gamma)
    if settings is not None:
        loss = smooth(loss, **settings)
    updater = SoftUpdate(loss, tau=0.01)
    actor_optimizer = torch.optim.Adam(loss.actor_network_params.flatten_keys().values(), lr=1e-3)
    critic_optimizer = torch.optim.Adam(loss.qvalue_network_params.flatten_keys().values(), lr=1e-3)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(FRAMES), batch_size=64)
    collector = Collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=50,
        total_frames=FRAMES,
        init_random_frames=500,
    )
    for collected in collector:
        replay.extend(collected)
        for update in range(50 if len(replay) >= 500 else 0):
            batch = replay.sample()
            value_loss, _ = loss.value_loss(batch)
            critic_optimizer.zero_grad()
            value_loss.backward()
            critic_optimizer.step()
            if update % 2 == 0:
                actor_loss, _ = loss.actor_loss(batch)
                actor_optimizer.zero_grad()
                actor_loss.backward()
                actor_optimizer.step()
                updater.step()
    collector.shutdown()
    return actor


def train_ppo(seed: int, settings: dict[str, Any] | None, gamma: float = 0.9) -> torch.nn.Module:
    """PPO on rollouts of 2,048 frames, with rewards of about 1."""
    env = TransformedEnv(pendulum(seed), RewardScaling(loc=0.0, scale=0.1))
    actor, critic = make_actor(3, env.action_spec, hidden=(64, 64)), make_critic(3, hidden=(64, 64))
    loss: LossModule = ClipPPOLoss(actor, critic, normalize_advantage=True, entropy_coeff=0.0)
    advantage = GAE(gamma=gamma, lmbda=0.95, value_network=critic)
    if settings is not None:
        loss = smooth(loss, **settings)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(2_048), sampler=SamplerWithoutReplacement(), batch_size=128
    )
    collector = Collector(env, actor, frames_per_batch=2_048, total_frames=PPO_FRAMES)
    for number, rollout in enumerate(collector):
        if settings is not None:
            loss.set_progress(number * 2_048 / PPO_FRAMES)
        for _ in range(8):
            with torch.no_grad():
                advantage(rollout)
            replay.extend(rollout.reshape(-1))
            for batch in replay:
                terms = loss(batch)
                (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
                optimizer.zero_grad()
    collector.shutdown()
    return actor


ALGORITHMS = {"TD3": train_td3, "SAC": train_sac, "PPO": train_ppo}


def pendulum(seed: int) -> GymEnv:
    """Pendulum-v1 with a seed, also for torch's generators."""
    torch.manual_seed(seed)
    env = GymEnv("Pendulum-v1")
    env.set_seed(seed)
    return env


def make_qvalue() -> ValueOperator:
    """An action value of 64 and 64 units."""
    network = MLP(in_features=4, out_features=1, num_cells=[64, 64])
    return ValueOperator(network, in_keys=["observation", "action"])


def evaluate(actor: torch.nn.Module) -> tuple[float, float]:
    """The mean return and the mean action variation of episodes with mean actions."""
    env = GymEnv("Pendulum-v1")
    env.set_seed(10_000)
    returns, variations = [], []
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        for _ in range(TEST_EPISODES):
            episode = env.rollout(200, actor)
            returns.append(episode["next", "reward"].sum())
            variations.append(action_variation(episode["action"]))
    return torch.stack(returns).mean().item(), torch.stack(variations).mean().item()


def table(path: Path, algorithms: Iterable[str] = ALGORITHMS) -> str:
    """Means with 95% intervals over the seeds that both methods have, and probabilities."""
    with path.open(newline="") as file:
        found = {(r["algorithm"], r["method"], r["seed"]): r for r in csv.DictReader(file)}
    columns = ["trained (seeds)", "action variation: baseline", "with L2C2", "P(smoother)"]
    columns += ["return: baseline", "with L2C2", "P(returns more)"]
    rows = [columns]
    for algorithm in algorithms:
        both = [
            seed
            for seed in map(str, SEEDS)
            if all((algorithm, method, seed) in found for method in METHODS)
        ]
        cells = [f"{algorithm} ({len(both)})"]
        for name, sign, digits in (("action_variation", -1.0, 3), ("return", 1.0, 1)):
            scores = [
                np.array([[float(found[algorithm, method, seed][name])] for seed in both])
                for method in METHODS
            ]
            means = [Estimate.of(mean, each) for each in scores]
            better = Estimate.of(
                probability_of_improvement, *(sign * each for each in scores[::-1])
            )
            write = f"{{:.{digits}f}}".format
            cells += ["" if each is None else each.text(write) for each in means]
            cells.append("" if better is None else better.text())
        rows.append(cells)
    return pipe_table(rows)


def strengths_table(path: Path) -> str:
    """Return and action variation of each run, and their means, by strength."""
    with path.open(newline="") as file:
        runs = list(csv.DictReader(file))
    found = {}
    for method in dict.fromkeys(run["method"] for run in runs):
        name = {"smooth": "strength 1", "smooth relative": "relative"}.get(method)
        name = name or method.replace("smooth", "strength")
        ours = [run for run in runs if run["method"] == method]
        returns, variations = (
            [float(run[quantity]) for run in ours] for quantity in ("return", "action_variation")
        )
        found[name] = returns, variations
    return seeds_table(found)


def main(arguments: Sequence[str] | None = None) -> None:
    """Makes the runs that the file lacks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=list(ALGORITHMS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--strengths", nargs="+", type=float, default=[1.0])
    parser.add_argument(
        "--relative", action="store_true", help="also SAC's penalty of results/relative.md"
    )
    parser.add_argument("--gamma", type=float, help="discount factor (default: 0.95, PPO 0.9)")
    chosen = parser.parse_args(arguments)
    methods: dict[str, dict[str, Any] | None] = {"baseline": None}
    for each in chosen.strengths:
        methods["smooth" if each == 1.0 else f"smooth {each:g}"] = {"strength": each}
    if chosen.relative:
        methods["smooth relative"] = RELATIVE
    options = {} if chosen.gamma is None else {"gamma": chosen.gamma}
    add_runs(
        chosen.file,
        product(chosen.seeds, chosen.algorithms, methods),
        lambda seed, algorithm, method: evaluate(
            ALGORITHMS[algorithm](seed, methods[method], **options)
        ),
    )


def add_runs(
    path: Path,
    runs: Iterable[tuple[int, str, str]],
    train: Callable[[int, str, str], tuple[float, float]],
) -> None:
    """Makes the runs that the file lacks, and adds a line after each.

    Args:
        path (Path): CSV file, which may not exist yet.
        runs (iterable of tuple): Seed, algorithm and method of each run.
        train (callable): Returns the return and the action variation of a run.
    """
    torch.set_num_threads(1)
    describe = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    commit = subprocess.run(describe, capture_output=True, text=True, check=True).stdout.strip()
    done = set()
    if path.exists():
        with path.open() as file:
            done = {(r["algorithm"], r["method"], r["seed"]) for r in csv.DictReader(file)}
    else:
        with path.open("w", newline="") as file:
            csv.writer(file).writerow(COLUMNS)
    for seed, algorithm, method in runs:
        if (algorithm, method, str(seed)) in done:
            continue
        started = time.monotonic()
        total, variation = train(seed, algorithm, method)
        seconds = round(time.monotonic() - started)
        row = [algorithm, method, seed, f"{total:.3f}", f"{variation:.5f}", seconds, commit]
        with path.open("a", newline="") as file:
            csv.writer(file).writerow(row)
        print(*row, flush=True)


if __name__ == "__main__":
    main()
