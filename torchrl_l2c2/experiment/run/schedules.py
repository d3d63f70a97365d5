"""When a run learns: after every frame, after every episode, or after every rollout.

Each schedule is the whole loop: it plays, remembers, learns, and hands out the episodes that it has
learned from, or ``None`` after a rollout that none has ended in. What a run does then, and when it
ends, is the caller's.
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
        except KeyboardInterrupt:
            player.discard_episode()
            raise
        yield player.measure(stack_frames(frames), player.frames)


def by_episode(player: Player, learner: Learner, algorithm: OffPolicyConfig) -> Iterator[Episode]:
    """Updates after every episode: the schedule inferred for the paper."""
    while True:
        episodes = player.play()
        for episode in episodes:
            learner.remember(episode.transitions)
        for episode in episodes:
            _learn(learner, algorithm, episode.transitions.numel(), episode.last_frame)
            yield episode


def by_rollout(player: Player, learner: Learner, algorithm: PPOConfig) -> Iterator[Episode | None]:
    """Updates with everything that one policy has played, once it is enough."""
    if algorithm.num_envs is not None:
        return by_cut_rollout(player, learner, algorithm)
    return by_rollout_of_episodes(player, learner, algorithm)


def by_rollout_of_episodes(
    player: Player, learner: Learner, algorithm: PPOConfig
) -> Iterator[Episode]:
    """Updates after so many frames at least, of whole episodes."""
    while True:
        episodes = player.play()
        for episode in episodes:
            learner.remember(episode.transitions)
        for episode in episodes:
            if len(learner.replay) >= algorithm.frames:
                learner.learn_rollout(algorithm.epochs)
            yield episode


def by_cut_rollout(
    player: Player, learner: Learner, algorithm: PPOConfig
) -> Iterator[Episode | None]:
    """Updates after so many frames, wherever episodes are then; hands out those that have ended."""
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
    """The updates that follow some frames, once the random ones are over."""
    if last_frame >= algorithm.random_frames:
        stored, batch_size = len(learner.replay), learner.replay.batch_size
        learner.learn(algorithm.updates_after(frames, last_frame, stored, batch_size))


SCHEDULES: dict[str, Callable[[Player, Learner, Any], Iterator[Episode | None]]] = {
    "step": by_step,
    "episode": by_episode,
    "rollout": by_rollout,
}
