"""Rows against other libraries: SBX, and Stable-Baselines3."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import gymnasium

from benchmarks.peers import against
from benchmarks.setups import Effort, paper_config, play_episode
from benchmarks.timing import Row, alternate
from torchrl_l2c2.experiment import (
    PAPER_TASKS,
    Experiment,
    NoRegularizerConfig,
    SACConfig,
    UniformReplayConfig,
)


def peer_rows(effort: Effort) -> Iterable[Row]:
    """Whole training by other libraries, on the same task, networks and batches."""
    steps = min(512, effort.steps)
    settings = {
        "env_id": PAPER_TASKS["swingup"].env_id,
        "frames": steps,
        "turn": 4 * steps,
        "compile": effort.compile,
    }
    how = {"rounds": max(1, effort.rounds // 3), "python": effort.peer_python}
    for layer, batch in ((100, 32), (256, 256)):
        same = {**settings, "layers": [layer, layer], "batch": batch}
        what = f"SAC here / SBX SAC, layers of {layer}, batch {batch}"
        yield from against(what, "sac", "sbx sac", same, at_most=0.9, **how)
    same = {**settings, "layers": [64, 64], "batch": 64}
    what = "PPO here / Stable-Baselines3 PPO, layers of 64, batch 64"
    yield from against(what, "ppo", "sb3 ppo", same, at_most=0.4, **how)


def baseline_rows(effort: Effort) -> Iterable[Row]:
    """A whole run, and SAC's, against Stable-Baselines3's SAC on the same networks and batches."""
    names = {
        "paper": "whole run (L2C2) / Stable-Baselines3 SAC, frames/s",
        "sac": "whole run (SAC) / Stable-Baselines3 SAC, frames/s",
    }
    try:
        from stable_baselines3 import SAC
    except ModuleNotFoundError:
        note = "not measured: pip install 'torchrl-l2c2[benchmark]'"
        for kind, name in names.items():
            yield Row("sb3", name, at_least=4.0 if kind == "paper" else None, note=note)
        return
    config = dataclasses.replace(paper_config(effort), checkpoint_interval=1e9)
    sac = dataclasses.replace(
        config,
        algorithm=SACConfig(hidden=config.algorithm.hidden, random_frames=0),
        regularizer=NoRegularizerConfig(),
        replay=UniformReplayConfig(capacity=config.replay.capacity, batch_size=32),
        optimizer=None,
    )
    steps = config.task.max_steps
    baseline = SAC(
        "MlpPolicy",
        gymnasium.make(config.task.env_id, max_episode_steps=steps),
        policy_kwargs={"net_arch": list(config.algorithm.hidden)},
        buffer_size=config.replay.capacity,
        batch_size=config.replay.batch_size,
        learning_starts=config.replay.batch_size,
        train_freq=1,
        gradient_steps=1,
        device="cpu",
    )

    def learn() -> int:
        baseline.learn(steps, reset_num_timesteps=False, log_interval=None)
        return steps

    actions = {"paper": play_episode(Experiment(config)), "sac": play_episode(Experiment(sac))}
    times = alternate({**actions, "sb3": learn}, repeats=max(1, effort.rounds // 3))
    fps = {name: 1.0 / seconds for name, seconds in times.items()}
    for kind, name in names.items():
        yield Row(
            "sb3",
            name,
            fps[kind] / fps["sb3"],
            at_least=4.0 if kind == "paper" else None,
            parts={"ours frames/s": fps[kind], "Stable-Baselines3 frames/s": fps["sb3"]},
        )
