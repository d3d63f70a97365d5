"""Checks of the command's arguments, before the first run."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_l2c2.experiment.cli.composition import one_line_message, read
from torchrl_l2c2.experiment.cli.sweep import list_jobs, list_jobs_to_check
from torchrl_l2c2.experiment.errors import UserError, how_to_install, is_lack_of_memory
from torchrl_l2c2.experiment.run.metrics_log import check_installed
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError

# Launchers in conf/hydra/launcher/: plugin, and the extra that installs it.
LAUNCHERS = {
    "ray_cluster": ("hydra_plugins.hydra_ray_launcher", "ray"),
    "slurm_cluster": ("hydra_plugins.hydra_submitit_launcher", "slurm"),
}
MEMORY_SETTINGS = (
    "algorithm.hidden, replay.capacity, replay.batch_size, algorithm.frames, task.max_steps or "
    "threads"
)

MANY_JOBS = 50  # whose check takes seconds


def is_multirun(argument: str) -> bool:
    """Checks for Hydra's option ``--multirun``, which may be abbreviated."""
    abbreviated = argument.startswith("--m") and "--multirun".startswith(argument)
    return abbreviated or argument in ("-m", "hydra.mode=MULTIRUN")


def check_launcher(arguments: Sequence[str]) -> None:
    """Checks that a launcher's extra is installed, before Hydra fails to load the launcher.

    Raises:
        SystemExit: If the extra is missing, with the command that installs it.
    """
    for name, (plugin, extra) in LAUNCHERS.items():
        if f"hydra/launcher={name}" in arguments and find_spec(plugin) is None:
            sys.exit(f"error: hydra/launcher={name} needs an extra. {how_to_install(extra)}")


def check_sweep(arguments: Sequence[str]) -> None:
    """Checks that a sweep has jobs, only one comparison, and no interval.

    Raises:
        SystemExit: If not, with the reason.
    """
    try:
        for comparison in OverridesParser.create().parse_overrides(
            [each for each in arguments if each.lstrip("+").startswith("experiment=")]
        ):
            if comparison.is_sweep_override() or isinstance(comparison.value(), list):
                sys.exit(
                    f"error: {comparison.input_line}: each comparison has its own seeds and "
                    "launcher, which a sweep over comparisons would ignore. Run one command per "
                    "comparison."
                )
        empty = not list_jobs(arguments, {})
    except HydraException as error:  # Hydra reports other errors itself, and resolves globs.
        if "INTERVAL" in str(error):
            sys.exit("error: sweeps do not support intervals: use examples/search.py.")
        return
    if empty:
        sys.exit(f"error: the sweep has no jobs: one of {' '.join(arguments)} has no value.")


def check_one_value(arguments: Sequence[str]) -> None:
    """Checks that no setting of a single run has several values.

    Raises:
        SystemExit: If one has, with the option that runs all of them.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(
            [each for each in arguments if not each.startswith("-")]
        )
    except HydraException:  # Hydra reports it.
        return
    if several := [str(each.input_line) for each in parsed if each.is_sweep_override()]:
        sys.exit(
            f"error: {' '.join(several)}: one run has one value of each setting. Add -m to train "
            "one run for each value."
        )


class CheckSweep(Callback):
    """Hydra callback that checks a sweep's values and combinations before its first run."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        """Composes and checks the jobs.

        Raises:
            SystemExit: If a value is wrong, after a line for each. Hydra would swallow other
                errors.
        """
        overrides = [*config.hydra.overrides.hydra, *config.hydra.overrides.task]
        try:
            jobs = list_jobs_to_check(overrides, config.hydra.sweeper.params or {})
        except HydraException:  # A glob: only Hydra knows its values.
            return
        if len(jobs) > MANY_JOBS:
            print(f"checking the settings of {len(jobs)} jobs", flush=True)
        wrong = [message for job in jobs if (message := _check_job(overrides, job))]
        for message in dict.fromkeys(wrong):
            print(f"error: {message}", file=sys.stderr)
        if wrong:
            sys.exit(1)


def _check_job(overrides: Sequence[str], job: Mapping[str, str]) -> str | None:
    """Returns the error in the settings of a sweep's job, or ``None``."""
    common = [each for each in overrides if each.partition("=")[0] not in job]
    swept = [f"{name}={value}" for name, value in job.items()]
    try:
        composed = compose("config", [*common, *swept], return_hydra_config=True)
        own = OmegaConf.masked_copy(composed, [str(name) for name in composed if name != "hydra"])
        values: Any = OmegaConf.to_container(own, resolve=True)
        check_task_and_logger(*read(values, composed.hydra))
    except UserError as error:
        return error_line(error)
    except (HydraException, OmegaConfBaseException) as error:
        return one_line_message(error)
    return None


def check_task_and_logger(config: ExperimentConfig, folder: Path) -> None:
    """Checks that the task and the logger of an unfinished run are installed.

    Args:
        config (ExperimentConfig): Settings of the run.
        folder (Path): Run folder.

    Raises:
        UserError: If Gymnasium does not know the task, or the logger's package is missing.
    """
    from torchrl_l2c2.experiment.envs.spaces import check_env_id  # Takes a second to import.

    if not (folder / "evaluation.json").exists():
        check_installed(config.logger.name)
        check_env_id(config.task.env_id)


def error_line(error: Exception) -> str:
    """Returns an error's message in one line, with a hint for settings and memory."""
    message = str(error) or type(error).__name__
    if isinstance(error, SettingError):
        return f"{message} --help lists every setting."
    if is_lack_of_memory(error):
        return f"{message.rstrip('.')}. Not enough memory: decrease {MEMORY_SETTINGS}."
    return message
