"""Choice of the checkpoint that a run continues from."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.errors import OtherRunError, SimulatorError
from torchrl_l2c2.experiment.run.checkpoints import CheckpointError, list_checkpoints, load_newest
from torchrl_l2c2.experiment.run.files import read_config
from torchrl_l2c2.experiment.run.folder import TRAINING_ONLY, versions
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.identity import changed_settings, length_dependent_settings
from torchrl_l2c2.experiment.settings.tasks import Budget, TaskConfig


def check_same_settings(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Checks that no setting that changes a run's numbers has changed.

    Args:
        saved (Mapping): Settings in the checkpoint.
        now (Mapping): Current settings.

    Raises:
        OtherRunError: If a setting has changed; states each with both values.
    """
    changed = changed_settings(saved, now)
    # Another choice of a group brings other settings.
    chosen = {name.removesuffix(".name") for name in changed if name.endswith(".name")}
    told = [
        f"{name.removesuffix('.name')}={was}, not {is_now}"
        for name, (was, is_now) in changed.items()
        if name.endswith(".name") or name.partition(".")[0] not in chosen
    ]
    if told:
        raise OtherRunError(
            f"the checkpoint was made with {'; '.join(told)}: use "
            "the same settings, or start in another folder (on the command line, outputs=FOLDER). "
            "Nothing was changed."
        )


def check_same_actions(saved: str, now: str) -> None:
    """Checks that a task of the user's own has the actions of the checkpoint.

    Raises:
        OtherRunError: If the :func:`~.environments.action_range` has changed; states both.
    """
    if saved != now:
        raise OtherRunError(
            f"the task's actions were {saved} in the checkpoint and are {now}: its code has "
            "changed. Use the same code, or start in another folder (on the command line, "
            "outputs=FOLDER). Nothing was changed."
        )


