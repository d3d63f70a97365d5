"""Rollouts of a fixed length from several simulators, which episodes may outlast."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.agents._torchrl_internals import simulator_of
from torchrl_l2c2.experiment.collect.acting import on_tensors
from torchrl_l2c2.experiment.collect.episodes import (
    generator_states,
    observed,
    set_generator_states,
    simulator_and_noise,
)
from torchrl_l2c2.experiment.envs.frames import PREVIOUS, Frame, as_reward, stack_frames


class Ended(NamedTuple):
    """An episode that ended in a rollout.

    Attributes:
        frame: of the rollout, counted over all simulators, after which it had ended.
        transitions: of the whole episode, ``[T]``.
    """

    frame: int
    transitions: TensorDictBase


class RolloutCollector:
    """Plays several Gymnasium simulators in this process with one policy, a frame of each in turn.

    The policy is called once for all of them. A rollout is cut where it is full: the next
    one continues the episode, and the last ``("next", "observation")`` of a simulator is
    what to bootstrap from. After an end it is the last observation of the episode, too, and not the
    first one of the next.

    An episode in the middle can be saved, though its simulator cannot: it is played again from the
    state of the random generators that it began with, by the actions that were taken.

    Args:
        envs (sequence of EnvBase): one for each simulator, as
            :class:`~torchrl_l2c2.experiment.EpisodeCollector` takes them, each seeded by itself.
        policy (TensorDictModule): reads ``"observation"`` ``[N, F]``. Its actions are clipped into
            their bounds for the simulators, and kept as they are.

    Keyword Args:
        frames_per_batch (int): of a rollout, a multiple of the number of environments.
        compile_policy (bool): whether to compile the policy. Default ``False``.
        exploration_type (ExplorationType): default ``RANDOM``.
        keep_previous (bool): as for :class:`~torchrl_l2c2.experiment.EpisodeCollector`.

    Attributes:
        ended: the episodes that ended in the last rollout, in the order of their ends.

    Raises:
        ValueError: an environment with transforms other than
            :class:`~torchrl_l2c2.ObservationNoise`.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> envs = [GymEnv("Pendulum-v1", max_episode_steps=7) for _ in range(2)]
        >>> actor = make_actor(3, envs[0].action_spec)
        >>> collector = RolloutCollector(envs, actor, frames_per_batch=20)
        >>> [frames.shape for frames in collector.rollout()]
        [torch.Size([10]), torch.Size([10])]
        >>> [(episode.frame, len(episode.transitions)) for episode in collector.ended]
        [(13, 7), (14, 7)]
        >>> collector.shutdown()
    """

    def __init__(
        self,
        envs: Sequence[EnvBase],
        policy: TensorDictModule,
        *,
        frames_per_batch: int,
        compile_policy: bool = False,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        keep_previous: bool = False,
    ) -> None:
        if frames_per_batch % len(envs):
            raise ValueError(
                f"frames_per_batch must be a multiple of the {len(envs)} environments, got "
                f"{frames_per_batch}."
            )
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._streams = [_Stream(env, keep_previous) for env in envs]
        self._steps = frames_per_batch // len(envs)
        self._act = on_tensors(policy, self._policy_keys, compile_policy)
        self._exploration_type = exploration_type
        self.ended: list[Ended] = []

    @torch.no_grad()
    def rollout(self) -> list[TensorDictBase]:
        """The next frames ``[T]`` of every simulator."""
        self.ended = []
        played: list[list[Frame]] = [[] for _ in self._streams]
        with set_exploration_type(self._exploration_type):
            for step in range(self._steps):
                outputs = self._act(torch.stack([stream.observation() for stream in self._streams]))
                rows = zip(*(output.unbind(0) for output in outputs), strict=True)
                for place, row in enumerate(rows):
                    stream = self._streams[place]
                    played[place].append(
                        stream.step(dict(zip(self._policy_keys, row, strict=True)))
                    )
                    if played[place][-1].done:
                        frame = step * len(self._streams) + place + 1
                        self.ended.append(Ended(frame, stream.finish()))
        return [stack_frames(frames) for frames in played]

    def generator_state(self) -> dict[str, Any]:
        """The random generators' states and the episodes that are being played."""
        return {"streams": {str(i): s.state_dict() for i, s in enumerate(self._streams)}}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`generator_state` gave, by playing the begun episodes again.

        Warns:
            UserWarning: a simulator came to another observation than it did; a new episode begins.
        """
        for i, stream in enumerate(self._streams):
            stream.load_state_dict(state["streams"][str(i)])

    def shutdown(self) -> None:
        """Closes the simulators."""
        for stream in self._streams:
            stream.close()


class _Stream:
    """A simulator and the episode that it is in."""

    def __init__(self, env: EnvBase, keep_previous: bool) -> None:
        simulator, self._noise = simulator_and_noise(env)
        self._env, self._gymnasium = env, simulator_of(simulator)
        self._keep_previous = keep_previous
        self._dtype = simulator.observation_spec["observation"].dtype
        space: Any = self._gymnasium.action_space
        self._low, self._high = space.low, space.high
        self._observation: Tensor | None = None
        self._frames: list[Frame] = []
        self._begun_with = self._generators()

    def observation(self) -> Tensor:
        """The present one; an episode begins where there is none."""
        if self._observation is None:
            self._begun_with = self._generators()
            self._observation = self._observe(self._gymnasium.reset()[0])
        return self._observation

    def step(self, outputs: dict[str, Tensor]) -> Frame:
        """Takes the action in what the policy wrote; gives the frame."""
        before = self.observation()
        taken = np.clip(outputs["action"].numpy(), self._low, self._high)
        seen, reward, terminated, truncated, _ = self._gymnasium.step(taken)
        self._observation = self._observe(seen)
        if self._keep_previous:
            outputs[PREVIOUS] = self._frames[-1].observation if self._frames else before
        earned = as_reward(reward)
        frame = Frame(before, outputs, self._observation, earned, terminated, truncated)
        self._frames.append(frame)
        return frame

    def finish(self) -> TensorDictBase:
        """The episode that has ended."""
        episode = stack_frames(self._frames)
        self._observation, self._frames = None, []
        return episode

    def state_dict(self) -> dict[str, Any]:
        """The generators' states at the episode's beginning, and what the policy wrote in it."""
        if not self._frames:
            return {"generators": self._generators(), "following": None, "outputs": {}}
        written = {key: [f.outputs[key] for f in self._frames] for key in self._frames[0].outputs}
        return {
            "generators": self._begun_with,
            "following": self._frames[-1].following,
            "outputs": {key: torch.stack(values) for key, values in written.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores it: the simulator plays the same actions again."""
        set_generator_states(self._gymnasium, self._noise, state["generators"])
        self._observation, self._frames = None, []
        outputs = state["outputs"]
        for row in zip(*(values.unbind(0) for values in outputs.values()), strict=True):
            self.step(dict(zip(outputs, row, strict=True)))
        if self._frames and not self._frames[-1].following.equal(state["following"]):
            warnings.warn(
                f"{self._env} plays an episode differently when it is played again: another one "
                "begins instead, and the run is not the one that it would have been in one go.",
                stacklevel=4,
            )
            self._observation, self._frames = None, []

    def close(self) -> None:
        """Closes the simulator."""
        if not self._env.is_closed:
            self._env.close()

    def _observe(self, seen: np.ndarray) -> Tensor:
        return observed(seen, self._dtype, self._noise)

    def _generators(self) -> dict[str, Any]:
        return generator_states(self._gymnasium, self._noise)
