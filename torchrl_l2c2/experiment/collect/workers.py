"""Collectors for one simulator, several simulators, or several processes."""

from __future__ import annotations

import atexit
import json
import os
import signal
import tempfile
import traceback
import weakref
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import EnvBase, ExplorationType

from torchrl_l2c2.experiment.agents._torchrl_internals import (
    disable_buffers,
    shut_down_weight_senders,
)
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.envs.environments import make_env, time_limit
from torchrl_l2c2.experiment.errors import ChildFailedError
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

# Distance of the seeds of a run's simulators: large enough to differ from other runs' seeds.
SEED_STRIDE = 15_485_863


def make_collector(
    config: ExperimentConfig, env: EnvBase, agent: Agent, *, compile: bool
) -> EpisodeCollector | MultiEpisodeCollector | RolloutCollector:
    """Creates the collector of a run.

    Args:
        config (ExperimentConfig): Settings of the run.
        env (EnvBase): Environment of the task, which several processes do not use.
        agent (Agent): Agent whose policy acts.

    Keyword Args:
        compile (bool): Whether to compile the policy.
    """
    options: dict[str, Any] = {
        "compile_policy": compile,
        "keep_previous": config.regularizer.reads_previous,
    }
    algorithm = config.algorithm
    if algorithm.num_envs is not None:
        seeds = (config.seed + SEED_STRIDE * i for i in range(1, algorithm.num_envs))
        envs = [env, *(make_env(config.task, seed) for seed in seeds)]
        return RolloutCollector(envs, agent.policy, frames_per_batch=algorithm.frames, **options)
    options["random_frames"] = algorithm.random_frames
    if config.num_workers == 1:
        frames = 1 if algorithm.schedule == "step" else time_limit(config.task)
        return EpisodeCollector(env, agent.policy, frames_per_batch=frames, **options)
    return MultiEpisodeCollector(
        partial(make_env, config.task, config.seed),
        agent.policy,
        num_workers=config.num_workers,
        max_steps=time_limit(config.task),
        seed=config.seed,
        **options,
    )


