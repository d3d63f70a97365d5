"""Rows about playing."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from functools import partial

import gymnasium
import torch
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from benchmarks.setups import Effort
from benchmarks.timing import Row, alternate
from torchrl_l2c2.experiment import (
    PAPER_TASKS,
    EpisodeCollector,
    TaskConfig,
    make_env,
)
from torchrl_l2c2.experiment.collect.acting import policy_function
from torchrl_l2c2.experiment.envs.environments import quiet_output, time_limit
from torchrl_l2c2.modules import make_actor


def collection_rows(effort: Effort) -> Iterable[Row]:
    """Frames with noise, stored as batches, against the simulator's with the same policy."""
    for name, task in PAPER_TASKS.items():
        task = dataclasses.replace(task, max_steps=min(time_limit(task), effort.steps))
        env = make_env(task, seed=0)
        actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec)
        collector = EpisodeCollector(
            env,
            actor,
            frames_per_batch=min(250, effort.steps),
            stop_at_done=False,
            compile_policy=effort.compile,
        )
        times = alternate(
            {
                "collector": partial(_rollout, collector),
                "simulator": _simulation(
                    task,
                    policy_function(actor, ["action"], effort.compile),
                    collector.frames_per_batch,
                ),
            },
            repeats=2 * effort.rounds,
        )
        fps = {what: 1.0 / seconds for what, seconds in times.items()}
        collector.shutdown()
        yield Row(
            "collection",
            f"collected frames / simulated frames, {name}",
            fps["collector"] / fps["simulator"],
            at_least=0.6,
            parts={"collected frames/s": fps["collector"], "simulated frames/s": fps["simulator"]},
        )


def _rollout(collector: EpisodeCollector) -> int:
    """Plays a batch and counts its frames."""
    return collector.rollout().numel()


def _simulation(
    task: TaskConfig, act: Callable[[Tensor], tuple[Tensor, ...]], frames: int
) -> Callable[[], int]:
    """So many frames by a policy, of which nothing is kept."""
    with quiet_output():
        simulator = gymnasium.make(task.env_id, max_episode_steps=task.max_steps)
        observation, _ = simulator.reset()

    @torch.no_grad()
    def simulate() -> int:
        nonlocal observation
        with set_exploration_type(ExplorationType.RANDOM):
            for _ in range(frames):
                (acted,) = act(torch.as_tensor(observation, dtype=torch.float32))
                observation, _, terminated, truncated, _ = simulator.step(acted.numpy())
                if terminated or truncated:
                    observation, _ = simulator.reset()
        return frames

    return simulate
