"""Playing and measuring an agent's training episodes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.envs.environments import make_env, simulator_errors, time_limit
from torchrl_l2c2.experiment.envs.frames import Frame, check_finite, stack_frames
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.metrics import action_variation

Played = TypeVar("Played")

# Metrics of an episode, by their names in metrics.csv.
EPISODE_COLUMNS = ("return", "action_variation", "policy_scale", "length")
# Distance of the seeds of a run's simulators, large enough to differ from other runs' seeds. It is
# odd, so seeds also differ after the division by NumPy's limit.
SEED_STRIDE = 15_485_863
SEED_LIMIT = 2**32


def make_collector(
    config: ExperimentConfig, env: EnvBase, agent: Agent, *, compile: bool
) -> EpisodeCollector | RolloutCollector:
    """Creates the collector of a run: rollouts with ``algorithm.num_envs``, otherwise episodes.

    Args:
        config (ExperimentConfig): Settings of the run.
        env (EnvBase): Environment of the task, the first of ``num_envs``.
        agent (Agent): Agent whose policy acts.

    Keyword Args:
        compile (bool): Whether to compile the policy.
    """
    algorithm = config.algorithm
    options: dict[str, Any] = {
        "compile_policy": compile,
        "keep_previous": config.regularizer.reads_previous,
    }
    if algorithm.num_envs is not None:
        numbers = range(1, algorithm.num_envs)
        seeds = ((config.seed + SEED_STRIDE * i) % SEED_LIMIT for i in numbers)
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
    """An episode and its metrics.

    Attributes:
        transitions: Transitions ``[T]`` of the whole episode.
        last_frame: Number of frames of the run at the end of the episode.
        measures: Metrics by name: return, smoothness of the mean actions, mean scale of the policy,
            length.
        ends_round: Whether it is the last episode of this policy.
    """

    transitions: TensorDictBase
    last_frame: int
    measures: dict[str, float]
    ends_round: bool = True


class Player:
    """Plays an agent's episodes, measures them, and counts the frames.

    Args:
        collector: Collector of :func:`make_collector`.
        agent (Agent): Agent whose policy acts.
        env_id (str): Id of the environment, for errors.

    Attributes:
        frames: Number of frames so far.
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
            FloatingPointError: If the environment or the policy returns NaN or infinity.
            SimulatorError: If the environment fails.
        """
        assert isinstance(self.collector, EpisodeCollector)  # Ensured by make_collector.
        transitions = self._simulate(self.collector.rollout, "in the episode ")
        self._check_and_count(transitions)
        return self.measure(transitions, self.frames)

    def play_rollout(self) -> tuple[list[TensorDictBase], list[Episode]]:
        """Plays a rollout: the next frames ``[T]`` of every simulator, and the finished episodes.

        Raises:
            FloatingPointError: As :meth:`play`.
            SimulatorError: As :meth:`play`.
        """
        assert isinstance(self.collector, RolloutCollector)
        first_frame = self.frames
        rollout = self._simulate(self.collector.rollout, "in the rollout ")
        for frames in rollout:
            self._check_and_count(frames)
        finished = self.collector.finished_episodes
        episodes = [
            self.measure(e.transitions, first_frame + e.frame, ends_round=e is finished[-1])
            for e in finished
        ]
        return rollout, episodes

    def step(self) -> Frame:
        """Plays the next frame of the current episode.

        Raises:
            FloatingPointError: As :meth:`play`.
            SimulatorError: As :meth:`play`.
        """
        assert isinstance(self.collector, EpisodeCollector)
        frame = self._simulate(self.collector.step)
        if not frame.is_finite():
            check_finite(stack_frames([frame]), self.frames)
        self.frames += 1
        return frame

    def discard_episode(self) -> None:
        """Discards the unfinished episode of :meth:`step`. The next frame starts a new one."""
        assert isinstance(self.collector, EpisodeCollector)
        self.collector.reset()

    def _simulate(self, play: Callable[[], Played], during: str = "") -> Played:
        with simulator_errors(f"{self._env_id} failed {during}after frame {self.frames}"):
            return play()

    def _check_and_count(self, frames: TensorDictBase) -> None:
        check_finite(frames, self.frames)
        self.frames += frames.numel()

    @torch.no_grad()
    def measure(
        self, transitions: TensorDictBase, last_frame: int, *, ends_round: bool = True
    ) -> Episode:
        """Measures the return of an episode and the smoothness of the mean actions at its states.

        Also measures the mean scale of a stochastic policy: the Hellinger distance is relative to
        it, so a larger scale also lowers the penalty of L2C2.

        Args:
            transitions (TensorDictBase): Transitions ``[T]`` of the whole episode.
            last_frame (int): Number of frames of the run at the end of the episode.

        Keyword Args:
            ends_round (bool): Whether it is the last episode of this policy. Default ``True``.
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
