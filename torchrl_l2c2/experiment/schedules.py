"""When a run learns: after every frame, after every episode, or after every rollout.

Each schedule is the whole loop: it plays, remembers, learns, and hands out the episodes that it has
learned from. What a run does between two of them, and when it ends, is the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_l2c2.experiment.algorithms import PPOConfig
from torchrl_l2c2.experiment.algorithms.base import OffPolicyConfig
from torchrl_l2c2.experiment.learner import Learner
from torchrl_l2c2.experiment.player import Episode, Player


def by_step(player: Player, learner: Learner, algorithm: OffPolicyConfig) -> Iterator[Episode]:
    """Updates after every frame."""
    while True:
        frames: list[TensorDictBase] = []
        while not frames or not frames[-1]["next", "done"][-1]:
            (frame,) = player.step()
            frames.append(frame)
            learner.remember(frame)
            _learn(learner, algorithm, 1, player.frames)
        yield player.measured(torch.cat(frames), player.frames)


def by_episode(player: Player, learner: Learner, algorithm: OffPolicyConfig) -> Iterator[Episode]:
    """Updates after every episode: the paper's, as far as it can be inferred."""
    while True:
        episodes = player.play()
        for episode in episodes:
            learner.remember(episode.transitions)
        for episode in episodes:
            _learn(learner, algorithm, episode.transitions.numel(), episode.last_frame)
            yield episode


def by_rollout(player: Player, learner: Learner, algorithm: PPOConfig) -> Iterator[Episode]:
    """Updates with everything that one policy has played, once it is enough."""
    if algorithm.num_envs is not None:
        yield from by_frames(player, learner, algorithm)
    while True:
        episodes = player.play()
        for episode in episodes:
            learner.remember(episode.transitions)
        for episode in episodes:
            if len(learner.replay) >= algorithm.frames:
                learner.learn_rollout(algorithm.epochs)
            yield episode


def by_frames(player: Player, learner: Learner, algorithm: PPOConfig) -> Iterator[Episode]:
    """Updates after so many frames, wherever episodes are then; hands out those that have ended."""
    normalization = learner.agent.normalization
    while True:
        first_frame = player.frames
        rollout = player.step()
        ended = player.collector.ended
        episodes = [player.measured(e.transitions, first_frame + e.frame) for e in ended]
        for frames in rollout if normalization is None else normalization(rollout):
            learner.remember(frames)
        learner.learn_rollout(algorithm.epochs)
        if normalization is not None:
            normalization.follow()
            learner.agent.refresh_policy()
        for number, episode in enumerate(episodes, start=1):
            episode.ends_round = number == len(episodes)
            yield episode


def _learn(learner: Learner, algorithm: OffPolicyConfig, frames: int, last_frame: int) -> None:
    """The updates that follow some frames, once the random ones are over."""
    if last_frame >= algorithm.random_frames:
        stored, batch_size = len(learner.replay), learner.replay.batch_size
        learner.learn(algorithm.updates_after(frames, last_frame, stored, batch_size))


SCHEDULES: dict[str, Callable[[Player, Learner, Any], Iterator[Episode]]] = {
    "step": by_step,
    "episode": by_episode,
    "rollout": by_rollout,
}
