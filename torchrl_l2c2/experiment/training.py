"""One run of the experiment: collect, replay, update, log; then test and report."""

from __future__ import annotations

import contextlib
import json
import random
import signal
import statistics
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule
from tqdm import tqdm

from torchrl_l2c2.experiment.agents import is_loss, make_agent, make_update
from torchrl_l2c2.experiment.checkpoints import (
    CheckpointError,
    global_rng_state,
    list_checkpoints,
    load_newest,
    load_replay_state,
    replay_state,
    save_checkpoint,
    set_global_rng_state,
)
from torchrl_l2c2.experiment.collection import EpisodeCollector, MultiEpisodeCollector
from torchrl_l2c2.experiment.compilation import compiler_available
from torchrl_l2c2.experiment.config import ExperimentConfig
from torchrl_l2c2.experiment.environments import TEST_SEED, make_env
from torchrl_l2c2.experiment.evaluate import Evaluation, evaluate_policy, play_test_episode
from torchrl_l2c2.experiment.files import make_folder, write_atomically, write_json
from torchrl_l2c2.experiment.metrics_log import MetricsLog
from torchrl_l2c2.experiment.replay import ReplayUpdate, make_replay, scale_reward
from torchrl_l2c2.experiment.reports import FinishedRun, draw_learning_curves
from torchrl_l2c2.metrics import action_variation

VERSIONED = ("torchrl-l2c2", "torch", "torchrl", "tensordict", "gymnasium", "pybullet", "numpy")


