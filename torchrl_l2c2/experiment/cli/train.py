"""``train``: trains a run or a sweep, with settings from the command line by Hydra.

``python train.py`` in a clone, ``python -m torchrl_l2c2 train`` anywhere.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from torchrl_l2c2.experiment.cli.arguments import (
    check_launcher,
    check_one_value,
    check_sweep,
    check_task_and_logger,
    error_line,
    is_multirun,
)
from torchrl_l2c2.experiment.cli.composition import (
    CONF,
    composition_errors,
    describe_preset,
    is_length_given,
    read,
    register,
    show_sweep_hint,
)
from torchrl_l2c2.experiment.cli.manual import manual
from torchrl_l2c2.experiment.cli.sweep import Sweep, begin_sweep
from torchrl_l2c2.experiment.errors import (
    UserError,
    allow_closed_output,
    is_one_line_error,
    show_cause,
    warnings_as_lines,
)
from torchrl_l2c2.experiment.run.files import make_folder
from torchrl_l2c2.experiment.run.progress import log, show_and_log
from torchrl_l2c2.experiment.run.signals import (
    Interrupted,
    Terminated,
    keep_ctrl_c_from_children,
    terminate,
)
from torchrl_l2c2.experiment.settings.config import ExperimentConfig

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.run.finished import FinishedRun

# Maximum time for which a file server holds the lock of a crashed machine.
LOST_SECONDS = 180.0


def main(arguments: Sequence[str] | None = None) -> None:
    """Trains a run or a sweep.

    Args:
        arguments (sequence of str, optional): Hydra's overrides and options, which replace the
            process's command line. Default: the process's command line.
    """
    if arguments is not None:
        sys.argv[1:] = arguments  # Hydra reads sys.argv.
    if {"-h", "--help"} & set(sys.argv[1:]):  # Hydra's own help takes seconds.
        with allow_closed_output():
            print(manual(), end="")
        return
    check_launcher(sys.argv)
    # With settings before and after -m, Hydra reads only the first of them.
    sys.argv[1:] = sorted(sys.argv[1:], key=lambda argument: not is_multirun(argument))
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # No telemetry by default.
    keep_ctrl_c_from_children()
    signal.signal(signal.SIGTERM, terminate)
    if "" not in sys.path:  # As with python -m: the folder may have modules with tasks.
        sys.path.append(os.getcwd())
    register()
    if not any(map(is_multirun, sys.argv[1:])):
        check_one_value(sys.argv[1:])
        try:
            with composition_errors(), allow_closed_output():
                _main()
        except KeyboardInterrupt as interruption:  # Outside of training, or a second signal.
            print("interrupted; the same command continues.", file=sys.stderr)
            terminated = isinstance(interruption, Terminated)
            sys.exit(128 + (signal.SIGTERM if terminated else signal.SIGINT))
        return
    check_sweep(sys.argv[1:])
    with begin_sweep(sys.argv[1:]) as sweep:
        try:
            with composition_errors():
                _main()
        except KeyboardInterrupt:
            sweep.stop(signal.SIGINT)
        finally:
            show_sweep_end(sweep)
        stopped_by, failures = sweep.stopped_by, sweep.failures
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Nothing is left to save.
    sys.exit(bool(failures) if stopped_by is None else 128 + stopped_by)


def show_sweep_end(sweep: Sweep) -> None:
    """Prints a table of a sweep's runs, its failures, and how to continue."""
    if sweep.finished:
        from torchrl_l2c2.experiment.analysis.reports import sweep_summary

        print(sweep_summary(sweep.finished), flush=True)
    for job, reason in sweep.failures:
        print(f"failed: {job}: {reason}", file=sys.stderr)
    if sweep.stopped_by is not None:
        name = signal.Signals(sweep.stopped_by).name
        print(f"{name} ended the sweep; the same command continues it.", file=sys.stderr)


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def _main(values: DictConfig) -> None:
    plain: Any = OmegaConf.to_container(values, resolve=True)
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        _run_job(plain, Sweep.of_this_job())
        return
    try:
        show_sweep_hint()
        run(
            *read(plain, HydraConfig.get()),
            allow_other_versions=plain["allow_other_versions"],
            length_given=is_length_given(HydraConfig.get().overrides.task),
        )
    except Interrupted as interruption:
        print(interruption, file=sys.stderr)
        sys.exit(128 + interruption.signal_number)
    except Exception as error:
        _print_error(error)
        sys.exit(1)


def _run_job(values: dict[str, Any], sweep: Sweep) -> None:
    """Runs a job of a sweep. If it fails, the sweep continues with the other jobs."""
    if sweep.stopped_by is not None:
        return
    number, job = HydraConfig.get().job.num, " ".join(HydraConfig.get().overrides.task)
    try:
        with sweep.job(number, job) as started_before:
            patience = LOST_SECONDS if started_before else 0.0
            config, folder = read(values, HydraConfig.get())
            sweep.claim(number, folder)
            finished = run(
                config,
                folder,
                allow_other_versions=values["allow_other_versions"],
                length_given=is_length_given(HydraConfig.get().overrides.task),
                status=_sweep_status(sweep),
                patience=patience,
            )
            if finished is not None:
                sweep.add_finished(number, finished.folder, finished.record.seconds)
    except (Interrupted, KeyboardInterrupt) as interruption:
        stopped_by = getattr(interruption, "signal_number", signal.SIGTERM)
        if isinstance(interruption, Interrupted):
            print(interruption, file=sys.stderr)
        if sweep.is_remote and sweep.stopped_by is None:
            # A scheduler preempted the job. With this exit status it starts the job again.
            sys.exit(128 + stopped_by)
        sweep.stop(stopped_by)
    except Exception as error:
        sweep.add_failure(number, job, _print_error(error).splitlines()[0])


