"""Finished runs, read from their folders, and their one-line records."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import (
    REMEDY,
    read_back,
    read_config,
    read_evaluation,
    read_json,
    read_rows,
    write_json,
)
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.identity import (
    BUDGETS,
    changed_settings,
    differences,
    fingerprint,
    flatten_settings,
    write_differences,
)

# The last policy in its test episodes, or the policies of the last part of training with an episode
# each ("late"); with mean actions, or with sampled actions as in training.
TESTS = {
    "last_mean": "last policy, mean actions",
    "late_mean": "late policies, mean actions",
    "last_sampled": "last policy, sampled actions",
    "late_sampled": "late policies, sampled actions",
}
QUANTITIES = {"return": "return", "action_variation": "action variation"}
LATE = 0.1  # Share of training for the late policies if late_share is 0.


@dataclass(frozen=True)
class Record:
    """Results of a finished run, one line of a CSV file. Unknown numbers are NaN or empty cells.

    Attributes:
        method: Name of the regularizer.
        length: Length of training, such as ``"400 episodes"``.
        settings: Hash of the other settings, :func:`~.identity.fingerprint`.
        differences: Settings that differ from the defaults, such as
            ``"algorithm.replay_ratio=10"``.
        late_mean_return: Mean over the late policies (see ``late_share``) of a test episode with
            mean actions.
        late_sampled_return: Mean over the training episodes of the same policies.
        last_mean_return: Mean over the last policy's test episodes with mean actions.
        last_mean_sm_asap: :func:`~torchrl_l2c2.metrics.spectral_smoothness` in these test episodes.
        last_sampled_return: Mean over the last policy's test episodes with sampled actions.
        policy_scale: Mean scale of the late policies.
        seconds: Duration of training: all frames divided by the last call's frames per second.
        commit: Commit of the code; outside of a git checkout, the version of this package.
    """

    task: str
    algorithm: str
    method: str
    settings: str
    length: str
    seed: int
    episodes: int
    frames: int
    updates: int
    late_mean_return: float
    late_mean_action_variation: float
    late_sampled_return: float
    late_sampled_action_variation: float
    last_mean_return: float
    last_mean_action_variation: float
    last_mean_sm_asap: float
    last_sampled_return: float
    last_sampled_action_variation: float
    policy_scale: float
    seconds: float
    torch: str
    torchrl: str
    commit: str
    differences: str

    @property
    def identity(self) -> tuple[str | int, ...]:
        """Identity of the run, with the seed last. Records of repeated runs have the same."""
        return (self.task, self.algorithm, self.method, self.settings, self.length, self.seed)


@dataclass(frozen=True)
class FinishedRun:
    """Settings, learning curve and test episodes of a finished run, read from its folder."""

    folder: Path
    config: dict[str, Any]
    evaluation: dict[str, Any]
    metrics: list[dict[str, str]]
    versions: dict[str, str]

    @classmethod
    def read(cls, folder: Path, evaluation: dict[str, Any] | None = None) -> FinishedRun:
        """Reads a run's folder. ``evaluation.json`` marks a run as finished.

        Args:
            folder (Path): Run folder.
            evaluation (dict, optional): Content of ``evaluation.json``. Default: read from the
                file.

        Raises:
            ValueError: If a file is damaged, or was truncated after the test.
        """
        config = read_config(folder)
        evaluation = read_evaluation(folder) if evaluation is None else evaluation
        versions = folder / "versions.json"
        known = read_json(versions) if versions.exists() else {}
        _, metrics = read_rows(folder / "metrics.csv")
        least = max(1, (evaluation.get("training") or {}).get("episodes", 1))
        _check_numbers(folder / "metrics.csv", metrics)
        if len(metrics) < least:
            raise UserError(
                f"{folder / 'metrics.csv'} has {len(metrics)} episodes, fewer than the {least} at "
                f"the time of the test: {REMEDY}"
            )
        return cls(folder, config, evaluation, metrics, {n: str(v) for n, v in known.items()})

    @property
    def task(self) -> str:
        return str(self.config["task"]["name"])

    @property
    def algorithm(self) -> str:
        return str(self.config["algorithm"]["name"])

    @property
    def regularizer(self) -> str:
        return str(self.config["regularizer"]["name"])

    @property
    def seed(self) -> int:
        return int(self.config["seed"])

    @property
    def solved_at(self) -> float | None:
        solved: float | None = self.config["task"].get("solved_at")
        return solved

    @property
    def test_episodes(self) -> int:
        """Number of test episodes with mean actions."""
        return int(self.evaluation.get("summary", {}).get("episodes", 0))

    @property
    def is_untrained(self) -> bool:
        """Checks whether no update was made or every action was random."""
        return bool((self.evaluation.get("training") or {}).get("untrained"))

    def column(self, name: str) -> list[float]:
        """Returns a column of the metrics, one number per episode; NaN if not measured."""
        return [float(row.get(name) or "nan") for row in self.metrics]

    @cached_property
    def record(self) -> Record:
        """Record of the run, with numbers rounded to six digits as in CSV files.

        Raises:
            SettingError: If a setting is unknown.
        """
        end = self.metrics[-1]
        frames, speed = int(end["frames"]), self.column("frames_per_second")[-1]
        numbers = {
            **self._last("mean", self.evaluation, *QUANTITIES, "sm_asap"),
            **self._last("sampled", self.evaluation.get("sampled") or {}, *QUANTITIES),
            **self._late(),
            "seconds": frames / speed if speed > 0.0 else math.nan,
        }
        return Record(
            task=self.task,
            algorithm=self.algorithm,
            method=self.regularizer,
            settings=fingerprint(self.config),
            length=self._length(),
            seed=self.seed,
            episodes=len(self.metrics),
            frames=frames,
            updates=int(end["updates"]),
            torch=self.versions.get("torch", ""),
            torchrl=self.versions.get("torchrl", ""),
            commit=self.versions.get("commit") or self.versions.get("torchrl-l2c2", ""),
            differences=write_differences(differences(self.config)),
            **{name: float(f"{value:.6g}") for name, value in numbers.items()},
        )

    def _length(self) -> str:
        """Returns the requested length of training, which the last round may have exceeded."""
        task = self.config["task"]
        if task.get("frames") is not None:
            return f"{task['frames']:.0f} frames"
        return f"{min(task['episodes'], len(self.metrics))} episodes"

    def _last(self, acting: str, test: dict[str, Any], *quantities: str) -> dict[str, float]:
        summary = test.get("summary", {})
        found = {name: summary.get(f"{name}_mean") for name in quantities}
        # Unknown numbers are null in JSON, for example if episodes are too short.
        return {f"last_{acting}_{k}": math.nan if v is None else v for k, v in found.items()}

    def _late(self) -> dict[str, float]:
        """Returns the means over the late policies; without ``late_share``, over the last 10%."""
        config = ExperimentConfig.from_dict(self.config)
        budget, tests = config.task.budget, self.column("test_return")
        # An extended run also has tests from the end of the shorter run.
        late = [
            row
            for row, frames in enumerate(self.column("frames"))
            if budget.is_late(budget.spent(row + 1, int(frames)), config.late_share)
            and not math.isnan(tests[row])
        ]
        share = config.late_share or LATE
        late = late or list(range(len(tests)))[-max(1, round(len(tests) * share)) :]

        def average(name: str) -> float:
            values = self.column(name)
            return statistics.fmean(values[row] for row in late)

        return {
            "late_mean_return": average("test_return"),
            "late_mean_action_variation": average("test_action_variation"),
            "late_sampled_return": average("return"),
            "late_sampled_action_variation": average("action_variation"),
            "policy_scale": average("policy_scale"),
        }


def is_tested(run: str | Path, settings: Mapping[str, Any]) -> bool:
    """Checks whether a folder has test results of a run with these settings.

    Settings that change no numbers may differ, except for the length of training.

    Args:
        run (str or Path): Run folder.
        settings (Mapping): Settings, as in ``config.json``.

    Raises:
        ValueError: If ``config.json`` is damaged.
    """
    if not (Path(run) / "evaluation.json").exists():
        return False
    with read_back(run):
        saved = read_config(run)
        before, after = (
            [flatten_settings(s).get(name) for name in BUDGETS] for s in (saved, settings)
        )
        return before == after and not changed_settings(saved, settings)


def write_evaluation(
    folder: Path, config: ExperimentConfig, tests: dict[str, dict[str, Any]]
) -> FinishedRun:
    """Writes ``evaluation.json``, which marks a run as finished.

    Args:
        folder (Path): Run folder.
        config (ExperimentConfig): Settings of the run.
        tests (dict): Test results, each with ``"summary"`` and ``"episodes"``: ``"mean"`` with mean
            actions and optionally ``"sampled"`` with sampled actions.

    Returns:
        FinishedRun: The finished run, read from the folder.
    """
    named = {group: getattr(config, group).name for group in ("task", "algorithm", "regularizer")}
    run = {**named, "seed": config.seed, "solved_at": config.task.solved_at}
    rest = {name: test for name, test in tests.items() if name != "mean"}
    evaluation = {"run": run, **tests["mean"], **rest}
    FinishedRun.read(folder, evaluation)  # Check before the run is marked as finished.
    write_json(folder / "evaluation.json", evaluation)
    return FinishedRun.read(folder)


def finished_run(folder: str | Path, settings: dict[str, Any]) -> FinishedRun | None:
    """Reads the finished run in a folder if it matches the settings.

    Args:
        folder (str or Path): Run folder.
        settings (dict): Settings, as in ``config.json``. With ``test_episodes=0``, the test may
            have any number of episodes.

    Returns:
        FinishedRun: The run; ``None`` if it is not finished, its settings differ, or its test has
        another number of episodes.

    Raises:
        UserError: If a file is damaged.
    """
    if not is_tested(folder, settings):
        return None
    with read_back(folder):
        run = FinishedRun.read(Path(folder))
        _ = run.record
        return run if settings["test_episodes"] in (0, run.test_episodes) else None


def _check_numbers(path: Path, metrics: Sequence[dict[str, str]]) -> None:
    # A diagnostic may be infinite, such as the distance of a neighbor beyond max_step.
    finite = {"frames", "updates", *QUANTITIES, *(f"test_{name}" for name in QUANTITIES)}
    for line, row in enumerate(metrics, 2):
        for name, cell in row.items():
            try:
                usable = not math.isinf(float(cell or "nan")) or name not in finite
            except ValueError:
                usable = False
            if not usable:
                raise UserError(
                    f"{path}, line {line}: {name} must be a finite number, got {cell!r:.40}: "
                    f"{REMEDY}"
                )
