"""Rollouts of a fixed length from several simulators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.collect.acting import policy_function
from torchrl_l2c2.experiment.collect.simulation import Simulation
from torchrl_l2c2.experiment.envs.frames import Frame, stack_frames


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

    Unfinished episodes can be saved, see :class:`~.simulation.Simulation`.

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
            :class:`~torchrl_l2c2.ObservationNoise`, or ``frames_per_batch`` is not a multiple of
            the number of environments.

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
        self._simulations = [Simulation(env, keep_previous=keep_previous) for env in envs]
        self._steps = frames_per_batch // len(envs)
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._act = policy_function(policy, self._policy_keys, compile_policy)
        self._exploration_type = exploration_type
        space: Any = self._simulations[0].env.action_space
        self._low, self._high = space.low, space.high
        self.finished_episodes: list[FinishedEpisode] = []

    @torch.no_grad()
    def rollout(self) -> list[TensorDictBase]:
        """Plays the next frames ``[T]`` of every simulator."""
        self.finished_episodes = []
        played: list[list[Frame]] = [[] for _ in self._simulations]
        with set_exploration_type(self._exploration_type):
            for step in range(self._steps):
                observations = [simulation.observation() for simulation in self._simulations]
                outputs = self._act(torch.stack(observations))
                rows = zip(*(output.unbind(0) for output in outputs), strict=True)
                for place, row in enumerate(rows):
                    simulation = self._simulations[place]
                    written = dict(zip(self._policy_keys, row, strict=True))
                    played[place].append(
                        simulation.step(written, self._to_action(written["action"]))
                    )
                    if played[place][-1].done:
                        frame = step * len(self._simulations) + place + 1
                        self.finished_episodes.append(
                            FinishedEpisode(frame, stack_frames(simulation.frames))
                        )
        return [stack_frames(frames) for frames in played]

    def generator_state(self) -> dict[str, Any]:
        """Returns the states of the random generators, and the unfinished episodes."""
        return {"streams": {str(i): s.state_dict() for i, s in enumerate(self._simulations)}}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`generator_state` by repeating the unfinished episodes.

        Warns:
            UserWarning: If a simulator reaches another observation. A new episode then starts.
        """
        for i, simulation in enumerate(self._simulations):
            simulation.load_state_dict(state["streams"][str(i)], self._to_action)

    def shutdown(self) -> None:
        """Closes the simulators."""
        for simulation in self._simulations:
            if not simulation.env.is_closed:
                simulation.env.close()

    def _to_action(self, action: Tensor) -> np.ndarray:
        clipped: np.ndarray = action.numpy().clip(self._low, self._high)
        return clipped
