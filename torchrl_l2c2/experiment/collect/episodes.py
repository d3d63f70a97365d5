"""Fast collection of episodes from one Gymnasium simulator."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_l2c2.experiment.agents._torchrl_internals import first_observation
from torchrl_l2c2.experiment.collect.acting import policy_function
from torchrl_l2c2.experiment.collect.simulation import Simulation, split_environment
from torchrl_l2c2.experiment.envs.environments import NOISE_SEED, simulator_errors
from torchrl_l2c2.experiment.envs.frames import Frame, stack_frames


class EpisodeCollector(Collector):
    """A fast TorchRL :class:`~torchrl.collectors.Collector` for one Gymnasium simulator.

    It returns the same batches as TorchRL's collector, bit for bit, without the ``collector``
    entry. Steps need no specs, nested TensorDicts or copies, and the frames of an episode are
    stacked once.

    Args:
        env (EnvBase): A ``GymEnv`` or ``GymWrapper`` with one tensor under ``"observation"``,
            optionally transformed by :class:`ObservationNoise`.
        policy (TensorDictModule): Policy that reads ``"observation"``.

    Keyword Args:
        frames_per_batch (int): Number of frames in a batch.
        stop_at_done (bool): Whether a batch ends with the episode, even with fewer frames. Updates
            after every episode need this. Default ``True``.
        compile_policy (bool): Whether to compile the policy. Random numbers stay the same. Later
            in-place changes of parameters take effect, but parameters or settings must not be
            replaced after the first frame. Default ``False``.
        random_frames (int): Number of first frames with actions sampled uniformly from their
            bounds. The stored log-likelihood remains the policy's. Default 0.
        exploration_type (ExplorationType): Exploration type of the policy. Default ``RANDOM``.
        keep_previous (bool): Whether frames contain the previous observation as
            ``"previous_observation"``; the first frame of an episode repeats its own observation.
            Default ``False``.

    Raises:
        ValueError: If the environment is batched or has other transforms. Use TorchRL's
            ``Collector`` instead.

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
        self._simulation = Simulation(env, keep_previous=keep_previous)
        super().__init__(
            env,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
            exploration_type=exploration_type,
        )
        # The base class has reset the environment.
        self._simulation.next_observation = first_observation(self)
        self.stop_at_done = stop_at_done
        self._random_frames_left = random_frames
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._act = policy_function(policy, self._policy_keys, compile_policy)
        # Samples may exceed the bounds: frames contain the samples, the task gets clipped actions.
        self._clip_action: Callable[[Tensor], Tensor] | None = getattr(policy, "clip_action", None)
        self._action_spec = self._simulation.env.action_spec
        continuous = self._action_spec.dtype.is_floating_point
        self._to_action = copy_to_numpy if continuous else self._simulation.env.read_action

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Plays up to ``frames_per_batch`` frames. Iterating over the collector calls this."""
        frames: list[Frame] = []
        try:
            with set_exploration_type(self.exploration_type):
                while len(frames) < self.frames_per_batch:
                    frames.append(self._play())
                    if frames[-1].done and self.stop_at_done:
                        break
        except BaseException:
            self._simulation.discard_episode()
            raise
        return stack_frames(frames)

    @torch.no_grad()
    def step(self) -> Frame:
        """Plays one frame. The stacked frames of an episode equal its :meth:`rollout`."""
        with set_exploration_type(self.exploration_type):
            return self._play()

    def _play(self) -> Frame:
        observation = self._simulation.observation()
        outputs = dict(zip(self._policy_keys, self._act(observation), strict=True))
        action = outputs["action"]
        if self._random_frames_left > 0:
            self._random_frames_left -= 1
            action.copy_(self._action_spec.rand())
        clipped = action if self._clip_action is None else self._clip_action(action)
        return self._simulation.step(outputs, self._to_action(clipped))

    def reset(self, index: Any = None, **kwargs: Any) -> None:
        """Ends the current episode. The next frame starts a new one."""
        self._simulation.discard_episode()

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seeds the simulator and its noise, and ends the current episode.

        Args:
            seed (int): Seed of the simulator, at least 0. The noise's seed is derived from it.
            static_seed (bool): Whether to return the same seed. Default ``False``.

        Returns:
            int: Seed for another environment.
        """
        next_seed = super().set_seed(seed, static_seed=static_seed)
        noise = self._simulation.noise
        if noise is not None and noise.generator is not None:
            noise.generator.manual_seed(seed + NOISE_SEED)
        self._simulation.discard_episode()
        return next_seed

    def generator_state(self) -> dict[str, Any]:
        """Returns the states of the random generators between two episodes.

        Raises:
            RuntimeError: If an episode is in progress: the simulator's state cannot be saved.
        """
        if self._simulation.next_observation is not None:
            raise RuntimeError("Expected the end of an episode. Save between two episodes.")
        return {**self._simulation.generators(), "random_frames_left": self._random_frames_left}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`generator_state`. The next frame starts a new episode."""
        self._simulation.set_generators(state)
        self._random_frames_left = state["random_frames_left"]


def copy_to_numpy(action: Tensor) -> np.ndarray:
    """Converts an action to a NumPy array, a copy: simulators may change it."""
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
    """Yields episodes ``[T]`` of a policy. The environment stays open.

    Environments that :class:`EpisodeCollector` does not support are played by their own
    ``rollout``, without compilation.

    Args:
        policy (TensorDictModule): Policy that reads ``"observation"``.
        env (EnvBase): Environment.
        episodes (int): Number of episodes.

    Keyword Args:
        max_steps (int): Maximum frames per episode.
        sampled (bool): Whether actions are sampled. Default ``False``: mean actions.
        compile_policy (bool): Whether to compile the policy. Default ``False``.

    Raises:
        SimulatorError: If the environment or the policy fails; states the episode.
    """
    exploration = ExplorationType.RANDOM if sampled else ExplorationType.DETERMINISTIC
    collector: EpisodeCollector | None = None
    if split_environment(env) is not None:
        collector = EpisodeCollector(
            env,
            policy,
            frames_per_batch=max_steps,
            compile_policy=compile_policy,
            exploration_type=exploration,
        )
    try:
        for number in range(1, episodes + 1):
            with simulator_errors(f"the task failed in test episode {number}"):
                if collector is None:
                    with torch.no_grad(), set_exploration_type(exploration):
                        episode = env.rollout(max_steps, policy)
                else:
                    episode = collector.rollout()
                    if not episode["next", "done"][-1].any():  # Ended by max_steps only.
                        collector.reset()
            yield episode
    finally:
        if collector is not None:
            collector.shutdown(close_env=False)
