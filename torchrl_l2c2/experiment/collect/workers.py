"""Several processes that play episodes at once, with one policy."""

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

from torchrl_l2c2.experiment.agents._torchrl_internals import end_weight_senders, keep_no_buffers
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.collect.episodes import EpisodeCollector
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.envs.environments import make_env, time_limit
from torchrl_l2c2.experiment.errors import ChildFailedError
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

# Between the seeds of a run's simulators: far enough for no run to have another's.
SEEDS_APART = 15_485_863


def make_collector(
    config: ExperimentConfig, env: EnvBase, agent: Agent, *, compile: bool
) -> EpisodeCollector | MultiEpisodeCollector | RolloutCollector:
    """What plays a run's episodes: this process, or as many others as the settings say."""
    options: dict[str, Any] = {
        "compile_policy": compile,
        "keep_previous": config.regularizer.reads_previous,
    }
    algorithm = config.algorithm
    if algorithm.num_envs is not None:
        seeds = (config.seed + SEEDS_APART * i for i in range(1, algorithm.num_envs))
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
        keep_previous (bool): as for :class:`EpisodeCollector`. Default ``False``.

    Raises:
        RuntimeError: an environment or a policy failed in a process.
        ChildFailedError: a process died.

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
        # Python would wait for the processes to end before it ends itself.
        self._at_exit = partial(_shut_down, weakref.ref(self))
        atexit.register(self._at_exit)
        self._seed = seed
        # A worker that fails leaves its error here: TorchRL says only that one has failed.
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
        """The state that the following episodes depend on, without the policy."""
        return {"rounds_played": self._rounds_played, "frames": self._frames}

    def set_generator_state(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`generator_state` gave."""
        self._rounds_played, self._frames = state["rounds_played"], state["frames"]

    def shutdown(self, *args: Any, **kwargs: Any) -> None:
        """Ends the processes; nothing can be collected any more."""
        atexit.unregister(self._at_exit)
        super().shutdown(*args, **kwargs)
        end_weight_senders(self)

    def rollout(self) -> list[TensorDictBase]:
        """One episode of every process, as :meth:`EpisodeCollector.rollout` gives them."""
        self._rounds = self._rounds or iter(self)
        try:
            self.set_seed(self._round_seed())
            episodes = next(self._rounds).unbind(0)
        except (OSError, EOFError, ValueError, RuntimeError) as error:
            # Pipes and process handles of one that died fail in their own ways.
            for path in Path(self._failures.name).iterdir():
                told, lines = json.loads(path.read_text())
                cause = RuntimeError(f"in the worker:\n{lines}")
                raise RuntimeError(f"a worker process died ({told}).") from cause
            told = f"{type(error).__name__}: {error}"
            raise ChildFailedError(f"a worker process died ({told}).") from error
        self._rounds_played += 1
        return [episode.exclude("collector") for episode in episodes]

    def _round_seed(self) -> int:
        entropy = np.random.SeedSequence([self._seed, self._rounds_played])
        return int(entropy.generate_state(1)[0])


class _EpisodeWorker(EpisodeCollector):
    """What a process of :class:`MultiEpisodeCollector` runs."""

    def __init__(
        self,
        create_env: Callable[[], EnvBase],
        *,
        policy_factory: Callable[[], TensorDictModule],
        frames_per_batch: int,
        exploration_type: ExplorationType,
        compiled_policy: bool,  # TorchRL has a compile_policy of its own, by torch.compile.
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
        keep_no_buffers(self)

    def rollout(self) -> TensorDictBase:
        # The parent sets it for a round that is to be random, all of it or nothing.
        self._random_frames_left = self.frames_per_batch if self.init_random_frames > 0 else 0
        try:
            episode = super().rollout()
        except Exception as error:
            if self._failures is not None:
                left = Path(self._failures, str(os.getpid()))
                told = f"{type(error).__name__}: {error}"
                left.write_text(json.dumps([told, traceback.format_exc()]))
            raise
        # The parent counts frames by this entry.
        return episode.set(("collector", "traj_ids"), torch.zeros(len(episode), dtype=torch.int64))


def _shut_down(collector: weakref.ref[MultiEpisodeCollector]) -> None:
    if (alive := collector()) is not None:
        alive.shutdown(raise_on_error=False)


def _leave_signals_to_parent() -> None:
    """Ctrl-C reaches all processes; the parent lets the episodes end and saves them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
