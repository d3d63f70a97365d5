"""Collecting at nearly the speed of the simulator: TorchRL's collector with a plain inner loop."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    EnvBase,
    ExplorationType,
    GymWrapper,
    Transform,
    TransformedEnv,
    set_exploration_type,
)

from torchrl_l2c2.experiment.agents._torchrl_internals import (
    first_observation,
    noisy,
    simulator_of,
)
from torchrl_l2c2.experiment.collect.acting import on_tensors
from torchrl_l2c2.experiment.envs.environments import NOISE_SEED, simulating
from torchrl_l2c2.experiment.envs.frames import PREVIOUS, Frame, as_reward, stack_frames
from torchrl_l2c2.experiment.envs.spaces import Env
from torchrl_l2c2.transforms import ObservationNoise


class EpisodeCollector(Collector):
    """A TorchRL :class:`~torchrl.collectors.Collector`, fast with one Gymnasium simulator.

    It gives the collector's batches, bit for bit, without the ``collector`` entry. It leaves
    out the work around every step: specs, nested TensorDicts and their copies. An episode's
    frames are stacked once.

    Args:
        env (EnvBase): a ``GymEnv`` or ``GymWrapper``, also one transformed by
            :class:`ObservationNoise`, with one tensor of observations under ``"observation"``.
        policy (TensorDictModule): reads ``"observation"``.

    Keyword Args:
        frames_per_batch (int): frames of a batch.
        stop_at_done (bool): whether a batch ends with the episode, even if it is shorter.
            Learning at the end of every episode needs this. Default ``True``.
        compile_policy (bool): whether to compile the policy. Random numbers are drawn as without.
            What is written into its parameters is followed; a parameter or a setting that is
            replaced after the first frame is overlooked. Default ``False``.
        random_frames (int): first frames whose actions are drawn from the action's bounds
            instead; their log-likelihood stays that of the policy's own. Default 0.
        exploration_type (ExplorationType): default ``RANDOM``.
        keep_previous (bool): whether frames have the observation before theirs as well, as
            ``"previous_observation"``; in an episode's first it is their own. Default ``False``.

    Raises:
        ValueError: several environments at once, or one with other transforms. TorchRL's
            ``Collector`` plays these.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> env = GymEnv("Pendulum-v1", max_episode_steps=7)
        >>> actor = make_actor(3, env.action_spec)
        >>> collector = EpisodeCollector(env, actor, frames_per_batch=100)
        >>> [next(iter(collector)).shape for _ in range(2)]
        [torch.Size([7]), torch.Size([7])]
        >>> collector.shutdown()
    """

    frames_per_batch: int

    def __init__(
        self,
        env: EnvBase,
        policy: TensorDictModule,
        *,
        frames_per_batch: int,
        stop_at_done: bool = True,
        compile_policy: bool = False,
        random_frames: int = 0,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
        keep_previous: bool = False,
    ) -> None:
        self._simulator, self._noise = simulator_and_noise(env)
        super().__init__(
            env,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            exploration_type=exploration_type,
        )
        self.stop_at_done = stop_at_done
        self._keep_previous = keep_previous
        self._previous: Tensor | None = None
        self._random_frames_left = random_frames
        # The collector has reset the environment when it was made.
        self._observation: Tensor | None = first_observation(self)
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._act = on_tensors(policy, self._policy_keys, compile_policy)
        # Of a policy whose samples go beyond the bounds: frames have these, the task what it takes.
        self._taken: Callable[[Tensor], Tensor] | None = getattr(policy, "taken", None)
        self._gymnasium = simulator_of(self._simulator)
        self._dtype = self._simulator.observation_spec["observation"].dtype
        continuous = self._simulator.action_spec.dtype.is_floating_point
        self._to_action = as_array if continuous else self._simulator.read_action

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Plays up to ``frames_per_batch`` frames; what iterating over the collector calls."""
        frames: list[Frame] = []
        try:
            with set_exploration_type(self.exploration_type):
                while len(frames) < self.frames_per_batch:
                    frames.append(self._play())
                    if frames[-1].done and self.stop_at_done:
                        break
        except BaseException:
            self._observation = None  # What was played of the episode is lost.
            raise
        return stack_frames(frames)

    @torch.no_grad()
    def step(self) -> Frame:
        """Plays one frame; an episode's frames, stacked, are its :meth:`rollout`."""
        with set_exploration_type(self.exploration_type):
            return self._play()

    def _play(self) -> Frame:
        # Late, so that between episodes nothing of the next one has happened yet: the
        # generators' states are then all there is to save.
        observation = self._observation
        if observation is None:
            observation = self._observe(self._gymnasium.reset()[0])
            self._previous = observation
        outputs = dict(zip(self._policy_keys, self._act(observation), strict=True))
        if self._keep_previous:
            outputs[PREVIOUS] = observation if self._previous is None else self._previous
            self._previous = observation
        action = outputs["action"]
        if self._random_frames_left > 0:
            self._random_frames_left -= 1
            action.copy_(self._simulator.action_spec.rand())
        taken = action if self._taken is None else self._taken(action)
        seen, reward, terminated, truncated, _ = self._gymnasium.step(self._to_action(taken))
        following = self._observe(seen)
        self._observation = None if terminated or truncated else following
        return Frame(observation, outputs, following, as_reward(reward), terminated, truncated)

    def reset(self, index: Any = None, **kwargs: Any) -> None:
        """The next frame begins an episode, wherever the present one is."""
        self._observation = None

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds the simulator and, with another seed, its noise; the next episode starts anew.

        Args:
            seed (int): at least 0.
            static_seed (bool): whether to return the seed as it is.

        Returns:
            int: a seed for another environment.
        """
        following = super().set_seed(seed, static_seed=static_seed)
        if self._noise is not None and self._noise.generator is not None:
            self._noise.generator.manual_seed(seed + NOISE_SEED)
        self._observation = None
        return following

    def generator_state(self) -> dict[str, Any]:
        """The states of the simulator's and the noise's random generators, between episodes.

        Raises:
            RuntimeError: in the middle of an episode, whose simulator's state cannot be saved.
        """
        if self._observation is not None:
            raise RuntimeError("an episode is being played; a run can be saved between episodes.")
        states = generator_states(self._gymnasium, self._noise)
        return {**states, "random_frames_left": self._random_frames_left}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`generator_state` gave; the next episode starts with a reset."""
        set_generator_states(self._gymnasium, self._noise, state)
        self._random_frames_left = state["random_frames_left"]
        self._observation = None

    def _observe(self, seen: np.ndarray) -> Tensor:
        return observed(seen, self._dtype, self._noise)


