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
from torchrl_l2c2.experiment.run.folder import versions
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.identity import changed_settings, length_dependent_settings
from torchrl_l2c2.experiment.settings.tasks import Budget, TaskConfig

# Free settings that only episodes of training read.
OF_TRAINING = ("evaluate_every", "late_share")


def check_same_settings(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuses to continue a run with settings that would change its numbers.

    Raises:
        OtherRunError: names the first setting that differs, with both values.
    """
    for name, (was, is_now) in changed_settings(saved, now).items():
        raise OtherRunError(
            f"the checkpoint was made with {name.removesuffix('.name')}={was}, not {is_now}: "
            "give the same settings, or begin in another folder (in a shell, outputs=FOLDER). "
            "Nothing was changed."
        )


def check_same_versions(saved: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Refuses to continue a run with versions of packages that may give other numbers.

    A package that is there only now or was there only then is passed over: what a run needs of it
    fails without it.

    Raises:
        OtherRunError: names all that differ, with both versions.
    """
    differing = [f"{n} {saved[n]}, now {now[n]}" for n in now if saved.get(n, now[n]) != now[n]]
    if differing:
        raise OtherRunError(
            f"the checkpoint was made with {'; '.join(differing)}: the numbers may "
            "differ from a run in one go. allow_other_versions=True continues "
            "anyway. Nothing was changed."
        )


def check_length(asked: Budget, before: Budget, played: int) -> None:
    """Refuses a length that is shorter than the run already is.

    A training ends with the episode, or the round of episodes, that reaches its length. The frames
    beyond it may be asked for again.

    Args:
        asked (Budget): The new length of the training.
        before (Budget): The old length of the training.
        played (int): The part that was played, in the unit of the new length.

    Raises:
        OtherRunError: with both numbers.
    """
    least = min(played, before.total) if asked.unit == before.unit else played
    if asked.total < least:
        raise OtherRunError(
            f"{asked.unit}s={asked.total} is fewer than the {least} that this run already has: ask "
            "for as many or more, or begin in another folder (in a shell, outputs=FOLDER). Nothing "
            "was changed."
        )


def tell_past(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Warns about changed settings that have no effect, because the training is over.

    Warns:
        UserWarning: Names each setting that differs.
    """
    for name in OF_TRAINING:
        if saved[name] != now[name]:
            warnings.warn(
                f"{name}={now[name]} changes nothing: it is of training, which is over in this "
                f"folder, with {name}={saved[name]}. Choose another folder to train with it.",
                stacklevel=2,
            )


def find_checkpoint(
    folder: str | Path, config: ExperimentConfig, *, allow_other_versions: bool
) -> tuple[Path, dict[str, Any]] | None:
    """Finds the newest intact checkpoint in a folder, with its path.

    Raises:
        CheckpointError: No checkpoint can be read, or the run has ended and has none any more: a
            new run would replace its results.
        OtherRunError: as :func:`check_continuable`.

    Warns:
        UserWarning: a newer one is damaged; and as :func:`check_continuable`.
    """
    if (found := load_newest(folder)) is None:
        if any((Path(folder) / name).exists() for name in ("evaluation.json", "policy.pt")):
            raise CheckpointError(
                f"{str(folder)!r} holds a run that has ended, and no checkpoint_*.pt any more to "
                "continue from: restore one, or begin in another folder (in a shell, "
                "outputs=FOLDER). Nothing was changed."
            )
        return None
    path, state, damaged = found
    for message in damaged:
        warnings.warn(f"{message} The one before it is used.", stacklevel=4)
    check_continuable(state, config, allow_other_versions=allow_other_versions)
    return path, state


def check_elsewhere(folder: str | Path | None) -> None:
    """Refuses a folder without a checkpoint.

    Raises:
        CheckpointError: names the folder.
    """
    if folder is not None and not list_checkpoints(folder):
        raise CheckpointError(
            f"resume={str(folder)!r} holds no checkpoint_*.pt: name another run's folder, or leave "
            "resume out; a run that has begun needs none."
        )


def find_elsewhere(
    folder: str | Path | None,
    own: Path | None,
    config: ExperimentConfig,
    *,
    allow_other_versions: bool,
) -> tuple[Path, dict[str, Any]] | None:
    """Finds the checkpoint in another folder, unless the run has its own checkpoint.

    The same command again continues the run. The run's own folder need not exist yet, and
    does not after a refusal.

    Raises:
        CheckpointError: The folder has none; and as :func:`find_checkpoint`.
        OtherRunError: as :func:`find_checkpoint`, which has the same options.
    """
    check_elsewhere(folder)
    if folder is None or (own is not None and list_checkpoints(own)):
        return None
    return find_checkpoint(folder, config, allow_other_versions=allow_other_versions)


def check_continuable(
    state: Mapping[str, Any], config: ExperimentConfig, *, allow_other_versions: bool
) -> None:
    """Refuses a checkpoint that a run with these settings and versions cannot continue from.

    Raises:
        OtherRunError: other settings, a shorter training than it is, or other versions.

    Warns:
        UserWarning: another length, by which the learning rate falls or a gain rises; settings of a
            training that is over.
    """
    saved, asked = json.loads(state["config"]), config.task.budget
    check_same_settings(saved, config.to_dict())
    before = TaskConfig(**saved["task"]).budget
    played = asked.spent(len(json.loads(state["metrics"])), state["counters"][0])
    check_length(asked, before, played)
    if played >= asked.total:
        tell_past(saved, config.to_dict())
    for setting in length_dependent_settings(config):
        if asked != before:
            warnings.warn(
                f"{setting} has been till now as in a training of {before.total} {before.unit}s; "
                f"{asked.total} {asked.unit}s in one go would give other numbers.",
                stacklevel=5,
            )
    try:
        check_same_versions(json.loads(state["versions"]), versions())
    except OtherRunError as error:
        if not allow_other_versions:
            raise
        warnings.warn(str(error), stacklevel=5)


@contextlib.contextmanager
def checkpoint_named(folder: Path | None) -> Iterator[None]:
    """Adds the last checkpoint to the text of errors that end a training."""
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
    return f"Last good checkpoint: {paths[0] if paths else 'none was written yet'}."