def _sweep_status(sweep: Sweep) -> str:
    chosen = HydraConfig.get()
    return sweep.status(chosen.job.num + 1, chosen.sweeper.params or {})


def _print_error(error: Exception) -> str:
    """Prints an error in one line, or with a traceback if it is a bug, and returns its message.

    The traceback of a failed simulator is also printed.
    """
    if not is_one_line_error(error):
        traceback.print_exception(error)
        return "".join(traceback.format_exception_only(error)).strip()
    show_cause(error)
    message = error_line(error)
    print(f"error: {message}", file=sys.stderr)
    return message


def run(
    config: ExperimentConfig,
    folder: Path,
    *,
    allow_other_versions: bool,
    length_given: bool = True,
    status: str = "",
    patience: float = 0.0,
) -> FinishedRun | None:
    """Trains and tests a run, or shows its results if it is finished.

    Args:
        config (ExperimentConfig): Settings of the run.
        folder (Path): Run folder.

    Keyword Args:
        allow_other_versions (bool): Setting of the command.
        length_given (bool): Whether the command names the length of training. A finished run of
            another length is trained on only if it does. Default ``True``.
        status (str): Progress of the sweep, shown before the run's name. Default: none.
        patience (float): Maximum time in seconds to wait for another process that uses the folder.
            Default 0.

    Returns:
        FinishedRun: The finished run; ``None`` without test episodes.
    """
    # Local imports: settings are checked before torch is imported.
    from torchrl_l2c2.experiment.run.continuation import check_length_given, warn_ignored_settings
    from torchrl_l2c2.experiment.run.finished import finished_run
    from torchrl_l2c2.experiment.run.lock import wait_for_folder

    check_task_and_logger(config, folder)
    chosen = (config.task, config.algorithm, config.regularizer)
    name = f"{', '.join(group.name for group in chosen)}, seed {config.seed}: {folder}"
    print(f"{status}: {name}" if status else name, flush=True)
    if (description := describe_preset(config)) is not None:
        print(description, flush=True)
    from torchrl_l2c2.experiment.agents.build import check_device_found

    if not (folder / "evaluation.json").exists():
        check_device_found(config.device)
    _silence_libraries()
    wait_for_folder(folder, patience)
    with _log_errors(folder):
        finished = finished_run(folder, config.to_dict())
        if finished is None and not length_given:
            check_length_given(folder, config.task.budget)
        if finished is None:
            place, _, _ = status.partition(",")  # The time left is of the run's start.
            finished = _train(config, folder, place, allow_other_versions=allow_other_versions)
        else:
            print(
                "finished before: these are its results. Use another seed= or outputs= for a new "
                "run."
            )
            with warnings_as_lines(partial(show_and_log, folder)):
                warn_ignored_settings(finished.config, config.to_dict())
        if finished is not None:
            _show(finished)
    return finished


def _silence_libraries() -> None:
    """Silences messages of libraries that a user of the command cannot act on."""
    for library in ("torchrl", "matplotlib", "torch"):
        logging.getLogger(library).setLevel(logging.ERROR)
    warnings.simplefilter("ignore", FutureWarning)
    warnings.filterwarnings("ignore", "No target network updater")


def _train(
    config: ExperimentConfig, folder: Path, status: str, *, allow_other_versions: bool
) -> FinishedRun | None:
    """Trains a policy, and tests it unless ``test_episodes`` is 0."""
    from torchrl_l2c2.experiment.run.experiment import Experiment
    from torchrl_l2c2.experiment.run.policies import save_policy
    from torchrl_l2c2.experiment.run.process import keep_freed_memory

    keep_freed_memory()
    with (
        warnings_as_lines(partial(show_and_log, folder)),
        closing(
            Experiment(config, folder, allow_other_versions=allow_other_versions)
        ) as experiment,
    ):
        if (description := describe_preset(config)) is not None:
            log(folder, description)
        experiment.train(progress=status or True)
        if not config.test_episodes:
            save_policy(experiment.agent.policy, folder / "policy.pt")
            return None
        tests = [experiment.test(sampled=s, progress=True) for s in (False, True)]
        finished = experiment.finish(*tests)
        # Imported after training: not needed at start-up.
        from torchrl_l2c2.experiment.analysis.reports import result_lines

        log(folder, f"finished:\n{result_lines(finished)}")
        return finished


def _show(finished: FinishedRun) -> None:
    """Prints the result and draws the learning curves."""
    from torchrl_l2c2.experiment.analysis.reports import draw_learning_curves, result_lines

    print(result_lines(finished))
    picture = finished.folder / "learning_curves.png"
    if not picture.exists():
        draw_learning_curves([finished], picture)
    print(f"picture: {picture}", flush=True)


@contextmanager
def _log_errors(folder: Path) -> Iterator[None]:
    """Writes errors that end a run to its ``train.log``, except for mistakes of the user."""
    try:
        yield
    except UserError:
        raise
    except (KeyboardInterrupt, Exception) as error:
        stopped = isinstance(error, KeyboardInterrupt | Interrupted)
        lines = [str(error) or "interrupted"] if stopped else traceback.format_exception(error)
        with suppress(OSError):  # The error itself may be a full disk.
            if not stopped and not is_one_line_error(error):
                make_folder(folder)
            log(folder, "".join(lines))
        raise
