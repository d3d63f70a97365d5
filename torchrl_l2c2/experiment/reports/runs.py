"""Runs' folders, read back: settings, learning curves, test episodes."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.config import ExperimentConfig
from torchrl_l2c2.experiment.identity import is_tested
from torchrl_l2c2.experiment.reports.differences import differences, fingerprint, write_differences
from torchrl_l2c2.experiment.reports.records import QUANTITIES, Record
from torchrl_l2c2.experiment.saved import (
    REMEDY,
    read_back,
    read_config,
    read_evaluation,
    read_json,
    read_rows,
)

LATE = 0.1  # of training, where no late policies were to be tested


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
            folder (Path): of the run.
            evaluation (dict, optional): what that file is to have. Default: what it has.

        Raises:
            ValueError: names the file that is damaged, or cut short since the test.
        """
        config = read_config(folder)
        evaluation = read_evaluation(folder) if evaluation is None else evaluation
        versions = folder / "versions.json"
        known = read_json(versions) if versions.exists() else {}
        _, metrics = read_rows(folder / "metrics.csv")
        # Tests of earlier releases do not say.
        least = max(1, (evaluation.get("training") or {}).get("episodes", 1))
        _check_numbers(folder / "metrics.csv", metrics)
        if len(metrics) < least:
            raise ValueError(
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
        """Whether no update was made, or every action was random."""
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

    def until(self, length: int) -> FinishedRun | None:
        """The run as if its training had ended earlier; ``None`` where it was shorter than that.

        Itself where it ended just then. Of a longer one its training's own episodes are all that
        is known, those with sampled actions: tests of earlier policies with their means were not
        played.

        Args:
            length (int): in episodes, or in frames where the run's own length is in frames.
        """
        unit = "episodes" if self.config["task"].get("frames") is None else "frames"
        if self.record.length == f"{length} {unit}":
            return self
        column = self.column("episode" if unit == "episodes" else "frames")
        if not column or not 0 < length <= column[-1]:
            return None
        # Training ends with the episode that reaches its length.
        kept = [
            {name: cell for name, cell in row.items() if not name.startswith("test_")}
            for row, before in zip(self.metrics, [0.0, *column[:-1]], strict=True)
            if before < length
        ]
        config = {**self.config, "task": {**self.config["task"], unit: length}}
        return replace(self, config=config, evaluation={}, metrics=kept)

    def _length(self) -> str:
        """What was asked for: a training ends with the round of episodes that reaches it."""
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


def finished_run(folder: str | Path, settings: dict[str, Any]) -> FinishedRun | None:
    """The run in a folder whose test is of these settings, and has as many episodes as they ask.

    ``None`` where there is none; any number of episodes is enough for settings that want none.

    Raises:
        ValueError: it is damaged.
    """
    if not is_tested(folder, settings):
        return None
    with read_back(folder):
        run = FinishedRun.read(Path(folder))
        _ = run.record
        return run if settings["test_episodes"] in (0, run.test_episodes) else None


@dataclass(frozen=True)
class Found:
    """What lies below some folders: one finished run of each kind, and notes on all others."""

    runs: list[FinishedRun]
    notes: list[str]


def find_runs(folders: Iterable[str | Path], *, required: bool = False) -> Found:
    """Reads every finished run below folders, and names what is not one.

    Of runs with the same settings and the same seed the one that finished last is taken.

    Args:
        folders (iterable of str or Path): searched to their depths.

    Keyword Args:
        required (bool): whether to refuse folders without a finished run. Default ``False``.

    Returns:
        Found: runs in the order of their tables, and notes on folders that are unfinished, cannot
        be read, or repeat another.

    Raises:
        FileNotFoundError: one of the folders is not there, or is none; or nothing that is required.
    """
    searched = [Path(folder) for folder in folders]
    if absent := [str(folder) for folder in searched if not folder.is_dir()]:
        raise FileNotFoundError(f"there is no folder {', '.join(map(repr, absent))}.")
    runs: list[FinishedRun] = []
    unread: list[str] = []
    places = _places(searched)
    for folder in places["finished"]:
        try:
            run = FinishedRun.read(folder)
            _ = run.record
        except (OSError, ValueError, KeyError, TypeError, ArithmeticError) as error:
            unread.append(f"{folder} ({error})")
        else:
            runs.append(run)
    newest, repeated = _newest(runs)
    named = {
        "unfinished (running, interrupted or failed)": [str(path) for path in places["unfinished"]],
        "unreadable": unread,
        "the same settings and seed as a newer one, left out": repeated,
        "untrained (without an update, or with random actions alone)": [
            str(run.folder) for run in newest if run.is_untrained
        ],
        "pooled with runs of another late_share": _of_other_shares(newest),
    }
    notes = [f"{len(names)} {what}: {', '.join(names)}" for what, names in named.items() if names]
    if required and not newest:
        below = ", ".join(repr(str(folder)) for folder in searched)
        nothing = f"no finished run (evaluation.json) below {below}; name a folder of train.py's."
        raise FileNotFoundError(" ".join([nothing, *notes]))
    return Found(sorted(newest, key=lambda run: run.record.place), notes)


def read_runs(folder: str | Path) -> list[FinishedRun]:
    """Every finished run below a folder, as :func:`find_runs` sorts them.

    Raises:
        FileNotFoundError: there is none.
    """
    return find_runs([folder], required=True).runs


def _places(folders: Iterable[Path]) -> dict[str, list[Path]]:
    """Folders of runs by how far they came."""
    marks: dict[Path, set[str]] = {}
    shown: dict[Path, Path] = {}
    for folder in folders:
        for name in ("config.json", "evaluation.json"):
            for path in folder.rglob(name):
                place = path.parent.resolve()
                marks.setdefault(place, set()).add(name)
                shown.setdefault(place, path.parent)
    stages: dict[str, list[Path]] = {"finished": [], "unfinished": []}
    for place in sorted(marks):
        stage = "finished" if "evaluation.json" in marks[place] else "unfinished"
        stages[stage].append(shown[place])
    return stages


def _check_numbers(path: Path, metrics: Sequence[dict[str, str]]) -> None:
    for line, row in enumerate(metrics, 2):
        for name, cell in row.items():
            try:
                float(cell or "nan")
            except ValueError:
                raise ValueError(
                    f"{path}, line {line}: {name} is no number, but {cell!r:.40}: {REMEDY}"
                ) from None


def _of_other_shares(runs: Sequence[FinishedRun]) -> list[str]:
    """Runs whose late policies are those of another share of training than most others' are."""
    shares: dict[tuple[Any, ...], list[tuple[float, Path]]] = {}
    for run in runs:
        share = run.config.get("late_share", LATE)
        shares.setdefault(run.record.identity[:-1], []).append((share, run.folder))
    usual = {kind: statistics.mode(share for share, _ in each) for kind, each in shares.items()}
    return [
        f"{folder} (late_share={share})"
        for kind, each in shares.items()
        for share, folder in each
        if share != usual[kind]
    ]


def _newest(runs: Sequence[FinishedRun]) -> tuple[list[FinishedRun], list[str]]:
    def finished_at(run: FinishedRun) -> float:
        return (run.folder / "evaluation.json").stat().st_mtime

    newest: dict[tuple[Any, ...], FinishedRun] = {}
    repeated = []
    for run in sorted(runs, key=finished_at):
        older = newest.get(run.record.identity)
        if older is not None:
            repeated.append(f"{older.folder} (as {run.folder})")
        newest[run.record.identity] = run
    return list(newest.values()), repeated
