"""What is played: episodes, checked and measured."""

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
from torchrl_l2c2.experiment.envs.environments import simulating
from torchrl_l2c2.experiment.envs.frames import Frame, check_finite, stack_frames
from torchrl_l2c2.metrics import action_variation

Played = TypeVar("Played")

# Of every episode, by their names in metrics.csv.
EPISODE_COLUMNS = ("return", "action_variation", "policy_scale", "length")


@dataclass
class Episode:
    """An episode and what was measured of it.

    Attributes:
        transitions: of the whole episode, ``[T]``.
        last_frame: frames of the run up to and with its last.
        measures: return, smoothness of the policy's mean, length.
        ends_round: whether no other episode was played with the same policy after it.
    """

    transitions: TensorDictBase
    last_frame: int
    measures: dict[str, float]
    ends_round: bool = True


class Player:
    """Plays an agent's episodes, and measures and counts what is played.

    Args:
        collector: plays, as :func:`~.workers.make_collector` makes it.
        agent (Agent): whose policy it plays.
        env_id (str): for errors.

    Attributes:
        frames: played so far.
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
        """One episode of every process, all by the policy as it is now.

        Raises:
            FloatingPointError: NaN or infinity in what the environment or the policy gave.
            SimulatorError: the environment failed.
        """
        last_frame, batches = self.frames, self._batches()
        episodes = []
        for batch in batches:
            last_frame += batch.numel()
            episodes.append(self.measured(batch, last_frame, ends_round=batch is batches[-1]))
        return episodes

    def play_rollout(self) -> tuple[list[TensorDictBase], list[Episode]]:
        """The next frames ``[T]`` of every simulator, and the episodes that ended in them.

        Raises:
            FloatingPointError: as :meth:`play`.
            SimulatorError: as :meth:`play`.
        """
        assert isinstance(self.collector, RolloutCollector)  # The settings see to it.
        first_frame, batches = self.frames, self._batches()
        ended = self.collector.ended
        episodes = [
            self.measured(e.transitions, first_frame + e.frame, ends_round=e is ended[-1])
            for e in ended
        ]
        return batches, episodes

    def step(self) -> Frame:
        """The next frame of the one episode that is being played.

        Raises:
            FloatingPointError: as :meth:`play`.
            SimulatorError: as :meth:`play`.
        """
        assert isinstance(self.collector, EpisodeCollector)  # The settings see to it.
        frame = self._simulate(self.collector.step)
        if not frame.is_finite():
            check_finite(stack_frames([frame]), self.frames)
        self._count(1)
        return frame

    def drop_episode(self) -> None:
        """What :meth:`step` has played of an episode is of none; the next frame begins another."""
        assert isinstance(self.collector, EpisodeCollector)
        self.collector.reset()

    def _batches(self) -> list[TensorDictBase]:
        """What the collector plays at once, checked and counted."""
        played = self._simulate(self.collector.rollout)
        batches, last_frame = played if isinstance(played, list) else [played], self.frames
        for batch in batches:
            check_finite(batch, last_frame)
            last_frame += batch.numel()
        self._count(last_frame - self.frames)
        return batches

    def _simulate(self, play: Callable[[], Played]) -> Played:
        with simulating(f"{self._env_id} failed beyond frame {self.frames}"):
            return play()

    def _count(self, frames: int) -> None:
        self.frames += frames
        if isinstance(self._agent.exploration, EGreedyModule):
            self._agent.exploration.step(frames)

    @torch.no_grad()
    def measured(
        self, transitions: TensorDictBase, last_frame: int, *, ends_round: bool = True
    ) -> Episode:
        """An episode with its return and, at its states, the smoothness of the policy's mean.

        With the mean scale of a stochastic policy: the Hellinger distance is relative to it, so a
        policy can satisfy L2C2 by becoming wider.
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
