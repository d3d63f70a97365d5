"""Playing and measuring an agent's training episodes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.collect.workers import MultiEpisodeCollector
from torchrl_l2c2.experiment.envs.environments import simulator_errors
from torchrl_l2c2.experiment.envs.frames import Frame, check_finite, stack_frames
from torchrl_l2c2.metrics import action_variation

Played = TypeVar("Played")

# Metrics of an episode, by their names in metrics.csv.
EPISODE_COLUMNS = ("return", "action_variation", "policy_scale", "length")


@dataclass
class Episode:
    """An episode and its metrics.

    Attributes:
        transitions: Transitions ``[T]`` of the whole episode.
        last_frame: Number of frames of the run at the end of the episode.
        measures: Metrics by name: return, smoothness of the mean actions, length.
        ends_round: Whether it is the last episode of this policy.
    """

    transitions: TensorDictBase
    last_frame: int
    measures: dict[str, float]
    ends_round: bool = True


class Player:
    """Plays an agent's episodes, measures them, and counts the frames.

    Args:
        collector: Collector of :func:`~.workers.make_collector`.
        agent (Agent): Agent whose policy the collector plays.
        env_id (str): Name of the task, for errors.

    Attributes:
        frames: Number of frames so far.
    """

    def __init__(
        self,
        collector: EpisodeCollector | MultiEpisodeCollector | RolloutCollector,
        agent: Agent,
        env_id: str,
    ) -> None:
        self.collector = collector
        self.frames = 0
        self._agent = agent
        self._env_id = env_id

    def play(self) -> list[Episode]:
        """Plays one episode in every process with the current policy.

        Raises:
            FloatingPointError: If the environment or the policy returns NaN or infinity.
            SimulatorError: If the environment fails.
        """
        last_frame, batches = self.frames, self._batches()
        episodes = []
        for batch in batches:
            last_frame += batch.numel()
            episodes.append(self.measure(batch, last_frame, ends_round=batch is batches[-1]))
        return episodes

    def play_rollout(self) -> tuple[list[TensorDictBase], list[Episode]]:
        """Plays a rollout: the next frames ``[T]`` of every simulator, and the finished episodes.

        Raises:
            FloatingPointError: As :meth:`play`.
            SimulatorError: As :meth:`play`.
        """
        assert isinstance(self.collector, RolloutCollector)  # Ensured by the settings.
        first_frame, batches = self.frames, self._batches()
        finished = self.collector.finished_episodes
        episodes = [
            self.measure(e.transitions, first_frame + e.frame, ends_round=e is finished[-1])
            for e in finished
        ]
        return batches, episodes

    def step(self) -> Frame:
        """Plays the next frame of the current episode.

        Raises:
            FloatingPointError: As :meth:`play`.
            SimulatorError: As :meth:`play`.
        """
        assert isinstance(self.collector, EpisodeCollector)  # Ensured by the settings.
        frame = self._simulate(self.collector.step)
        if not frame.is_finite():
            check_finite(stack_frames([frame]), self.frames)
        self._count(1)
        return frame

    def discard_episode(self) -> None:
        """Discards the unfinished episode of :meth:`step`. The next frame starts a new one."""
        assert isinstance(self.collector, EpisodeCollector)
        self.collector.reset()

    def _batches(self) -> list[TensorDictBase]:
        """Plays, checks and counts the collector's next batches."""
        played = self._simulate(self.collector.rollout)
        batches, last_frame = played if isinstance(played, list) else [played], self.frames
        for batch in batches:
            check_finite(batch, last_frame)
            last_frame += batch.numel()
        self._count(last_frame - self.frames)
        return batches

    def _simulate(self, play: Callable[[], Played]) -> Played:
        with simulator_errors(f"{self._env_id} failed after frame {self.frames}"):
            return play()

    def _count(self, frames: int) -> None:
        self.frames += frames
        if isinstance(self._agent.exploration, EGreedyModule):
            self._agent.exploration.step(frames)

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