class Experiment:
    """One run of the paper's experiment, in the order in which things happen.

    Args:
        config (ExperimentConfig): every setting. Default: the paper's L2C2 on Swingup.
        folder (str or Path, optional): where results are written; ``None`` writes nothing. Where
            it holds a checkpoint of the same run, the run continues from it.

    Keyword Args:
        resume (str or Path, optional): another run's folder to continue from, in ``folder``.

    Raises:
        ValueError: a setting that cannot be, or that differs from the checkpoint's.
        CheckpointError: there are checkpoints, but none can be read.
        OSError: a folder that cannot be written to.

    Examples:
        >>> from torchrl_l2c2.experiment import Experiment, ExperimentConfig, TaskConfig
        >>> task = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=20)
        >>> experiment = Experiment(ExperimentConfig(task=task, compile=False))
        >>> metrics = experiment.train()
        >>> [row["frames"] for row in metrics]
        [20, 40]
        >>> len(experiment.test(episodes=3).returns)
        3
    """

    def __init__(
        self,
        config: ExperimentConfig | None = None,
        folder: str | Path | None = None,
        *,
        resume: str | Path | None = None,
    ) -> None:
        self.config = config or ExperimentConfig()
        self.folder = None if folder is None else make_folder(folder)
        torch.set_num_threads(self.config.threads)
        seed_everything(self.config.seed)

        self.env = make_env(self.config.task, self.config.seed)
        self.agent = make_agent(self.config, self.env)
        self.replay = make_replay(self.config)
        self._compile = self.config.compile and compiler_available()
        self.update = self._make_update()
        self.collector = self._make_collector()
        self.metrics: list[dict[str, float]] = []
        self.frames = 0
        self.updates = 0
        self.skipped_updates = 0
        self._first_update_seconds: float | None = None
        self._late_tester: EpisodeCollector | None = None
        self._log = MetricsLog(self.folder, tensorboard=self.config.logger.name == "tensorboard")
        self._resume(resume)
        if self.folder is not None:
            write_json(self.folder / "config.json", self.config.to_dict())
            write_json(self.folder / "versions.json", versions())

    def train(self, *, progress: bool = False) -> list[dict[str, float]]:
        """Trains for the task's episodes, from where a checkpoint left off.

        SIGTERM and SIGINT end the training after the episode that is being played, with a
        checkpoint; a second one ends it at once.

        Args:
            progress (bool): whether to show a progress bar.

        Returns:
            list: a dictionary of metrics per episode.

        Raises:
            FloatingPointError: NaN or infinity in what the environment gave, in a loss or in a
                gradient; names the key and the step, and the last good checkpoint.
            SimulatorError: the environment failed; names the frame and the last good checkpoint.
            Interrupted: a signal ended the training.
        """
        started, first_frame = time.monotonic(), self.frames
        total, done = self.config.task.episodes, len(self.metrics)
        bar = tqdm(total=total, initial=done, unit="episode", disable=not progress)
        compiling = progress and self._compile and self.agent.compilable
        if compiling:
            bar.set_postfix_str("compiling at the first updates, up to two minutes")
        saved = time.monotonic()
        with bar, stop_on_signals() as signals:
            while len(self.metrics) < total:
                for row in self._play_round():
                    seconds = time.monotonic() - started
                    row["frames_per_second"] = (self.frames - first_frame) / seconds
                    self.metrics.append(row)
                    self._log.write(row)
                    bar.update()
                if compiling and self._first_update_seconds is not None:
                    compiling = False
                    bar.write(f"compiled within {self._first_update_seconds:.0f} s", sys.stderr)
                bar.set_postfix_str(describe(self.metrics[-10:]))
                ended = len(self.metrics) == total
                if ended or signals or time.monotonic() - saved > self.config.checkpoint_interval:
                    self.save()
                    saved = time.monotonic()
                if signals and not ended:
                    raise Interrupted(signals[0], len(self.metrics), self.folder)
        return self.metrics

    def save(self) -> Path | None:
        """Writes a checkpoint of everything that the rest of the run depends on."""
        if self.folder is None:
            return None
        for name, parameter in self.agent.loss.named_parameters():
            if not parameter.isfinite().all():
                raise FloatingPointError(
                    f"{name} is not finite after update {self.updates}: a gradient was not. "
                    f"{self._last_checkpoint()}"
                )
        return save_checkpoint(
            self.folder, len(self.metrics), self.state_dict(), self.config.checkpoint_keep
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on, between two episodes."""
        return {
            "config": json.dumps(self.config.to_dict()),
            "loss": self.agent.loss.state_dict(),
            "optimizer": self.agent.optimizer.state_dict(),
            "target_updater": _state_of(self.agent.target_updater),
            "exploration": _state_of(self.agent.exploration),
            "replay": replay_state(self.replay),
            "collector": self.collector.generator_state(),
            "global_rng": global_rng_state(),
            "counters": [self.frames, self.updates, self.skipped_updates],
            "metrics": json.dumps(self.metrics),
            "metrics_log": self._log.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave.

        Raises:
            ValueError: the state is of a run with other settings.
        """
        check_same_settings(json.loads(state["config"]), self.config.to_dict())
        self.agent.loss.load_state_dict(state["loss"])
        self.agent.optimizer.load_state_dict(state["optimizer"])
        for part in ("target_updater", "exploration"):
            if state[part] is not None:
                getattr(self.agent, part).load_state_dict(state[part])
        load_replay_state(self.replay, state["replay"])
        self.collector.set_generator_state(state["collector"])
        self.frames, self.updates, self.skipped_updates = state["counters"]
        self.metrics = json.loads(state["metrics"])
        self._log.load_state_dict(state["metrics_log"])
        # A compiled update is made for the tensors that were there, and some are others now.
        self.update = self._make_update()
        # Last: making and loading the above may have drawn from the global generators.
        set_global_rng_state(state["global_rng"])

    def _resume(self, elsewhere: str | Path | None) -> None:
        # The folder's own checkpoint first: the same command again continues what it began.
        found = None if self.folder is None else load_newest(self.folder)
        if found is None and elsewhere is not None:
            found = load_newest(elsewhere)
            if found is None:
                raise CheckpointError(f"resume={str(elsewhere)!r} holds no checkpoint_*.pt.")
            if self.folder is not None:
                log = (Path(elsewhere) / "metrics.csv").read_bytes()
                write_atomically(self.folder / "metrics.csv", log)
        if found is None:
            return
        path, state, damaged = found
        for message in damaged:
            warnings.warn(f"{message} The one before it is used.", stacklevel=3)
        self.load_state_dict(state)
        print(f"continuing after episode {len(self.metrics)} from {path}", file=sys.stderr)

    def _play_round(self) -> Iterator[dict[str, float]]:
        """The episodes of one round, with the updates that belong to each; their metrics."""
        if self.config.algorithm.schedule == "step":
            yield self._learn_by_step()
            return
        episodes = self._collect()
        # Of the policy that played them: the updates come after the episodes.
        smoothness = [self._smoothness(episode) for episode in episodes]
        for episode in episodes:
            self.replay.extend(self._remembered(episode))
        for episode, measured in zip(episodes, smoothness, strict=True):
            self._count(episode)
            terms: list[torch.Tensor] = []
            self._updates_after_episode(episode.numel(), terms)
            yield self._row(episode, measured, terms)

    def _learn_by_step(self) -> dict[str, float]:
        """One episode with updates after every frame; its metrics."""
        frames: list[TensorDictBase] = []
        terms: list[torch.Tensor] = []
        while not frames or not frames[-1]["next", "done"][-1]:
            (frame,) = self._collect()
            frames.append(frame)
            self._count(frame)
            self.replay.extend(self._remembered(frame))
            self._replay_updates(self.config.algorithm.updates or 1, terms)
        episode = torch.cat(frames)
        return self._row(episode, self._smoothness(episode), terms)

    def _count(self, batch: TensorDictBase) -> None:
        self.frames += batch.numel()
        if isinstance(self.agent.exploration, EGreedyModule):
            self.agent.exploration.step(batch.numel())

    def _row(
        self, episode: TensorDictBase, smoothness: dict[str, float], terms: list[torch.Tensor]
    ) -> dict[str, float]:
        return {
            "episode": len(self.metrics) + 1,
            "frames": self.frames,
            "updates": self.updates,
            "skipped_updates": self.skipped_updates,
            "return": episode["next", "reward"].sum().item(),
            **smoothness,
            "length": episode.numel(),
            **self._late_test(),
            **self._mean_terms(terms),
        }

    def test(self, episodes: int | None = None, *, progress: bool = False) -> Evaluation:
        """Plays test episodes with the policy's mean, in a fresh environment with its own seed.

        Args:
            episodes (int, optional): how many. Default: the settings' ``test_episodes``.
            progress (bool): whether to show a progress bar.

        Returns:
            Evaluation: give it to :meth:`finish` to have it written.
        """
        env = make_env(self.config.task, self.config.seed + TEST_SEED)
        result = evaluate_policy(
            self.agent.policy,
            env,
            episodes or self.config.test_episodes,
            max_steps=self.config.task.max_steps,
            compile_policy=self._compile,
            progress=progress,
        )
        env.close()
        return result

    def finish(self, result: Evaluation) -> FinishedRun:
        """Writes what a finished run's folder holds: policy, test episodes and picture.

        Args:
            result (Evaluation): of :meth:`test`.

        Returns:
            FinishedRun: the folder, read back.

        Raises:
            ValueError: the experiment was made without a folder.
        """
        if self.folder is None:
            raise ValueError("this experiment has no folder to write to; give it one when made.")
        save_policy(self.agent.policy, self.folder / "policy.pt")
        config = self.config
        write_json(
            self.folder / "evaluation.json",
            {
                "run": {
                    "task": config.task.name,
                    "algorithm": config.algorithm.name,
                    "regularizer": config.regularizer.name,
                    "seed": config.seed,
                    "solved_at": config.task.solved_at,
                },
                "summary": result.summary(),
                "episodes": asdict(result),
            },
        )
        run = FinishedRun.read(self.folder)
        draw_learning_curves([run], self.folder / "learning_curves.png")
        return run

    def close(self) -> None:
        """Ends the processes of ``num_workers``; the experiment cannot train any further."""
        self.collector.shutdown()
        if self._late_tester is not None:
            self._late_tester.shutdown()

    def _make_update(self) -> Callable[..., tuple[torch.Tensor, torch.Tensor | None] | None]:
        options = {"compile": self._compile, "skip_nonfinite": self.config.on_nonfinite == "skip"}
        if self.config.algorithm.schedule == "rollout":
            return make_update(self.agent, **options)
        return ReplayUpdate(self.agent, self.replay, **options)

    def _make_collector(self) -> EpisodeCollector | MultiEpisodeCollector:
        config = self.config
        options: dict[str, Any] = {
            # Modules that only explore take decisions that cannot be compiled.
            "compile_policy": self._compile and self.agent.exploration is None,
            "random_frames": self._random_frames,
        }
        if config.num_workers > 1:
            return MultiEpisodeCollector(
                partial(make_env, config.task, config.seed),
                self.agent.policy,
                num_workers=config.num_workers,
                max_steps=config.task.max_steps,
                seed=config.seed,
                **options,
            )
        by_step = config.algorithm.schedule == "step"
        frames = 1 if by_step else config.task.max_steps
        return EpisodeCollector(self.env, self.agent.policy, frames_per_batch=frames, **options)

    def _collect(self) -> list[TensorDictBase]:
        """One episode of every worker, or the next frame of the one that is being played."""
        try:
            played = self.collector.rollout()
            batches = played if isinstance(played, list) else [played]
            first_frame = self.frames
            for batch in batches:
                check_finite(batch, first_frame)
                first_frame += batch.numel()
        except FloatingPointError as error:
            raise FloatingPointError(f"{error} {self._last_checkpoint()}") from None
        except Exception as error:
            raise SimulatorError(
                f"{self.config.task.env_id} failed after frame {self.frames}: "
                f"{type(error).__name__}: {error} {self._last_checkpoint()}"
            ) from error
        return batches

    @property
    def _random_frames(self) -> int:
        return getattr(self.config.algorithm, "random_frames", 0)

    @torch.no_grad()
    def _remembered(self, batch: TensorDictBase) -> TensorDictBase:
        """The entries that the loss reads, and no others: sampling copies every one of them."""
        batch = scale_reward(batch, self.config.algorithm)
        if self.agent.advantage is not None:
            batch = self.agent.advantage(batch)
        return batch.select(*self.agent.loss.in_keys, strict=False)

    def _updates_per_episode(self, frames: int) -> int:
        """As many as the settings say; fractions of an update are made up for later."""
        algorithm, batch = self.config.algorithm, self.config.replay.batch_size
        if algorithm.updates is not None:
            return algorithm.updates
        ratio = getattr(algorithm, "replay_ratio", None)
        if ratio is None:
            return len(self.replay) // batch
        return int(ratio * self.frames / batch) - int(ratio * (self.frames - frames) / batch)

    def _updates_after_episode(self, frames: int, terms: list[torch.Tensor]) -> None:
        algorithm = self.config.algorithm
        if algorithm.schedule == "episode":
            self._replay_updates(self._updates_per_episode(frames), terms)
        elif len(self.replay) >= algorithm.frames:
            for _ in range(algorithm.epochs):
                for batch in self.replay:
                    self._one_update(terms, batch)
            self.replay.empty()

    def _replay_updates(self, count: int, terms: list[torch.Tensor]) -> None:
        if len(self.replay) < self.config.replay.batch_size or self.frames < self._random_frames:
            return
        for _ in range(count):
            self._one_update(terms)

    def _one_update(self, terms: list[torch.Tensor], *batch: TensorDictBase) -> None:
        """An update with a batch, or with one of the update's own from the replay buffer."""
        with_policy = (self.updates + 1) % self.agent.policy_delay == 0
        started = time.monotonic()
        result = self.update(with_policy, *batch)
        if self._first_update_seconds is None:
            self._first_update_seconds = time.monotonic() - started
        if result is None:
            self.skipped_updates += 1
            return
        self.updates += 1
        terms.append(result[0])

    def _mean_terms(self, terms: list[torch.Tensor]) -> dict[str, float]:
        """The mean of every entry of the loss over an episode's updates.

        A ``share_*`` is the part that a term has of the sum of all terms' sizes: it says at a
        glance whether a regularizer is on, and how much of the loss it is.
        """
        keys = self.agent.loss.out_keys
        if not terms:
            values = torch.full((len(keys),), float("nan"))
        else:
            values = torch.stack(terms)
            self._check_terms(values)
            values = values.mean(0)
        means = dict(zip(keys, values.tolist(), strict=True))
        losses = {k: abs(v) for k, v in means.items() if is_loss(k)}
        total = sum(losses.values())
        shares = {
            k.replace("loss", "share"): v / total if total else 0.0 for k, v in losses.items()
        }
        return {**means, **shares}

    def _check_terms(self, values: torch.Tensor) -> None:
        bad = ~values.isfinite()
        if bad.any():
            step, column = bad.nonzero()[0].tolist()
            raise FloatingPointError(
                f"{self.agent.loss.out_keys[column]} is {values[step, column].item()} at update "
                f"{self.updates - len(values) + step + 1} (frame {self.frames}). "
                f"{self._last_checkpoint()}"
            )

    def _last_checkpoint(self) -> str:
        paths = list_checkpoints(self.folder) if self.folder is not None else []
        return f"Last good checkpoint: {paths[0] if paths else 'none was written yet'}."

    @torch.no_grad()
    def _smoothness(self, episode: TensorDictBase) -> dict[str, float]:
        """Of the policy's mean, at the states of an episode in which it explored.

        With the mean scale of a stochastic policy: the Hellinger distance is relative to it, so a
        policy can satisfy L2C2 by becoming wider.
        """
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = self.agent.policy(episode.select("observation"))
        mean, scale = written["action"].float(), written.get("scale", None)
        return {
            "action_variation": action_variation(mean).item() if len(mean) > 1 else 0.0,
            "policy_scale": float("nan") if scale is None else scale.mean().item(),
        }

    def _late_test(self) -> dict[str, float]:
        """One test episode of the policy as it is now, in the last part of training."""
        row = {"test_return": float("nan"), "test_action_variation": float("nan")}
        number, total = len(self.metrics) + 1, self.config.task.episodes
        if number <= round(total * (1.0 - self.config.late_share)):
            return row
        # Seeded by its number, and outside the run's own randomness: whether and when it is played
        # changes nothing else.
        before = global_rng_state()
        if self._late_tester is None:
            self._late_tester = self._make_tester()
        self._late_tester.set_seed(self.config.seed + TEST_SEED + number)
        result = play_test_episode(self._late_tester)
        set_global_rng_state(before)
        return dict(zip(row, result[:2], strict=True))

    def _make_tester(self) -> EpisodeCollector:
        return EpisodeCollector(
            make_env(self.config.task, self.config.seed + TEST_SEED),
            self.agent.policy,
            frames_per_batch=self.config.task.max_steps,
            compile_policy=self._compile,
            exploration_type=ExplorationType.DETERMINISTIC,
        )


def _state_of(part: Any) -> dict[str, Any] | None:
    return None if part is None else part.state_dict()


class SimulatorError(RuntimeError):
    """The environment or the policy in it raised an error; the cause is chained."""


class Interrupted(Exception):
    """A signal ended the training; a checkpoint was written."""

    def __init__(self, signal_number: int, episode: int, folder: Path | None) -> None:
        name = signal.Signals(signal_number).name
        super().__init__(
            f"{name} ended the training after episode {episode}; the same command continues it "
            f"from {folder}."
        )
        self.exit_status = 128 + signal_number


@contextlib.contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list instead of dying; a second one acts as usual."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def receive(number: int, frame: Any) -> None:
        received.append(number)
        restore()

    previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    for number in previous:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        restore()


def finished_run(folder: str | Path, config: ExperimentConfig) -> FinishedRun | None:
    """The finished run of these very settings in a folder; ``None`` where there is none."""
    folder = Path(folder)
    if not (folder / "evaluation.json").exists():
        return None
    saved = json.loads((folder / "config.json").read_text())
    # As JSON, where a tuple and a list are the same.
    return FinishedRun.read(folder) if saved == json.loads(json.dumps(config.to_dict())) else None


# What may differ between a run and its continuation: it changes none of the numbers.
FREE_SETTINGS = {"test_episodes", "late_share", "threads", "checkpoint_interval", "checkpoint_keep"}
# More episodes are a longer run of the same kind.
FREE_TASK_SETTINGS = {"episodes", "solved_at"}


def check_same_settings(saved: dict[str, Any], now: dict[str, Any]) -> None:
    """Refuses to continue a run with settings that would change its numbers.

    Raises:
        ValueError: names the first setting that differs, with both values.
    """
    for key in (key for key in saved if key not in FREE_SETTINGS):
        pairs = {key: (saved[key], now.get(key))}
        if isinstance(saved[key], dict):
            names = {*saved[key], *now[key]} - (FREE_TASK_SETTINGS if key == "task" else set())
            pairs = {
                f"{key}.{name}": (saved[key].get(name), now[key].get(name))
                for name in sorted(names)
            }
        for name, (was, is_now) in pairs.items():
            # As JSON, where a tuple and a list are the same.
            if json.dumps(was) != json.dumps(is_now):
                raise ValueError(
                    f"this folder's checkpoint was made with {name}={was}, not {is_now}: choose "
                    "another folder with outputs=FOLDER, or delete this one. Nothing was changed."
                )


def seed_everything(seed: int) -> None:
    """Seeds Python, NumPy and PyTorch; environments and transforms have generators of their own."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def check_finite(batch: TensorDictBase, first_frame: int) -> None:
    """Stops at the first NaN or infinity that the environment gave.

    Raises:
        FloatingPointError: names the key and the frame.
    """
    for key in ("observation", ("next", "observation"), ("next", "reward")):
        bad = ~batch[key].isfinite()
        if bad.any():
            step = int(bad.flatten(1).any(1).nonzero()[0])
            value = batch[key][step].flatten().tolist()
            raise FloatingPointError(
                f"{key} is not finite at frame {first_frame + step}: {value}. "
                "The environment gave it; nothing was learned from this episode."
            )


def save_policy(policy: torch.nn.Module, path: Path) -> None:
    """Writes the policy's ``state_dict``; read it with ``torch.load(path, weights_only=True)``."""
    import io

    content = io.BytesIO()
    torch.save({k: v.detach().clone() for k, v in policy.state_dict().items()}, content)
    write_atomically(path, content.getvalue())


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers."""
    found = {}
    for name in VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def describe(rows: list[dict[str, float]]) -> str:
    """The progress bar's words: means over the latest episodes, and the speed."""
    mean = {k: statistics.fmean(row[k] for row in rows) for k in ("return", "action_variation")}
    return (
        f"return {mean['return']:.1f}, action variation {mean['action_variation']:.3f}, "
        f"{rows[-1]['frames_per_second']:.0f} frames/s"
    )
