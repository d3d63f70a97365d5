"""Collecting at nearly the speed of the simulator: TorchRL's collectors with a plain inner loop."""

from __future__ import annotations

import atexit
import json
import signal
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import (
    Compose,
    EnvBase,
    ExplorationType,
    GymEnv,
    Transform,
    TransformedEnv,
    set_exploration_type,
)

from torchrl_l2c2.experiment.compilation import compiled
from torchrl_l2c2.transforms import ObservationNoise

# Added to the seed of an environment for its noise: the two are not to draw the same numbers.
NOISE_SEED = 7_919


class EpisodeCollector(Collector):
    """A TorchRL :class:`~torchrl.collectors.Collector` for one Gymnasium simulator on the CPU.

    It gives the batches that the collector gives, to the bit, but for the ``collector`` entry.
    What it leaves out is the work around every step: specs, nested TensorDicts and their copies.
    An episode's entries are kept in lists and stacked once.

    Args:
        env (EnvBase): a ``GymEnv``, or one transformed by :class:`ObservationNoise` alone, with
            one tensor of observations under ``"observation"``.
        policy (TensorDictModule): reads ``"observation"``.

    Keyword Args:
        frames_per_batch (int): frames of a batch.
        stop_at_done (bool): whether a batch ends with the episode, even if it is shorter.
            Learning at the end of every episode needs this. Default ``True``.
        compile_policy (bool): whether to compile the policy. Random numbers are drawn as without.
            Default ``False``.
        random_frames (int): first frames whose actions are drawn from the action's bounds
            instead. Default 0.
        exploration_type (ExplorationType): default ``RANDOM``.

    Raises:
        TypeError: an environment of another kind.

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
    ) -> None:
        self._simulator, self._noise = _parts(env)
        self._gymnasium = self._simulator._env
        self._dtype = self._simulator.observation_spec["observation"].dtype
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
        self._random_frames_left = random_frames
        # The collector has reset the environment when it was made.
        self._observation: Tensor | None = self._carrier.get("observation")
        self._policy_keys = [key for key in policy.out_keys if not key.startswith("_")]
        self._act = _on_tensors(policy, self._policy_keys, compile_policy)
        continuous = self._simulator.action_spec.dtype.is_floating_point
        self._to_action = Tensor.numpy if continuous else self._simulator.read_action

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Plays up to ``frames_per_batch`` frames; what iterating over the collector calls."""
        action_index = self._policy_keys.index("action")
        observation = self._observation
        steps = []
        with set_exploration_type(self.exploration_type):
            for _ in range(self.frames_per_batch):
                # Late, so that between episodes nothing of the next one has happened yet: the
                # generators' states are then all there is to save.
                if observation is None:
                    observation = self._observe(self._gymnasium.reset()[0])
                outputs = self._act(observation)
                if self._random_frames_left > 0:
                    self._random_frames_left -= 1
                    outputs[action_index].copy_(self._simulator.action_spec.rand())
                action = self._to_action(outputs[action_index])
                seen, reward, terminated, truncated, _ = self._gymnasium.step(action)
                following = self._observe(seen)
                steps.append((observation, following, reward, terminated, truncated, outputs))
                observation = following
                if terminated or truncated:
                    observation = None
                    if self.stop_at_done:
                        break
        self._observation = observation
        return self._stack(steps)

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
        simulator = self._gymnasium.unwrapped.np_random.bit_generator.state
        noise = None if self._noise is None else self._noise.generator.get_state()
        return {
            "simulator": json.dumps(simulator),
            "noise": noise,
            "random_frames_left": self._random_frames_left,
        }

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`generator_state` gave; the next episode starts with a reset."""
        simulator = json.loads(state["simulator"])
        self._gymnasium.unwrapped.np_random.bit_generator.state = simulator
        if self._noise is not None:
            self._noise.generator.set_state(state["noise"])
        self._random_frames_left = state["random_frames_left"]
        self._observation = None

    def _observe(self, seen: np.ndarray) -> Tensor:
        observation = torch.as_tensor(seen, dtype=self._dtype)
        return observation if self._noise is None else self._noise._apply_transform(observation)

    def _stack(self, steps: list[tuple[Any, ...]]) -> TensorDictBase:
        observations, following, rewards, terminated, truncated, outputs = zip(*steps, strict=True)
        ends = [torch.tensor(flags).unsqueeze(-1) for flags in (terminated, truncated)]
        written = [torch.stack(values) for values in zip(*outputs, strict=True)]
        false = torch.zeros_like(ends[0])
        return TensorDict(
            {
                "observation": torch.stack(observations),
                "done": false,
                "terminated": false.clone(),
                "truncated": false.clone(),
                **dict(zip(self._policy_keys, written, strict=True)),
                "next": {
                    "observation": torch.stack(following),
                    "reward": torch.tensor(rewards, dtype=torch.float32).unsqueeze(-1),
                    "done": ends[0] | ends[1],
                    "terminated": ends[0],
                    "truncated": ends[1],
                },
            },
            [len(steps)],
        )


class MultiEpisodeCollector(MultiSyncCollector):
    """An :class:`EpisodeCollector` in each of several processes, which play an episode at a time.

    Episodes depend on the seed, the number of rounds played before and their place in the round,
    not on how fast a process is: after :meth:`set_generator_state` they are the same again.

    .. note:: The processes import the script that made them: as everywhere in multiprocessing, it
        needs ``if __name__ == "__main__":`` around what it does. Notebooks do not.

    Args:
        create_env (callable): makes an environment as :class:`EpisodeCollector` takes it; pickled.
        policy (TensorDictModule): reads ``"observation"``; its current parameters are sent to the
            processes before every round.

    Keyword Args:
        num_workers (int): processes. More give more frames a second, up to the number of cores,
            and play more episodes with one policy.
        max_steps (int): frames of the longest episode.
        seed (int): of all randomness in the processes, the policy's included. Default 0.
        compile_policy (bool): as for :class:`EpisodeCollector`, in every process.
        random_frames (int): rounds that begin before so many frames draw their actions from the
            action's bounds. Default 0.
        exploration_type (ExplorationType): default ``RANDOM``.

    Raises:
        RuntimeError: an environment or a policy failed in a process, or the process died.

    Examples:
        >>> from functools import partial
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> create_env = partial(GymEnv, "Pendulum-v1", max_episode_steps=7)
        >>> actor = make_actor(3, create_env().action_spec)
        >>> collector = MultiEpisodeCollector(create_env, actor, num_workers=2, max_steps=7)
        >>> [episode.shape for episode in collector.rollout()]
        [torch.Size([7]), torch.Size([7])]
        >>> collector.shutdown()
    """

    def __init__(
        self,
        create_env: Callable[[], EnvBase],
        policy: TensorDictModule,
        *,
        num_workers: int,
        max_steps: int,
        seed: int = 0,
        compile_policy: bool = False,
        random_frames: int = 0,
        exploration_type: ExplorationType = ExplorationType.RANDOM,
    ) -> None:
        # Python would wait for the processes to end before it ends itself.
        self._at_exit = partial(_shut_down, weakref.ref(self))
        atexit.register(self._at_exit)
        self._seed = seed
        self._rounds_played = 0
        super().__init__(
            [create_env] * num_workers,
            policy,
            frames_per_batch=max_steps * num_workers,
            total_frames=-1,
            init_random_frames=random_frames,
            exploration_type=exploration_type,
            collector_class=partial(_EpisodeWorker, compiled_policy=compile_policy),
            init_fn=_leave_signals_to_parent,
            update_at_each_batch=True,
            use_buffers=False,
            cat_results="stack",
            auto_register_policy_transforms=False,
        )
        self._rounds: Iterator[TensorDictBase] | None = None

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Ends the processes; nothing can be collected any more."""
        atexit.unregister(self._at_exit)
        super().shutdown(*args, **kwargs)

    def rollout(self) -> list[TensorDictBase]:
        """One episode of every process, as :meth:`EpisodeCollector.rollout` gives them."""
        entropy = np.random.SeedSequence([self._seed, self._rounds_played])
        self._rounds = self._rounds or iter(self)
        try:
            self.set_seed(int(entropy.generate_state(1)[0]))
            episodes = next(self._rounds).unbind(0)
        except (OSError, EOFError, ValueError) as error:
            # Pipes and process handles of one that died fail in their own ways.
            raise RuntimeError(
                f"a worker process died ({type(error).__name__}: {error})."
            ) from error
        self._rounds_played += 1
        return [episode.exclude("collector") for episode in episodes]

    def generator_state(self) -> dict[str, Any]:
        """What the following episodes depend on, but for the policy."""
        return {"rounds_played": self._rounds_played, "frames": self._frames}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`generator_state` gave."""
        self._rounds_played, self._frames = state["rounds_played"], state["frames"]


class _EpisodeWorker(EpisodeCollector):
    """What a process of :class:`MultiEpisodeCollector` runs."""

    def __init__(
        self,
        create_env: Callable[[], EnvBase],
        *,
        policy_factory: Callable[[], TensorDictModule],
        frames_per_batch: int,
        exploration_type: ExplorationType,
        compiled_policy: bool,
        **_: Any,
    ) -> None:
        torch.set_num_threads(1)
        super().__init__(
            create_env(),
            policy_factory(),
            frames_per_batch=frames_per_batch,
            compile_policy=compiled_policy,
            exploration_type=exploration_type,
        )
        self._use_buffers = False

    def reset(self, index: Tensor | None = None, **kwargs: Any) -> None:
        """The next episode resets the simulator by itself."""
        self._observation = None

    def rollout(self) -> TensorDictBase:
        # What the parent's message said: all of the round is random or none.
        self._random_frames_left = self.frames_per_batch if self.init_random_frames > 0 else 0
        episode = super().rollout()
        # The parent counts frames by this entry.
        return episode.set(("collector", "traj_ids"), torch.zeros(len(episode), dtype=torch.int64))


def _shut_down(collector: weakref.ref[MultiEpisodeCollector]) -> None:
    if (alive := collector()) is not None:
        alive.shutdown(raise_on_error=False)


def _leave_signals_to_parent() -> None:
    """Ctrl-C reaches all processes; the parent lets the episodes end and saves them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _parts(env: EnvBase) -> tuple[GymEnv, ObservationNoise | None]:
    """The simulator and its noise."""
    transforms: list = []
    simulator = env
    if isinstance(env, TransformedEnv):
        transforms, simulator = list(_flat(env.transform)), env.base_env
    if not isinstance(simulator, GymEnv) or simulator.batch_size:
        raise TypeError(
            f"EpisodeCollector takes one GymEnv, got {type(simulator).__name__} of batch size "
            f"{tuple(simulator.batch_size)}; use torchrl.collectors.Collector for any other."
        )
    if len(transforms) > 1 or not all(isinstance(t, ObservationNoise) for t in transforms):
        names = [type(t).__name__ for t in transforms]
        raise TypeError(
            f"EpisodeCollector takes no transform but one ObservationNoise, got {names}; use "
            "torchrl.collectors.Collector for any other."
        )
    return simulator, transforms[0] if transforms else None


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for inner in transform:
            yield from _flat(inner)
    else:
        yield transform


def _on_tensors(
    policy: TensorDictModule, keys: list[str], compile_policy: bool
) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """The policy as a function from an observation to the tensors it writes."""

    def act(observation: Tensor) -> tuple[Tensor, ...]:
        written = policy(TensorDict({"observation": observation}))
        return tuple(written.get(key) for key in keys)

    if not compile_policy:
        return act
    return compiled(act)