def differing_versions(saved: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Names the packages whose versions differ, which may change the numbers; empty if none do.

    Packages that were or are not installed are ignored. A run that needs them fails anyway.

    Args:
        saved (Mapping): Versions in the checkpoint.
        now (Mapping): Installed versions.
    """
    differing = [f"{n} {saved[n]}, now {now[n]}" for n in now if saved.get(n, now[n]) != now[n]]
    if not differing:
        return ""
    return (
        f"the checkpoint was made with {'; '.join(differing)}: the numbers may differ from an "
        "uninterrupted run."
    )


def check_length(asked: Budget, before: Budget, played: int) -> None:
    """Checks that a new length of training is not below the run's current length.

    The last episode or round of episodes may have exceeded the old length. The same length may be
    requested again.

    Args:
        asked (Budget): New length of training.
        before (Budget): Old length of training.
        played (int): Number of episodes or frames so far, in the unit of the new length.

    Raises:
        OtherRunError: If the new length is too short.
    """
    least = min(played, before.total) if asked.unit == before.unit else played
    if asked.total < least:
        raise OtherRunError(
            f"{asked.unit}s={asked.total} is fewer than the {least} that this run already has: "
            "use at least as many, or start in another folder (on the command line, "
            "outputs=FOLDER). Nothing was changed."
        )


def check_length_given(folder: str | Path, asked: Budget) -> None:
    """Checks that a finished run is not trained on because its length was left out.

    Args:
        folder (str or Path): Run folder.
        asked (Budget): Length of training, a default.

    Raises:
        OtherRunError: If the folder has a finished run of another length, whose results would be
            removed.
    """
    if not any((Path(folder) / name).exists() for name in ("evaluation.json", "policy.pt")):
        return
    before = TaskConfig(**read_config(folder)["task"]).budget
    if before != asked:
        raise OtherRunError(
            f"this run is finished, with task.{before.unit}s={before.total}. Without a length the "
            f"command would train on and remove its results: add task.{before.unit}s="
            f"{before.total} to see them, task.{asked.unit}s={asked.total} to train on, or "
            "outputs=FOLDER for a new run. Nothing was changed."
        )


def warn_ignored_settings(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Warns about changed settings that have no effect, because training is over.

    Args:
        saved (Mapping): Settings of the finished training.
        now (Mapping): Current settings.

    Warns:
        UserWarning: For each changed setting.
    """
    for name in TRAINING_ONLY:
        if name in saved and saved[name] != now[name]:
            warnings.warn(
                f"{name}={now[name]} has no effect: training is over in this folder, with "
                f"{name}={saved[name]}. Choose another folder to train with {name}={now[name]}.",
                stacklevel=2,
            )


def find_checkpoint(
    folder: str | Path, config: ExperimentConfig, *, allow_other_versions: bool
) -> tuple[Path, dict[str, Any]] | None:
    """Finds the latest intact checkpoint in a folder.

    Args:
        folder (str or Path): Run folder.
        config (ExperimentConfig): Current settings.

    Keyword Args:
        allow_other_versions (bool): Whether versions of packages may differ, with a warning.

    Returns:
        tuple: Path and state; ``None`` if the folder has no checkpoints.

    Raises:
        CheckpointError: If all checkpoints are damaged, or the folder has the results of a run
            whose checkpoints were removed: a new run would replace the results.
        OtherRunError: As :func:`check_continuable`.

    Warns:
        UserWarning: If a newer checkpoint is damaged, and as :func:`check_continuable`.
    """
    if (found := load_newest(folder)) is None:
        if any((Path(folder) / name).exists() for name in ("evaluation.json", "policy.pt")):
            raise CheckpointError(
                f"{str(folder)!r} has the results of a run, but no checkpoint_*.pt to continue "
                "from: restore a checkpoint, or start in another folder (on the command line, "
                "outputs=FOLDER). Nothing was changed."
            )
        return None
    path, state, damaged = found
    for message in damaged:
        warnings.warn(f"{message} The previous checkpoint is used.", stacklevel=4)
    check_continuable(state, config, allow_other_versions=allow_other_versions)
    return path, state


def check_continuable(
    state: Mapping[str, Any], config: ExperimentConfig, *, allow_other_versions: bool
) -> None:
    """Checks that a run with these settings and versions can continue from a checkpoint.

    Args:
        state (Mapping): State in the checkpoint.
        config (ExperimentConfig): Current settings.

    Keyword Args:
        allow_other_versions (bool): Whether versions of packages may differ, with a warning.

    Raises:
        OtherRunError: If settings or versions differ, or the new length is too short.

    Warns:
        UserWarning: If a schedule depends on a changed length of training, or changed settings have
            no effect because training is over.
    """
    saved, asked = json.loads(state["config"]), config.task.budget
    check_same_settings(saved, config.to_dict())
    before = TaskConfig(**saved["task"]).budget
    played = asked.spent(len(json.loads(state["metrics"])), state["counters"][0])
    check_length(asked, before, played)
    if played >= asked.total:
        warn_ignored_settings(saved, config.to_dict())
    for setting in length_dependent_settings(config):
        if asked != before:
            warnings.warn(
                f"{setting} has followed the schedule of {before.total} {before.unit}s so far; an "
                f"uninterrupted training of {asked.total} {asked.unit}s would give other numbers.",
                stacklevel=5,
            )
    differing = differing_versions(json.loads(state["versions"]), versions())
    if differing and not allow_other_versions:
        raise OtherRunError(
            f"{differing} Set allow_other_versions=true to continue anyway. Nothing was changed."
        )
    if differing:
        warnings.warn(differing, stacklevel=5)


@contextlib.contextmanager
def add_checkpoint_to_errors(folder: Path | None) -> Iterator[None]:
    """Adds the path of the last checkpoint to errors that end a training."""
    try:
        yield
    except FloatingPointError as error:
        raise FloatingPointError(f"{error} {_last_checkpoint(folder)}") from None
    except SimulatorError as error:
        raise SimulatorError(
            f"{str(error).rstrip('.')}. {_last_checkpoint(folder)}"
        ) from error.__cause__
    except OSError as error:
        raise OSError(f"{error}. {_last_checkpoint(folder)}") from error


def _last_checkpoint(folder: Path | None) -> str:
    paths = list_checkpoints(folder) if folder is not None else []
    return f"Last good checkpoint: {paths[0] if paths else 'none has been written yet'}."