class MultiEpisodeCollector(MultiSyncCollector):
    """Several processes with an :class:`EpisodeCollector` each, which play one episode per round.

    Episodes depend on the seed, the round and the process's index, not on timing. They are
    reproducible after :meth:`set_generator_state`.

    .. note:: The processes import the script that created them. As always with multiprocessing,
        scripts need ``if __name__ == "__main__":``. Notebooks do not.

    Args:
        create_env (callable): Function without arguments that returns an environment for
            :class:`EpisodeCollector`. It must be picklable.
        policy (TensorDictModule): Policy that reads ``"observation"``. Its current parameters are
            sent to the processes before every round.

    Keyword Args:
        num_workers (int): Number of processes. More processes play more frames per second, up to
            the number of cores, and more episodes with the same policy.
        max_steps (int): Maximum frames per episode.
        seed (int): Seed of all random numbers in the processes, including the policy's. Default 0.
        compile_policy (bool): Whether to compile the policy in every process, as for
            :class:`EpisodeCollector`. Default ``False``.
        random_frames (int): Number of first frames with actions sampled uniformly from their
            bounds. A round that starts before this number is entirely random. Default 0.
        exploration_type (ExplorationType): Exploration type of the policy. Default ``RANDOM``.
        keep_previous (bool): Whether frames contain the previous observation, as for
            :class:`EpisodeCollector`. Default ``False``.

    Raises:
        RuntimeError: If an environment or a policy fails in a process.
        ChildFailedError: If a process dies.

    Examples:
        >>> from functools import partial
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_l2c2 import make_actor
        >>> create_env = partial(GymEnv, "Pendulum-v1", max_episode_steps=7)
        >>> actor = make_actor(3, create_env().action_spec)
        >>> def play():
        ...     collector = MultiEpisodeCollector(create_env, actor, num_workers=2, max_steps=7)
        ...     episodes = collector.rollout()
        ...     collector.shutdown()
        ...     return [episode.shape for episode in episodes]
        >>> play()  # doctest: +SKIP
        [torch.Size([7]), torch.Size([7])]
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
        keep_previous: bool = False,
    ) -> None:
        # Otherwise Python would wait for the processes at exit.
        self._at_exit = partial(_shut_down, weakref.ref(self))
        atexit.register(self._at_exit)
        self._seed = seed
        # Failing workers store their errors here; TorchRL reports only that a worker failed.
        self._failures = tempfile.TemporaryDirectory()
        super().__init__(
            [create_env] * num_workers,
            policy,
            frames_per_batch=max_steps * num_workers,
            total_frames=-1,
            init_random_frames=random_frames,
            exploration_type=exploration_type,
            collector_class=partial(
                _EpisodeWorker,
                compiled_policy=compile_policy,
                keep_previous=keep_previous,
                failures=self._failures.name,
            ),
            init_fn=_leave_signals_to_parent,
            update_at_each_batch=True,
            use_buffers=False,
            cat_results="stack",
            auto_register_policy_transforms=False,
        )
        self._rounds: Iterator[TensorDictBase] | None = None
        self._rounds_played = 0

    def generator_state(self) -> dict[str, Any]:
        """Returns the state that determines the next episodes, except for the policy."""
        return {"rounds_played": self._rounds_played, "frames": self._frames}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`generator_state`."""
        self._rounds_played, self._frames = state["rounds_played"], state["frames"]

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Ends the processes. The collector cannot be used afterwards."""
        atexit.unregister(self._at_exit)
        super().shutdown(*args, **kwargs)
        shut_down_weight_senders(self)

    def rollout(self) -> list[TensorDictBase]:
        """Plays one episode in every process, as :meth:`EpisodeCollector.rollout`."""
        self._rounds = self._rounds or iter(self)
        try:
            self.set_seed(self._round_seed())
            episodes = next(self._rounds).unbind(0)
        except (OSError, EOFError, ValueError, RuntimeError) as error:
            # Pipes and handles of a dead process raise different errors.
            for path in Path(self._failures.name).iterdir():
                message, lines = json.loads(path.read_text())
                cause = RuntimeError(f"in the worker:\n{lines}")
                raise RuntimeError(f"a worker process died ({message}).") from cause
            message = f"{type(error).__name__}: {error}"
            raise ChildFailedError(f"a worker process died ({message}).") from error
        self._rounds_played += 1
        return [episode.exclude("collector") for episode in episodes]

    def _round_seed(self) -> int:
        entropy = np.random.SeedSequence([self._seed, self._rounds_played])
        return int(entropy.generate_state(1)[0])


class _EpisodeWorker(EpisodeCollector):
    """Collector in a process of :class:`MultiEpisodeCollector`."""

    def __init__(
        self,
        create_env: Callable[[], EnvBase],
        *,
        policy_factory: Callable[[], TensorDictModule],
        frames_per_batch: int,
        exploration_type: ExplorationType,
        compiled_policy: bool,  # TorchRL's compile_policy means torch.compile.
        keep_previous: bool,
        failures: str | None = None,
        **_: Any,
    ) -> None:
        torch.set_num_threads(1)
        self._failures = failures
        super().__init__(
            create_env(),
            policy_factory(),
            frames_per_batch=frames_per_batch,
            compile_policy=compiled_policy,
            exploration_type=exploration_type,
            keep_previous=keep_previous,
        )
        disable_buffers(self)

    def rollout(self) -> TensorDictBase:
        # The parent sets init_random_frames for a random round; a round is random as a whole.
        self._random_frames_left = self.frames_per_batch if self.init_random_frames > 0 else 0
        try:
            episode = super().rollout()
        except Exception as error:
            if self._failures is not None:
                file = Path(self._failures, str(os.getpid()))
                message = f"{type(error).__name__}: {error}"
                file.write_text(json.dumps([message, traceback.format_exc()]))
            raise
        # The parent counts frames with this entry.
        return episode.set(("collector", "traj_ids"), torch.zeros(len(episode), dtype=torch.int64))


def _shut_down(collector: weakref.ref[MultiEpisodeCollector]) -> None:
    if (alive := collector()) is not None:
        alive.shutdown(raise_on_error=False)


def _leave_signals_to_parent() -> None:
    """Ignores Ctrl-C, which reaches all processes: the parent finishes and saves the episodes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
