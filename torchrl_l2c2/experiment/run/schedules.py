"""Training loops with updates after every frame, every episode, or every rollout.

A schedule plays, stores transitions, makes updates, and yields each finished episode, or ``None``
after a rollout without one. The caller decides when training ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from torchrl_l2c2.experiment.collect.player import Episode, Player
from torchrl_l2c2.experiment.envs.frames import Frame, stack_frames
from torchrl_l2c2.experiment.learn.learner import Learner
from torchrl_l2c2.experiment.settings.algorithms import OffPolicyConfig, PPOConfig


def by_step(player: Player, learner: Learner, algorithm: OffPolicyConfig) -> Iterator[Episode]:
    """Updates after every frame."""
    while True:
        frames: list[Frame] = []
        try:
            while not (frames and frames[-1].done):
                frames.append(player.step())
                learner.remember_frame(frames[-1])
                _learn(learner, algorithm, 1, player.frames)
        except BaseException:
            player.discard_episode()
            raise
        yield player.measure(stack_frames(frames), player.frames)


def by_episode(player: Player, learner: Learner, algorithm: OffPolicyConfig) -> Iterator[Episode]:
    """Updates after every episode, the schedule inferred for the paper."""
    while True:
        episode = player.play()
        learner.remember(episode.transitions)
        _learn(learner, algorithm, episode.transitions.numel(), episode.last_frame)
        yield episode


def by_rollout(player: Player, learner: Learner, algorithm: PPOConfig) -> Iterator[Episode | None]:
    """Updates after every rollout."""
    if algorithm.num_envs is not None:
        return by_fixed_rollouts(player, learner, algorithm)
    return by_episode_rollouts(player, learner, algorithm)


def by_episode_rollouts(
    player: Player, learner: Learner, algorithm: PPOConfig
) -> Iterator[Episode]:
    """Updates after whole episodes with at least ``algorithm.frames`` frames."""
    while True:
        episode = player.play()
        learner.remember(episode.transitions)
        if len(learner.replay) >= algorithm.frames:
            learner.learn_rollout(algorithm.epochs)
        yield episode


def by_fixed_rollouts(
    player: Player, learner: Learner, algorithm: PPOConfig
) -> Iterator[Episode | None]:
    """Updates after exactly ``algorithm.frames`` frames, also within episodes."""
    normalization = learner.agent.normalization
    while True:
        rollout, episodes = player.play_rollout()
        for frames in rollout if normalization is None else normalization(rollout):
            learner.remember(frames)
        learner.learn_rollout(algorithm.epochs)
        if normalization is not None:
            normalization.apply_statistics()
            learner.agent.refresh_policy()
        yield from episodes or (None,)


def _learn(learner: Learner, algorithm: OffPolicyConfig, frames: int, last_frame: int) -> None:
    """Makes the updates that are due after new frames, once the random frames are over."""
    if last_frame >= algorithm.random_frames:
        stored, batch_size = len(learner.replay), learner.replay.batch_size
        learner.learn(algorithm.updates_after(frames, last_frame, stored, batch_size))


SCHEDULES: dict[str, Callable[[Player, Learner, Any], Iterator[Episode | None]]] = {
    "step": by_step,
    "episode": by_episode,
    "rollout": by_rollout,
}