def observed(seen: np.ndarray, dtype: torch.dtype, noise: ObservationNoise | None) -> Tensor:
    """What the policy gets of an observation: a copy, as a simulator may write into its own."""
    if noise is None:
        return torch.tensor(seen, dtype=dtype)
    return noisy(noise, torch.as_tensor(seen, dtype=dtype))


def generator_states(gymnasium: Env, noise: ObservationNoise | None) -> dict[str, Any]:
    """The states of a simulator's random generator and of its noise's, where there is noise."""
    return {
        "simulator": json.dumps(gymnasium.unwrapped.np_random.bit_generator.state),
        "noise": None if noise is None else noise.get_extra_state(),
    }


def set_generator_states(
    gymnasium: Env, noise: ObservationNoise | None, states: Mapping[str, Any]
) -> None:
    """Restores what :func:`generator_states` gave."""
    gymnasium.unwrapped.np_random.bit_generator.state = json.loads(states["simulator"])
    if noise is not None:
        noise.set_extra_state(states["noise"])


def as_array(action: Tensor) -> np.ndarray:
    """What the simulator gets of an action: a copy, as it may change it."""
    return action.numpy().copy()


def play_episodes(
    policy: TensorDictModule,
    env: EnvBase,
    episodes: int,
    *,
    max_steps: int,
    sampled: bool = False,
    compile_policy: bool = False,
) -> Iterator[TensorDictBase]:
    """Episodes ``[T]`` of a policy, by its mean or by samples; the environment stays open.

    The arguments are those of :func:`~torchrl_l2c2.experiment.evaluate_policy`. An environment
    that :class:`EpisodeCollector` refuses is played by its own ``rollout``, with the policy as it
    is.

    Raises:
        SimulatorError: the environment or the policy failed; names the episode.
    """
    exploration = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    collector: EpisodeCollector | None = None
    if _parts(env) is not None:
        collector = EpisodeCollector(
            env,
            policy,
            frames_per_batch=max_steps,
            compile_policy=compile_policy,
            exploration_type=exploration,
        )
    try:
        for number in range(1, episodes + 1):
            with simulating(f"the task failed in test episode {number}"):
                if collector is None:
                    with torch.no_grad(), set_exploration_type(exploration):
                        episode = env.rollout(max_steps, policy)
                else:
                    episode = collector.rollout()
                    if not episode["next", "done"][-1].any():  # No end of the environment's own.
                        collector.reset()
            yield episode
    finally:
        if collector is not None:
            collector.shutdown(close_env=False)


def simulator_and_noise(env: EnvBase) -> tuple[GymWrapper, ObservationNoise | None]:
    """The two parts of an environment.

    Raises:
        ValueError: there are other parts.
    """
    parts = _parts(env)
    if parts is None:
        raise ValueError(
            "Expected one Gymnasium environment with no transform but ObservationNoise, got "
            f"{env}. Use TorchRL's Collector for others."
        )
    return parts


def _parts(env: EnvBase) -> tuple[GymWrapper, ObservationNoise | None] | None:
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
