"""Episodes and rollouts of a run, checked, counted and measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.envs.environments import make_env, simulator_errors, time_limit
from torchrl_l2c2.experiment.envs.frames import Frame, check_finite, stack_frames
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.metrics import action_variation

Played = TypeVar("Played")

# Measures of an episode, by their names in metrics.csv.
EPISODE_COLUMNS = ("return", "action_variation", "policy_scale", "length")
# Distance between the seeds of a run's simulators, so large that no two runs share one.
SEEDS_APART = 15_485_863


def make_collector(
    config: ExperimentConfig, env: EnvBase, agent: Agent, *, compile: bool
) -> EpisodeCollector | RolloutCollector:
    """Makes the collector of a run: rollouts with ``algorithm.num_envs``, otherwise episodes."""
    algorithm = config.algorithm
    options: dict[str, Any] = {
        "compile_policy": compile,
        "keep_previous": config.regularizer.reads_previous,
    }
    if algorithm.num_envs is not None:
        seeds = (config.seed + SEEDS_APART * i for i in range(1, algorithm.num_envs))
        envs = [env, *(make_env(config.task, seed) for seed in seeds)]
        return RolloutCollector(envs, agent.policy, frames_per_batch=algorithm.frames, **options)
    return EpisodeCollector(
        env,
        agent.policy,
        frames_per_batch=1 if algorithm.schedule == "step" else time_limit(config.task),
        random_frames=algorithm.random_frames,
        **options,
    )


@dataclass
class Episode:
    """An episode and its measures.

    Attributes:
        transitions: the whole episode, ``[T]``.
        last_frame: number of the run's frames up to the end of the episode.
        measures: return, smoothness of the mean actions, mean scale of the policy, length.
        ends_round: whether it is the last episode that was played with the same policy.
    """

    transitions: TensorDictBase
    last_frame: int
    measures: dict[str, float]
    ends_round: bool = True


class Player:
    """Plays, measures and counts an agent's episodes.

    Args:
        collector: the collector, from :func:`make_collector`.
        agent (Agent): the agent whose policy acts.
        env_id (str): the environment's id, for errors.

    Attributes:
        frames: number of frames so far.
    """

    def __init__(
        self, collector: EpisodeCollector | RolloutCollector, agent: Agent, env_id: str
    ) -> None:
        self.collector = collector
        self.frames = 0
        self._agent = agent
        self._env_id = env_id

    def play(self) -> Episode:
        """Plays one episode.

        Raises:
            FloatingPointError: NaN or infinity from the environment or the policy.
            SimulatorError: the environment failed.
        """
        assert isinstance(self.collector, EpisodeCollector)  # make_collector ensures it.
        transitions = self._simulate(self.collector.rollout)
        self._check_and_count(transitions)
        return self.measure(transitions, self.frames)

    def play_rollout(self) -> tuple[list[TensorDictBase], list[Episode]]:
        """Plays a rollout: the next frames ``[T]`` of every simulator, and the ended episodes.

        Raises:
            FloatingPointError: as :meth:`play`.
            SimulatorError: as :meth:`play`.
        """
        assert isinstance(self.collector, RolloutCollector)
        first_frame, rollout = self.frames, self._simulate(self.collector.rollout)
        for frames in rollout:
            self._check_and_count(frames)
        ended = self.collector.finished_episodes
        episodes = [
            self.measure(e.transitions, first_frame + e.frame, ends_round=e is ended[-1])
            for e in ended
        ]
        return rollout, episodes

    def step(self) -> Frame:
        """Plays the next frame of an episode.

        Raises:
            FloatingPointError: as :meth:`play`.
            SimulatorError: as :meth:`play`.
        """
        assert isinstance(self.collector, EpisodeCollector)
        frame = self._simulate(self.collector.step)
        if not frame.is_finite():
            check_finite(stack_frames([frame]), self.frames)
        self._count(1)
        return frame

    def discard_episode(self) -> None:
        """Discards the episode that :meth:`step` has begun; the next frame starts another one."""
        assert isinstance(self.collector, EpisodeCollector)
        self.collector.reset()

    def _simulate(self, play: Callable[[], Played]) -> Played:
        with simulator_errors(f"{self._env_id} failed after frame {self.frames}"):
            return play()

    def _check_and_count(self, frames: TensorDictBase) -> None:
        check_finite(frames, self.frames)
        self._count(frames.numel())

    def _count(self, frames: int) -> None:
        self.frames += frames
        if isinstance(self._agent.exploration, EGreedyModule):
            self._agent.exploration.step(frames)

    @torch.no_grad()
    def measure(
        self, transitions: TensorDictBase, last_frame: int, *, ends_round: bool = True
    ) -> Episode:
        """Measures an episode: its return and the smoothness of the policy's mean at its states.

        The mean scale of a stochastic policy is logged too: the Hellinger distance is relative to
        it, so a policy can reduce the penalty by becoming wider.
        """
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = self._agent.policy(transitions.select("observation"))
        mean, scale = written["action"].float(), written.get("scale", None)
        values = (
            transitions["next", "reward"].sum().item(),
            action_variation(mean).item() if len(mean) > 1 else 0.0,
            math.nan if scale is None else scale.mean().item(),
            transitions.numel(),
        )
        measures = dict(zip(EPISODE_COLUMNS, values, strict=True))
        return Episode(transitions, last_frame, measures, ends_round)
