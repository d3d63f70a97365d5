"""A run of the experiment: training, checkpoints and tests."""

from __future__ import annotations

import json
import time
import warnings
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.agents._torchrl_internals import load_replay_state, replay_state
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.agents.optimizers import anneal
from torchrl_l2c2.experiment.collect.player import Episode, Player, make_collector
from torchrl_l2c2.experiment.envs.environments import TEST_SEED, action_range, make_env
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.learn.compilation import compiler_available
from torchrl_l2c2.experiment.learn.learner import Learner, untrained_reason
from torchrl_l2c2.experiment.learn.replay import make_replay
from torchrl_l2c2.experiment.run.best_policy import BestPolicy
from torchrl_l2c2.experiment.run.checkpoints import save_checkpoint
from torchrl_l2c2.experiment.run.continuation import (
    add_checkpoint_to_errors,
    check_length,
    check_same_actions,
    check_same_settings,
    find_checkpoint,
)
from torchrl_l2c2.experiment.run.evaluation import Evaluation, LateTests, evaluate_task
from torchrl_l2c2.experiment.run.files import make_folder
from torchrl_l2c2.experiment.run.finished import FinishedRun, write_evaluation
from torchrl_l2c2.experiment.run.folder import prepare_folder, versions
from torchrl_l2c2.experiment.run.gain_schedule import GainControl
from torchrl_l2c2.experiment.run.lock import lock_folder
from torchrl_l2c2.experiment.run.metrics_log import MetricsLog, check_installed
from torchrl_l2c2.experiment.run.policies import save_policy
from torchrl_l2c2.experiment.run.process import ProcessState
from torchrl_l2c2.experiment.run.progress import Progress, show_and_log
from torchrl_l2c2.experiment.run.schedules import SCHEDULES
from torchrl_l2c2.experiment.run.signals import Interrupted, stop_on_signals
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.tasks import Budget


