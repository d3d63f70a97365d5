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

from torchrl_l2c2.experiment.acting import on_tensors
from torchrl_l2c2.experiment.environments import NOISE_SEED, simulating
from torchrl_l2c2.experiment.frames import PREVIOUS, Frame, as_reward, stack_frames
from torchrl_l2c2.experiment.spaces import Env
from torchrl_l2c2.transforms import ObservationNoise


class EpisodeCollector(Collector):
    """A TorchRL :class:`~torchrl.collectors.Collector`, fast with one Gymnasium simulator.

    It gives the batches that the collector gives, to the bit, but for the ``collector`` entry.
    What it leaves out is the work around every step: specs, nested TensorDicts and their copies.
    An episode's frames are stacked once. That is for a ``GymEnv`` or ``GymWrapper``, also one
    transformed by :class:`ObservationNoise`; environments with other transforms, and several at
    once, are played by TorchRL's own loop, at its pace, with the policy as it is, and a state of
    theirs cannot be saved.

    Args:
        env (EnvBase): on the CPU, with one tensor of observations under ``"observation"``.
        policy (TensorDictModule): reads ``"observation"``.

    Keyword Args:
        frames_per_batch (int): frames of a batch.
        stop_at_done (bool): whether a batch ends with the episode, even if it is shorter.
            Learning at the end of every episode needs this. Several environments, whose episodes
            end at different times, fill a batch in any case. Default ``True``.
        compile_policy (bool): whether to compile the policy. Random numbers are drawn as without.
            What is written into its parameters is followed; a parameter or a setting that is
            replaced after the first frame is overlooked. Default ``False``.
        random_frames (int): first frames whose actions are drawn from the action's bounds
            instead; their log-likelihood stays that of the policy's own. Default 0.
        exploration_type (ExplorationType): default ``RANDOM``.
        keep_previous (bool): whether frames have the observation before theirs as well, as
            ``"previous_observation"``; in an episode's first it is their own. Default ``False``.

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
        by_torchrl = self._simulator is None
        super().__init__(
            env,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            exploration_type=exploration_type,
            # TorchRL's loop counts them itself, and keeps no batch that one here would change.
            init_random_frames=random_frames if by_torchrl else 0,
            use_buffers=False if by_torchrl else None,
        )
        if keep_previous and by_torchrl:
            raise ValueError(
                "keep_previous needs one Gymnasium simulator with no transform but "
                f"ObservationNoise, got {env}: append CatFrames to it instead."
            )
        self.stop_at_done = stop_at_done
        self._keep_previous = keep_previous
        self._previous: Tensor | None = None
        self._random_frames_left = random_frames
        # The collector has reset the environment when it was made.
        self._observation: Tensor | None = self._carrier.get("observation").clone()
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._act = on_tensors(policy, self._policy_keys, compile_policy)
        # Of a policy whose samples go beyond the bounds: frames have these, the task what it takes.
        self._taken: Callable[[Tensor], Tensor] | None = getattr(policy, "taken", None)
        if self._simulator is not None:
            self._gymnasium = self._simulator._env
            self._dtype = self._simulator.observation_spec["observation"].dtype
            continuous = self._simulator.action_spec.dtype.is_floating_point
            self._to_action = as_array if continuous else self._simulator.read_action

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Plays up to ``frames_per_batch`` frames; what iterating over the collector calls."""
        if self._simulator is None:
            return self._rollout_by_torchrl()
        frames: list[Frame] = []
        try:
            with set_exploration_type(self.exploration_type):
                while len(frames) < self.frames_per_batch:
                    frames.append(self._play(self._simulator))
                    if frames[-1].done and self.stop_at_done:
                        break
        except BaseException:
            self._observation = None  # What was played of the episode is lost.
            raise
        return stack_frames(frames)

    @torch.no_grad()
    def step(self) -> Frame:
        """Plays one frame; an episode's frames, stacked, are its :meth:`rollout`.

        Raises:
            RuntimeError: there are several environments, whose frames are batches.
        """
        if self.env.batch_size:
            raise RuntimeError(f"step() plays one environment, got {self.env}.")
        if self._simulator is None:
            return self._frame(self._steps_by_torchrl(1)[0])
        with set_exploration_type(self.exploration_type):
            return self._play(self._simulator)

    def _play(self, simulator: GymWrapper) -> Frame:
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
            action.copy_(simulator.action_spec.rand())
        taken = action if self._taken is None else self._taken(action)
        seen, reward, terminated, truncated, _ = self._gymnasium.step(self._to_action(taken))
        following = self._observe(seen)
        self._observation = None if terminated or truncated else following
        return Frame(observation, outputs, following, as_reward(reward), terminated, truncated)

    def _rollout_by_torchrl(self) -> TensorDictBase:
        if self.env.batch_size or not self.stop_at_done:
            return super().rollout()
        return torch.cat(self._steps_by_torchrl(self.frames_per_batch))

    def _steps_by_torchrl(self, most: int) -> list[TensorDictBase]:
        """Frames ``[1]``, up to an episode's last one."""
        steps: list[TensorDictBase] = []
        frames_per_batch, self.frames_per_batch = self.frames_per_batch, 1
        try:
            while len(steps) < most and not (steps and steps[-1]["next", "done"].any()):
                steps.append(super().rollout())
        finally:
            self.frames_per_batch = frames_per_batch
        return steps

    def _frame(self, step: TensorDictBase) -> Frame:
        following = step["next"]
        return Frame(
            step["observation"][0],
            # TorchRL does not ask the policy for a random frame.
            {key: step[key][0] for key in self._policy_keys if key in step.keys()},
            following["observation"][0],
            following["reward"].item(),
            following["terminated"].item(),
            following["truncated"].item(),
        )

    def reset(self, index: Any = None, **kwargs: Any) -> None:
        """The next frame begins an episode, wherever the present one is."""
        if self._simulator is None:
            super().reset(index, **kwargs)
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
            RuntimeError: in the middle of an episode, whose simulator's state cannot be saved, or
                where TorchRL's loop plays.
        """
        if self._simulator is None:
            raise RuntimeError(
                f"the random state of {self.env} is not known; only that of one GymEnv, with no "
                "transform but ObservationNoise, can be saved."
            )
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
    return noise._apply_transform(torch.as_tensor(seen, dtype=dtype))


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

    The arguments are those of :func:`~torchrl_l2c2.experiment.evaluate_policy`.

    Raises:
        SimulatorError: the environment or the policy failed; names the episode.
    """
    collector = EpisodeCollector(
        env,
        policy,
        frames_per_batch=max_steps,
        compile_policy=compile_policy,
        exploration_type=ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC,
    )
    try:
        for number in range(1, episodes + 1):
            with simulating(f"the task failed in test episode {number}"):
                episode = collector.rollout()
                if not episode["next", "done"][-1].any():  # No end of the environment's own.
                    collector.reset()
            yield episode
    finally:
        collector.shutdown(close_env=False)


def simulator_and_noise(env: EnvBase) -> tuple[GymWrapper | None, ObservationNoise | None]:
    """The two parts of an environment; no simulator where there is more to the environment."""
    transforms: list[Transform] = []
    simulator = env
    if isinstance(env, TransformedEnv):
        transforms, simulator = list(_flat(env.transform)), env.base_env
    plain = isinstance(simulator, GymWrapper) and not simulator.batch_size
    if not plain or len(transforms) > 1:
        return None, None
    if not all(isinstance(transform, ObservationNoise) for transform in transforms):
        return None, None
    return simulator, transforms[0] if transforms else None


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for inner in transform:
            yield from _flat(inner)
    else:
        yield transform
