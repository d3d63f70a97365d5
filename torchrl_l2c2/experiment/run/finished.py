"""A finished run: its folder, read back, and a record of it in one line."""

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
    by_name,
    differences,
    differing,
    fingerprint,
    write_differences,
)

# Which policies act: the last one in its test episodes, or each one late in training in an episode.
# And how: with mean actions, as a trained policy is used, or with sampled ones, as in training.
TESTS = {
    "last_mean": "last policy, mean actions",
    "late_mean": "late policies, mean actions",
    "last_sampled": "last policy, sampled actions",
    "late_sampled": "late policies, sampled actions",
}
QUANTITIES = {"return": "return", "action_variation": "action variation"}
LATE = 0.1  # of training, if late_share is 0


@dataclass(frozen=True)
class Record:
    """One line about a finished run; an unknown number is NaN, in the file an empty cell.

    Attributes:
        method: the regularizer's name.
        length: how long it was trained, such as ``"400 episodes"``.
        settings: :func:`~.differences.fingerprint` of the others.
        differences: what differs from the defaults, such as ``"algorithm.replay_ratio=10"``.
        late_mean_return: mean over the late policies (see ``late_share``) of a test episode with
            mean actions.
        late_sampled_return: mean over the training episodes of the same policies.
        last_mean_return: mean over the last policy's test episodes with mean actions.
        last_mean_sm_asap: of the same, as :func:`~torchrl_l2c2.metrics.spectral_smoothness` has it.
        last_sampled_return: the same with sampled actions.
        policy_scale: of the late policies.
        seconds: of training: frames over the frames a second of the last call.
        commit: of the code, where it lay in a git checkout.
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
        """Two records with the same are the same run, made twice; the seed is the last of it."""
        return (self.task, self.algorithm, self.method, self.settings, self.length, self.seed)


@dataclass(frozen=True)
class FinishedRun:
    """One run's folder, read back: its settings, its learning curve and its test episodes."""

    folder: Path
    config: dict[str, Any]
    evaluation: dict[str, Any]
    metrics: list[dict[str, str]]
    versions: dict[str, str]

    @classmethod
    def read(cls, folder: Path, evaluation: dict[str, Any] | None = None) -> FinishedRun:
        """Reads a run's folder; ``evaluation.json`` marks it as finished.

        Args:
            folder (Path): The run's folder.
            evaluation (dict, optional): The content of ``evaluation.json``. Default: the file's.

        Raises:
            ValueError: names the file that is damaged, or cut short since the test.
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
                f"{folder / 'metrics.csv'} has {len(metrics)} episodes, fewer than the {least} "
                f"that were tested after: {REMEDY}"
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
        """Of the test with mean actions."""
        return int(self.evaluation.get("summary", {}).get("episodes", 0))

    @property
    def is_untrained(self) -> bool:
        """Tells if no update was made, or every action was random."""
        return bool((self.evaluation.get("training") or {}).get("untrained"))

    def column(self, name: str) -> list[float]:
        """A column of the metrics, a number per episode; NaN where it was not measured."""
        return [float(row.get(name) or "nan") for row in self.metrics]

    @cached_property
    def record(self) -> Record:
        """The run in one line, its numbers to six digits, as the file has them.

        Raises:
            SettingError: a setting that is not known.
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
            commit=self.versions.get("commit", ""),
            differences=write_differences(differences(self.config)),
            **{name: float(f"{value:.6g}") for name, value in numbers.items()},
        )

    def _length(self) -> str:
        """The requested length: a training ends with the round of episodes that reaches it."""
        task = self.config["task"]
        if task.get("frames") is not None:
            return f"{task['frames']:.0f} frames"
        return f"{min(task['episodes'], len(self.metrics))} episodes"

    def _last(self, acting: str, test: dict[str, Any], *quantities: str) -> dict[str, float]:
        summary = test.get("summary", {})
        found = {name: summary.get(f"{name}_mean") for name in quantities}
        # JSON has null where there is no number, as of episodes that are too short.
        return {f"last_{acting}_{k}": math.nan if v is None else v for k, v in found.items()}

    def _late(self) -> dict[str, float]:
        """Of the late policies, with their test episodes where these were played.

        Without ``late_share`` of training's last tenth.
        """
        config = ExperimentConfig.from_dict(self.config)
        budget, tests = config.task.budget, self.column("test_return")
        # A longer run has tests of the shorter one's end, too.
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
    """Checks whether a folder has the test of a run with these settings.

    Settings that change none of the numbers may differ, but for how long the training is.

    Raises:
        ValueError: as :func:`read_config` and :func:`read_back`.
    """
    if not (Path(run) / "evaluation.json").exists():
        return False
    with read_back(run):
        saved = read_config(run)
        before, after = ([by_name(s).get(name) for name in BUDGETS] for s in (saved, settings))
        return before == after and not differing(saved, settings)


def write_evaluation(
    folder: Path, config: ExperimentConfig, tests: dict[str, dict[str, Any]]
) -> FinishedRun:
    """Writes ``evaluation.json``, which marks a run as finished.

    Args:
        folder (Path): The run's folder.
        config (ExperimentConfig): The run's settings.
        tests (dict): ``"mean"`` and optionally ``"sampled"``: ``"summary"`` and ``"episodes"`` of
            the test with mean actions and with sampled actions.

    Returns:
        FinishedRun: the folder, read back.
    """
    named = {group: getattr(config, group).name for group in ("task", "algorithm", "regularizer")}
    run = {**named, "seed": config.seed, "solved_at": config.task.solved_at}
    rest = {name: test for name, test in tests.items() if name != "mean"}
    evaluation = {"run": run, **tests["mean"], **rest}
    FinishedRun.read(folder, evaluation)  # Refused before it marks the run as finished.
    write_json(folder / "evaluation.json", evaluation)
    return FinishedRun.read(folder)


def finished_run(folder: str | Path, settings: dict[str, Any]) -> FinishedRun | None:
    """The run in a folder whose test is of these settings, and has as many episodes as they ask.

    ``None`` where there is none; any number of episodes is enough for settings that want none.

    Raises:
        UserError: it is damaged.
    """
    if not is_tested(folder, settings):
        return None
    with read_back(folder):
        run = FinishedRun.read(Path(folder))
        _ = run.record
        return run if settings["test_episodes"] in (0, run.test_episodes) else None


def _check_numbers(path: Path, metrics: Sequence[dict[str, str]]) -> None:
    for line, row in enumerate(metrics, 2):
        for name, cell in row.items():
            try:
                float(cell or "nan")
            except ValueError:
                raise UserError(
                    f"{path}, line {line}: {name} is no number, but {cell!r:.40}: {REMEDY}"
                ) from None