class Experiment:
    """A run of the paper's experiment.

    Training and tests use their own random generators and number of threads. The state of the
    process is restored afterwards.

    Args:
        config (ExperimentConfig, optional): Settings of the run. Default: the paper's L2C2 on
            Swingup.
        folder (str or Path, optional): Run folder. If it has a checkpoint of the same run, the run
            continues from it. Default: nothing is written.

    Keyword Args:
        allow_other_versions (bool): Whether to continue runs of other versions of PyTorch, TorchRL
            or a simulator, with a warning. The numbers may then differ from an uninterrupted run.
            Default ``False``.

    Attributes:
        agent: Agent that is trained.
        player: Player of the episodes, which counts frames.
        learner: Learner, which stores transitions, updates the agent and counts updates.
        metrics: List with a dictionary of metrics per episode.

    Raises:
        ValueError: If a setting is invalid or differs from the checkpoint.
        CheckpointError: If all checkpoints are damaged.
        OSError: If the folder cannot be written to.
        FolderInUseError: If another process uses the folder.

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
        allow_other_versions: bool = False,
    ) -> None:
        if not isinstance(config, ExperimentConfig | None):
            raise TypeError(
                f"config must be an ExperimentConfig, got a {type(config).__name__}: "
                "ExperimentConfig(seed=1) is one."
            )
        self.config = config = config or ExperimentConfig()
        self.folder = None if folder is None else Path(folder)
        check_installed(config.logger.name)
        self._log, self._unlock = MetricsLog(None), lambda: None  # Until the folder exists.
        self._compile = config.compile and compiler_available()
        self._process = ProcessState(config.seed, config.threads)
        with self._process:
            env = make_env(config.task, config.seed)
            self._actions = action_range(env)
            self.agent = make_agent(config, env)
            self.learner = Learner(
                self.agent,
                make_replay(config, self.agent.loss),
                reward_factor=config.algorithm.reward_factor,
                compile=self._compile,
            )
            collector = make_collector(config, env, self.agent, compile=self._compile)
            self.player = Player(collector, self.agent, config.task.env_id)
        self.metrics: list[dict[str, float]] = []
        self._closed = False
        self._late_tests = LateTests(config.task, config.seed, self.agent.policy, self._compile)
        try:
            self._best_policy = BestPolicy(config, self.agent.policy, self.folder)
            self._gain = GainControl(config, self.learner)
            if self.folder is not None:
                self._start(self.folder, allow_other_versions)
        except BaseException:
            self.close()
            raise

    def train(
        self, episodes: int | None = None, *, progress: bool | str = False
    ) -> list[dict[str, float]]:
        """Trains, or continues the training.

        SIGTERM and SIGINT end the training with a checkpoint after the current episode or rollout.
        A second signal ends it at once.

        Args:
            episodes (int, optional): Total length of training in episodes, also written to
                ``config.json``. Default: the task's episodes or frames.

        Keyword Args:
            progress (bool or str): Whether to show a progress bar; a text is shown before it.
                Default ``False``.

        Returns:
            list: A dictionary of metrics per episode.

        Raises:
            ValueError: If the experiment was closed.
            FloatingPointError: If the environment, the policy, a loss or a parameter has NaN or
                infinity; states where, and the last good checkpoint.
            SimulatorError: If the environment fails; states the frame and the last good checkpoint.
            OSError: If a file cannot be written, for example on a full disk; states the file and
                the last good checkpoint.
            OtherRunError: If the run already has more episodes, or another Experiment has written
                to the folder.
            Interrupted: If a signal arrived during the training, which ends after the episode.

        Warns:
            UserWarning: If no update was made or all actions were random, or the regularizer's
                gradients are too small for any effect.
        """
        self._check_open()
        task = self.config.task if episodes is None else self.config.task.for_episodes(episodes)
        full, budget = self.config.task.budget, task.budget
        check_length(budget, full, self._spent(budget))
        full = full.at_least(budget)  # This call may train only a part of it.
        algorithm, saved = self.config.algorithm, time.monotonic()
        schedule = SCHEDULES[algorithm.schedule](self.player, self.learner, algorithm)
        bar = Progress(
            budget.total,
            self._spent(budget),
            self.player.frames,
            shown=progress,
            compiles=self.learner.compiles and not self.learner.updates,
            unit=budget.unit,
            folder=self.folder,
        )
        ended = self._ended(budget)
        if self.folder is not None:
            settings = replace(self.config, task=task).to_dict()
            self._log.check_unchanged()
            prepare_folder(self.folder, settings, resumed=True, ended=ended)
        with (
            self._process,
            closing(bar),
            stop_on_signals(saves=self.folder is not None) as signals,
            add_checkpoint_to_errors(self.folder),
        ):
            # If the length has changed, the learning rate differs from its last value.
            anneal(self.config.optimizer, self.agent.optimizer, self._spent(full) / full.total)
            while not ended:
                episode = next(schedule)
                if episode is None:
                    counts = {"episode": len(self.metrics), "frames": self.player.frames}
                    self._gain.after(counts, full)
                else:
                    self._record(episode, full, bar)
                anneal(self.config.optimizer, self.agent.optimizer, self._spent(full) / full.total)
                if episode is not None and not episode.ends_round:
                    continue
                ended = self._ended(budget)
                overdue = time.monotonic() - saved > self.config.checkpoint_interval
                if ended or signals or overdue:
                    self.save()
                    saved = time.monotonic()
                if signals:
                    break
            if signals:  # Also in the last episode: its tests, and the next runs of a sweep, wait.
                raise Interrupted(signals[0], len(self.metrics), self.folder)
        if problem := self._untrained():
            warnings.warn(problem, stacklevel=2)
        return self.metrics

    def save(self) -> Path | None:
        """Writes a checkpoint of :meth:`state_dict`.

        Returns:
            Path: Path of the checkpoint; ``None`` without a folder.

        Raises:
            ValueError: If the experiment was closed.
        """
        self._check_open()
        if self.folder is None:
            return None
        self.learner.check_parameters()
        keep = self.config.checkpoint_keep
        return save_checkpoint(self.folder, len(self.metrics), self.state_dict(), keep)

    def state_dict(self) -> dict[str, Any]:
        """Returns the complete state of the run between two episodes or rollouts."""
        return {
            "config": json.dumps(self.config.to_dict()),
            "versions": json.dumps(versions()),
            "actions": self._actions,
            **{name: part.state_dict() for name, part in self._parts().items()},
            "replay": replay_state(self.learner.replay),
            "collector": self.player.collector.generator_state(),
            "global_rng": self._process.state_dict(),
            "counters": [self.player.frames, self.learner.updates],
            "unreported": self.learner.unreported,
            "metrics": json.dumps(self.metrics),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores a state of :meth:`state_dict`.

        Raises:
            OtherRunError: If the state belongs to a run with other settings or another task.
        """
        learner = self.learner
        check_same_settings(json.loads(state["config"]), self.config.to_dict())
        check_same_actions(state.get("actions", self._actions), self._actions)
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        load_replay_state(learner.replay, state["replay"])
        self.player.collector.set_generator_state(state["collector"])
        self.player.frames, learner.updates = state["counters"]
        learner.unreported = list(state["unreported"])
        self.metrics = json.loads(state["metrics"])
        # Loading replaced some tensors of the compiled update.
        learner.rebuild_update()
        self._process.load_state_dict(state["global_rng"])

    def test(
        self, episodes: int | None = None, *, sampled: bool = False, progress: bool = False
    ) -> Evaluation:
        """Plays test episodes in a new environment with its own seed.

        Args:
            episodes (int, optional): Number of episodes. Default: the settings' ``test_episodes``.

        Keyword Args:
            sampled (bool): Whether to sample actions, as in training. Default ``False``: mean
                actions.
            progress (bool): Whether to show a progress bar. Default ``False``.

        Returns:
            Evaluation: Results of all episodes, which :meth:`finish` writes.
        """
        return evaluate_task(
            self.agent.policy,
            self.config.task,
            self.config.seed + TEST_SEED,
            self.config.test_episodes if episodes is None else episodes,
            threads=self.config.threads,
            sampled=sampled,
            compile_policy=self._compile,
            progress=progress,
        )

    def finish(self, result: Evaluation, sampled: Evaluation | None = None) -> FinishedRun:
        """Writes the policy and the test results, and marks the run as finished.

        Args:
            result (Evaluation): Result of :meth:`test`.
            sampled (Evaluation, optional): Result of :meth:`test` with ``sampled=True``.

        Returns:
            FinishedRun: The finished run, read from the folder.

        Raises:
            ValueError: If the experiment has no folder, was not trained or was closed.
        """
        self._check_open()
        if self.folder is None:
            raise UserError(
                "this experiment has no folder: create it with Experiment(..., folder)."
            )
        if not self.metrics:
            raise UserError("this experiment has no episode yet: call train() before finish().")
        save_policy(self.agent.policy, self.folder / "policy.pt")
        tests = {"mean": result, "sampled": sampled}
        written = {name: test.to_dict() for name, test in tests.items() if test is not None}
        training: dict[str, Any] = {"episodes": len(self.metrics), "frames": self.player.frames}
        training |= {"updates": self.learner.updates, "untrained": self._untrained()}
        written["mean"]["training"] = training
        return write_evaluation(self.folder, self.config, written)

    def close(self) -> None:
        """Closes environments, log and lock. Training cannot continue afterwards."""
        self._closed = True
        self.player.collector.shutdown()
        self._late_tests.close()
        self._log.close()
        self._unlock()

    def _check_open(self) -> None:
        if self._closed:
            raise UserError(
                "this experiment was closed: create a new one, which continues from the last "
                "checkpoint if it has the same folder."
            )

    def _start(self, folder: Path, allow_other_versions: bool) -> None:
        self._unlock = lock_folder(make_folder(folder), self)
        found = find_checkpoint(folder, self.config, allow_other_versions=allow_other_versions)
        self._log = MetricsLog(folder, logger=self.config.logger.name)
        if found is not None:
            path, state = found
            self.load_state_dict(state)
            show_and_log(folder, f"continuing after episode {len(self.metrics)} from {path}")
        ended = self._ended(self.config.task.budget)
        resumed = found is not None
        removed = prepare_folder(folder, self.config.to_dict(), resumed=resumed, ended=ended)
        if resumed and removed and not ended:
            show_and_log(folder, f"removed the results of the earlier policy: {', '.join(removed)}")

    def _parts(self) -> dict[str, Any]:
        """Returns the objects with a state by their names in checkpoints."""
        named = ("loss", "optimizer", "target_updater", "normalization")
        parts = {name: getattr(self.agent, name) for name in named}
        parts |= {"best_policy": self._best_policy, "gain": self._gain, "metrics_log": self._log}
        return {name: part for name, part in parts.items() if part is not None}

    def _untrained(self) -> str | None:
        random_frames = self.config.algorithm.random_frames
        return untrained_reason(self.player.frames, self.learner.updates, random_frames)

    def _spent(self, budget: Budget) -> int:
        return budget.spent(len(self.metrics), self.player.frames)

    def _ended(self, budget: Budget) -> bool:
        # Results need an episode, but rollouts may use up all frames before the first one ends.
        least = bool(self.metrics) or budget.unit == "episode"
        return least and self._spent(budget) >= budget.total

    def _record(self, episode: Episode, full: Budget, bar: Progress) -> None:
        # Before the test, which would attribute NaN in the policy to the task.
        report = self.learner.report(episode.last_frame)
        number = len(self.metrics) + 1
        late = full.is_late(full.spent(number, episode.last_frame), self.config.late_share)
        row = {
            "episode": number,
            "frames": episode.last_frame,
            "updates": self.learner.updates,
            **episode.measures,
            **(self._late_tests.play(number) if late else self._late_tests.none()),
            **report,
        }
        row |= self._gain.after(row, full, ends_round=episode.ends_round)
        row["frames_per_second"] = bar.frames_per_second(self.player.frames)
        self.metrics.append(row)
        self._log.write(row)
        bar.show(self.metrics, self.learner.first_update_seconds)
        self._best_policy.after(number)
