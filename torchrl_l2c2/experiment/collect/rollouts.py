"""Rollouts of a fixed length from several simulators."""

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
from torchrl_l2c2.experiment.collect.acting import policy_function
from torchrl_l2c2.experiment.collect.episodes import (
    generator_states,
    set_generator_states,
    simulator_and_noise,
    to_observation,
)
from torchrl_l2c2.experiment.envs.frames import PREVIOUS, Frame, reward_to_float, stack_frames


class FinishedEpisode(NamedTuple):
    """An episode that ended in a rollout.

    Attributes:
        frame: Number of frames of the rollout, over all simulators, at the end of the episode.
        transitions: Transitions ``[T]`` of the whole episode.
    """

    frame: int
    transitions: TensorDictBase


class RolloutCollector:
    """Steps several Gymnasium simulators in one process with one policy, in turn.

    The policy is called once per step for all simulators. Episodes may extend over several
    rollouts. ``("next", "observation")`` of a simulator's last frame is the observation for
    bootstrapping. At the end of an episode it is the episode's last observation, not the first of
    the next.

    Unfinished episodes can be saved: on loading, the simulator repeats the actions from the initial
    states of the random generators.

    Args:
        envs (sequence of EnvBase): One environment per simulator, each with its own seed, as for
            :class:`~torchrl_l2c2.experiment.EpisodeCollector`.
        policy (TensorDictModule): Policy that reads ``"observation"`` ``[N, F]``. Simulators get
            actions clipped to their bounds; frames contain the unclipped actions.

    Keyword Args:
        frames_per_batch (int): Frames per rollout over all simulators, a multiple of the number of
            environments.
        compile_policy (bool): Whether to compile the policy. Default ``False``.
        exploration_type (ExplorationType): Exploration type of the policy. Default ``RANDOM``.
        keep_previous (bool): Whether frames contain the previous observation, as for
            :class:`~torchrl_l2c2.experiment.EpisodeCollector`. Default ``False``.

    Attributes:
        finished_episodes: Episodes that ended in the last rollout, in the order of their ends.

    Raises:
        ValueError: If an environment is batched or has other transforms than
            :class:`~torchrl_l2c2.ObservationNoise`.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> envs = [GymEnv("Pendulum-v1", max_episode_steps=7) for _ in range(2)]
        >>> actor = make_actor(3, envs[0].action_spec)
        >>> collector = RolloutCollector(envs, actor, frames_per_batch=20)
        >>> [frames.shape for frames in collector.rollout()]
        [torch.Size([10]), torch.Size([10])]
        >>> [(episode.frame, len(episode.transitions)) for episode in collector.finished_episodes]
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
        self._act = policy_function(policy, self._policy_keys, compile_policy)
        self._exploration_type = exploration_type
        self.finished_episodes: list[FinishedEpisode] = []

    @torch.no_grad()
    def rollout(self) -> list[TensorDictBase]:
        """Plays the next frames ``[T]`` of every simulator."""
        self.finished_episodes = []
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
                        self.finished_episodes.append(FinishedEpisode(frame, stream.finish()))
        return [stack_frames(frames) for frames in played]

    def generator_state(self) -> dict[str, Any]:
        """Returns the states of the random generators, and the unfinished episodes."""
        return {"streams": {str(i): s.state_dict() for i, s in enumerate(self._streams)}}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`generator_state` by repeating the unfinished episodes.

        Warns:
            UserWarning: If a simulator reaches another observation. A new episode then starts.
        """
        for i, stream in enumerate(self._streams):
            stream.load_state_dict(state["streams"][str(i)])

    def shutdown(self) -> None:
        """Closes the simulators."""
        for stream in self._streams:
            stream.close()


class _Stream:
    """A simulator and its current episode."""

    def __init__(self, env: EnvBase, keep_previous: bool) -> None:
        simulator, self._noise = simulator_and_noise(env)
        self._env, self._gymnasium = env, simulator_of(simulator)
        self._keep_previous = keep_previous
        self._dtype = simulator.observation_spec["observation"].dtype
        space: Any = self._gymnasium.action_space
        self._low, self._high = space.low, space.high
        self._observation: Tensor | None = None
        self._frames: list[Frame] = []
        self._initial_generators = self._generators()

    def observation(self) -> Tensor:
        """Returns the current observation, after a reset if no episode is in progress."""
        if self._observation is None:
            self._initial_generators = self._generators()
            self._observation = self._observe(self._gymnasium.reset()[0])
        return self._observation

    def step(self, outputs: dict[str, Tensor]) -> Frame:
        """Takes the policy's action, clipped to its bounds, and returns the frame."""
        before = self.observation()
        action = np.clip(outputs["action"].numpy(), self._low, self._high)
        seen, reward, terminated, truncated, _ = self._gymnasium.step(action)
        self._observation = self._observe(seen)
        if self._keep_previous:
            outputs[PREVIOUS] = self._frames[-1].observation if self._frames else before
        reward = reward_to_float(reward)
        frame = Frame(before, outputs, self._observation, reward, terminated, truncated)
        self._frames.append(frame)
        return frame

    def finish(self) -> TensorDictBase:
        """Returns the finished episode and prepares the next one."""
        episode = stack_frames(self._frames)
        self._observation, self._frames = None, []
        return episode

    def state_dict(self) -> dict[str, Any]:
        """Returns the generators' states at the start of the episode, and the policy's outputs."""
        if not self._frames:
            return {"generators": self._generators(), "following": None, "outputs": {}}
        written = {key: [f.outputs[key] for f in self._frames] for key in self._frames[0].outputs}
        return {
            "generators": self._initial_generators,
            "following": self._frames[-1].next_observation,
            "outputs": {key: torch.stack(values) for key, values in written.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`state_dict` by repeating the actions."""
        set_generator_states(self._gymnasium, self._noise, state["generators"])
        self._observation, self._frames = None, []
        outputs = state["outputs"]
        for row in zip(*(values.unbind(0) for values in outputs.values()), strict=True):
            self.step(dict(zip(outputs, row, strict=True)))
        if self._frames and not self._frames[-1].next_observation.equal(state["following"]):
            warnings.warn(
                f"{self._env} is not reproducible: repeating an episode's actions led to another "
                "observation. A new episode starts, and the run differs from an uninterrupted run.",
                stacklevel=4,
            )
            self._observation, self._frames = None, []

    def close(self) -> None:
        """Closes the simulator."""
        if not self._env.is_closed:
            self._env.close()

    def _observe(self, seen: np.ndarray) -> Tensor:
        return to_observation(seen, self._dtype, self._noise)

    def _generators(self) -> dict[str, Any]:
        return generator_states(self._gymnasium, self._noise)
