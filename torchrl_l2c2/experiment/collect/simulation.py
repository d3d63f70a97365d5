"""A Gymnasium environment that is stepped without TorchRL's overhead."""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import Compose, EnvBase, GymWrapper, Transform, TransformedEnv

from torchrl_l2c2.experiment.agents._torchrl_internals import add_noise, simulator_of
from torchrl_l2c2.experiment.envs.frames import PREVIOUS, Frame, reward_to_float
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.transforms import ObservationNoise


class Simulation:
    """A Gymnasium environment, its observation noise, and the frames of its current episode.

    Unfinished episodes can be saved, although the state of the simulator cannot: on loading, the
    simulator repeats the actions from the initial states of the random generators.

    Args:
        env (EnvBase): A ``GymEnv`` or ``GymWrapper`` with one tensor under ``"observation"``,
            optionally transformed by :class:`~torchrl_l2c2.ObservationNoise`.

    Keyword Args:
        keep_previous (bool): Whether frames contain the previous observation as
            ``"previous_observation"``; the first frame of an episode repeats its own observation.

    Attributes:
        env: The ``GymEnv`` or ``GymWrapper``, without noise.
        noise: Noise on observations; ``None`` without noise.
        frames: Frames of the current episode, or of the last episode until the next reset.
        next_observation: Next observation for the policy; ``None`` before a reset.

    Raises:
        ValueError: If the environment is batched or has other transforms, or its ``np_random`` is
            not a ``numpy.random.Generator``.
    """

    def __init__(self, env: EnvBase, *, keep_previous: bool) -> None:
        parts = split_environment(env)
        if parts is None:
            raise ValueError(
                "Expected one Gymnasium environment with no transform except ObservationNoise, got "
                f"{env}. Use TorchRL's Collector for other environments."
            )
        self.env, self.noise = parts
        self.frames: list[Frame] = []
        self.next_observation: Tensor | None = None
        self._gymnasium = simulator_of(self.env)
        self._dtype = self.env.observation_spec["observation"].dtype
        self._numpy_dtype = torch.empty(0, dtype=self._dtype).numpy().dtype
        self._keep_previous = keep_previous
        self._started_from = self.generators()

    def observation(self) -> Tensor:
        """Returns the current observation, after a reset if no episode is in progress.

        Resets are late: between episodes, the states of the random generators are the whole state.
        """
        if self.next_observation is None:
            self.frames = []
            self._started_from = self.generators()
            self.next_observation = self._observe(self._gymnasium.reset()[0])
        return self.next_observation

    def step(self, outputs: dict[str, Tensor], action: np.ndarray) -> Frame:
        """Plays one frame.

        Args:
            outputs (dict): Outputs of the policy for :meth:`observation`, by key.
            action (numpy.ndarray): Action for the simulator.
        """
        before = self.observation()
        if self._keep_previous:
            outputs[PREVIOUS] = self.frames[-1].observation if self.frames else before
        seen, reward, terminated, truncated, _ = self._gymnasium.step(action)
        after = self._observe(seen)
        frame = Frame(before, outputs, after, reward_to_float(reward), terminated, truncated)
        self.next_observation = None if frame.done else after
        self.frames.append(frame)
        return frame

    def discard_episode(self) -> None:
        """Ends the current episode. The next frame starts a new one."""
        self.next_observation, self.frames = None, []

    def generators(self) -> dict[str, Any]:
        """Returns the states of the simulator's and the noise's random generators."""
        return {
            "simulator": json.dumps(self._bit_generator().state),
            "noise": None if self.noise is None else self.noise.get_extra_state(),
        }

    def set_generators(self, states: Mapping[str, Any]) -> None:
        """Restores states of :meth:`generators`. The next frame starts a new episode."""
        self._bit_generator().state = json.loads(states["simulator"])
        if self.noise is not None:
            self.noise.set_extra_state(states["noise"])
        self.discard_episode()

    def state_dict(self) -> dict[str, Any]:
        """Returns the generators' states at the start of the episode, and the policy's outputs."""
        if self.next_observation is None or not self.frames:
            return {"generators": self.generators(), "following": None, "outputs": {}}
        keys = self.frames[0].outputs
        return {
            "generators": self._started_from,
            "following": self.next_observation,
            "outputs": {key: torch.stack([f.outputs[key] for f in self.frames]) for key in keys},
        }

    def load_state_dict(self, state: Mapping[str, Any], to_action: Any) -> None:
        """Restores a state of :meth:`state_dict` by repeating the actions.

        Args:
            state (Mapping): State of :meth:`state_dict`.
            to_action (callable): Function that converts the policy's action for the simulator.

        Warns:
            UserWarning: If the simulator reaches another observation. A new episode then starts.
        """
        self.set_generators(state["generators"])
        outputs = state["outputs"]
        for row in zip(*(values.unbind(0) for values in outputs.values()), strict=True):
            written = dict(zip(outputs, row, strict=True))
            self.step(written, to_action(written["action"]))
        after = self.next_observation
        if outputs and (after is None or not after.equal(state["following"])):
            warnings.warn(
                f"{self.env} is not reproducible: repeating an episode's actions led to another "
                "observation. A new episode starts, and the run differs from an uninterrupted run.",
                stacklevel=5,
            )
            self.discard_episode()

    def _bit_generator(self) -> Any:
        task = self._gymnasium.unwrapped
        found = getattr(task.np_random, "bit_generator", None)
        if found is None:
            raise UserError(
                f"Expected a numpy.random.Generator as np_random of {type(task).__name__}, got "
                f"{type(task.np_random).__name__}. Use Gymnasium's np_random in the task, which "
                "super().reset(seed=seed) seeds."
            )
        return found

    def _observe(self, seen: np.ndarray) -> Tensor:
        """Converts an observation to a tensor with noise, a copy: simulators may reuse arrays."""
        if self.noise is None:
            # Faster than torch.tensor.
            return torch.from_numpy(np.array(seen, dtype=self._numpy_dtype))
        return add_noise(self.noise, torch.as_tensor(seen, dtype=self._dtype))


def split_environment(env: EnvBase) -> tuple[GymWrapper, ObservationNoise | None] | None:
    """Returns the simulator and its noise; ``None`` if it is batched or has other transforms."""
    transforms: list[Transform] = []
    simulator = env
    if isinstance(env, TransformedEnv):
        transforms, simulator = list(_flat(env.transform)), env.base_env
    plain = isinstance(simulator, GymWrapper) and not simulator.batch_size
    if not plain or len(transforms) > 1:
        return None
    if not all(isinstance(transform, ObservationNoise) for transform in transforms):
        return None
    return simulator, transforms[0] if transforms else None


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for inner in transform:
            yield from _flat(inner)
    else:
        yield transform
