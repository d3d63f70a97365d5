"""One Gymnasium environment, stepped without TorchRL's work around every step."""

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
from torchrl_l2c2.transforms import ObservationNoise


class Simulation:
    """A Gymnasium environment, its observation noise, and the frames of its current episode.

    An unfinished episode can be saved although the simulator cannot: it is replayed from the states
    of the random generators at its start, with the recorded actions.

    Args:
        env (EnvBase): a ``GymEnv`` or ``GymWrapper``, also one transformed by
            :class:`~torchrl_l2c2.ObservationNoise`, with one observation tensor under
            ``"observation"``.

    Keyword Args:
        keep_previous (bool): whether frames also have the observation before theirs, as
            ``"previous_observation"``. The first frame of an episode has its own observation there.

    Attributes:
        env: the ``GymEnv`` or ``GymWrapper``, without noise.
        frames: frames of the current episode; after its end, until the next reset, of the last one.
        next_observation: what the policy acts on next; ``None`` before a reset.

    Raises:
        ValueError: several environments at once, or one with other transforms.
    """

    def __init__(self, env: EnvBase, *, keep_previous: bool = False) -> None:
        parts = split_environment(env)
        if parts is None:
            raise ValueError(
                "Expected one Gymnasium environment with no transform except ObservationNoise, got "
                f"{env}. Use TorchRL's Collector for others."
            )
        self.env, self.noise = parts
        self.frames: list[Frame] = []
        self.next_observation: Tensor | None = None
        self._gymnasium = simulator_of(self.env)
        self._dtype = self.env.observation_spec["observation"].dtype
        self._keep_previous = keep_previous
        self._started_from = self.generators()

    def observation(self) -> Tensor:
        """Returns what the policy acts on; starts an episode after the end of the last one.

        It does not start one earlier: between episodes only the generators' states must be saved.
        """
        if self.next_observation is None:
            self.frames = []
            self._started_from = self.generators()
            self.next_observation = self._observe(self._gymnasium.reset()[0])
        return self.next_observation

    def step(self, outputs: dict[str, Tensor], action: np.ndarray) -> Frame:
        """Plays one frame.

        Args:
            outputs (dict): what the policy wrote for :meth:`observation`.
            action (numpy.ndarray): the action for the simulator.
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
        """Ends the current episode; the next frame starts another one."""
        self.next_observation, self.frames = None, []

    def generators(self) -> dict[str, Any]:
        """Returns the states of the simulator's and the noise's random generators."""
        generator = self._gymnasium.unwrapped.np_random.bit_generator
        return {
            "simulator": json.dumps(generator.state),
            "noise": None if self.noise is None else self.noise.get_extra_state(),
        }

    def set_generators(self, states: Mapping[str, Any]) -> None:
        """Restores what :meth:`generators` returned; the next frame starts an episode."""
        generator = self._gymnasium.unwrapped.np_random.bit_generator
        generator.state = json.loads(states["simulator"])
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
        """Restores what :meth:`state_dict` returned by playing the same actions again.

        Args:
            state (Mapping): the state.
            to_action (callable): makes the simulator's action from the policy's.

        Warns:
            UserWarning: the simulator arrived at another observation; a new episode starts.
        """
        self.set_generators(state["generators"])
        outputs = state["outputs"]
        for row in zip(*(values.unbind(0) for values in outputs.values()), strict=True):
            written = dict(zip(outputs, row, strict=True))
            self.step(written, to_action(written["action"]))
        after = self.next_observation
        if outputs and (after is None or not after.equal(state["following"])):
            warnings.warn(
                f"{self.env} plays an episode differently the second time. A new episode starts, "
                "and the run differs from an uninterrupted one.",
                stacklevel=5,
            )
            self.discard_episode()

    def _observe(self, seen: np.ndarray) -> Tensor:
        """Copies an observation, because simulators may write into theirs, and adds the noise."""
        if self.noise is None:
            return torch.tensor(seen, dtype=self._dtype)
        return add_noise(self.noise, torch.as_tensor(seen, dtype=self._dtype))


def split_environment(env: EnvBase) -> tuple[GymWrapper, ObservationNoise | None] | None:
    """Returns the simulator and its noise; ``None`` for environments with other parts."""
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
