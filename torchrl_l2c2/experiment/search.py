"""Search for settings that return more and act more smoothly, by Optuna: two objectives, one front.

A trial is a sweep of the main command with the values that Optuna proposes, in a folder of its own;
what stops, goes on as every sweep does. Trials are in ``journal.log`` as lines of JSON, which
several processes, also on several machines, may add to.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from filelock import FileLock

from torchrl_l2c2.experiment.errors import MissingPackageError, UserError, told_in_a_line
from torchrl_l2c2.experiment.files import make_folder
from torchrl_l2c2.experiment.front import draw_front, front_table, front_test
from torchrl_l2c2.experiment.lock import FolderInUseError, lock_folder
from torchrl_l2c2.experiment.naming import plain
from torchrl_l2c2.experiment.reports import find_runs, write_report
from torchrl_l2c2.experiment.reports.comparison import SIGNS
from torchrl_l2c2.experiment.reports.groups import by_task, group_records
from torchrl_l2c2.experiment.search_space import check_settings, read_space, short
from torchrl_l2c2.experiment.sweep import start_guard

if TYPE_CHECKING:
    from optuna import Study, Trial

DESCRIPTION = """\
Searches for settings with a large return and a small action variation, and writes a report with the
Pareto front. Settings are those of the main command, and of Hydra's grammar:

  name=interval(0,1)            searched, a real number
  name=int(interval(1,4))       searched, a whole number
  name=tag(log,interval(1,9))   searched on a logarithmic scale
  name=choice(a,b)              searched, one of these
  seed=0,1,2                    every trial runs all of them; its figures are their means
  hydra/launcher=ray_cluster    where a trial's runs are: docs/clusters.md

The same command goes on; several of them, begun at the same time, share the trials.
"""
EXAMPLE = r"""
example:
  python -m torchrl_l2c2.experiment.search --trials 30 --output outputs/search \
    seed=0,1 'regularizer.lambda_min=tag(log,interval(.001,.1))' 'regularizer.beta=interval(0,1)'
"""
UNTESTED = "a trial is scored by tests of its policies: choose test_episodes of at least 1"
MARK = "TORCHRL_L2C2_SEARCH"  # of the environment, by which the processes of a search are known


class Search:
    """A study in a folder: what is searched, and what every trial has in common.

    Args:
        folder (Path): made where it is not there.
        overrides (sequence of str): of the main command, with what is searched among them.

    Keyword Args:
        seed (int): of Optuna's proposals; those of one process follow from it. Default 0.

    Raises:
        ImportError: Optuna is not installed.
        ValueError: nothing is searched, nothing is tested, a setting cannot be, or the folder is of
            another search.
    """

    def __init__(self, folder: Path, overrides: Sequence[str], *, seed: int = 0) -> None:
        if find_spec("optuna") is None:
            raise MissingPackageError(
                "Optuna is missing: pip install 'torchrl-l2c2[search]' brings it."
            )
        self.space, self.fixed = read_space(overrides)
        if not self.space:
            raise UserError("nothing is searched; give a setting interval(a,b) or choice(a,b).")
        if "test_episodes=0" in self.fixed:
            raise UserError(f"{UNTESTED}, got 0.")
        check_settings(overrides)
        self.folder, self._seed = make_folder(folder), seed
        self.study = self._open()
        settings = [each for each in self.fixed if not each.startswith("hydra")]
        settings += [f"{name}={kind}" for name, kind in self.space.items()]
        begun = self.study.user_attrs.get("settings", sorted(settings))
        if begun != sorted(settings):
            raise UserError(
                f"{str(folder)!r} holds a search with {' '.join(begun)}: choose another folder."
            )
        self.study.set_user_attr("settings", begun)

    def trials(self, most: int) -> Iterator[tuple[int, dict[str, Any]]]:
        """Numbers and values of what is to be run; what was begun and lost comes first.

        Args:
            most (int): how many there are to be in all.
        """
        from optuna.trial import TrialState

        for lost in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            with self._taken(lost.number) as ours:
                if ours:
                    yield lost.number, lost.params
        while (trial := self._ask(most)) is not None:
            with self._taken(trial.number) as ours:
                if ours:
                    yield trial.number, trial.params

    def command(self, number: int, values: Mapping[str, Any]) -> list[str]:
        """A trial as a sweep of the main command."""
        found = [f"{name}={short(value)}" for name, value in values.items()]
        main = (sys.executable, "-m", "torchrl_l2c2.experiment", "-m")
        return [*main, *self.fixed, *found, f"outputs={self._of(number)}"]

    def tell(self, number: int) -> dict[str, float]:
        """Gives Optuna what a trial's runs came to, and returns it: means over them.

        Raises:
            UserError: its runs left no results.
        """
        records = [run.record for run in find_runs([self._of(number)]).runs]
        if not records:
            raise UserError(f"{self.name(number)} has no results; {UNTESTED}.")
        test = front_test(group_records(records))
        scores = {q: [record.value(test, q) for record in records] for q in SIGNS}
        values = {quantity: statistics.fmean(each) for quantity, each in scores.items()}
        self.study.tell(number, list(values.values()), skip_if_finished=True)
        return values

    def ended(self, how: Literal["COMPLETE", "FAIL"]) -> list[Path]:
        """The folders of the trials whose runs have all finished, or of those that failed."""
        from optuna.trial import TrialState

        trials = self.study.get_trials(deepcopy=False, states=(TrialState[how],))
        return [self._of(trial.number) for trial in trials]

    def tell_failure(self, number: int) -> None:
        """A trial some of whose runs failed; those that did not would flatter it."""
        from optuna.trial import TrialState

        self.study.tell(number, state=TrialState.FAIL, skip_if_finished=True)

    def _ask(self, most: int) -> Trial | None:
        """The next trial; one process at a time, as what is proposed follows from its number."""
        from optuna.samplers import TPESampler

        with FileLock(self.folder / ".lock_asking"):
            if (done := len(self.study.get_trials(deepcopy=False))) >= most:
                return None
            # What has been proposed before is of no matter: a continued search is the same.
            entropy = np.random.SeedSequence([self._seed, done])
            self.study.sampler = TPESampler(seed=int(entropy.generate_state(1)[0]))
            return self.study.ask(self.space)

    def _open(self) -> Study:
        import optuna
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        path = self.folder / "journal.log"
        try:
            return optuna.create_study(
                study_name="search",
                storage=optuna.storages.JournalStorage(JournalFileBackend(str(path))),
                directions=["maximize" if sign > 0 else "minimize" for sign in SIGNS.values()],
                load_if_exists=True,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"{path} is no journal of a search ({type(error).__name__}: {error}): restore it, "
                "or choose another folder."
            ) from error

    @contextmanager
    def _taken(self, number: int) -> Iterator[bool]:
        """Whether this process has a trial for itself meanwhile."""
        try:
            give_back = lock_folder(make_folder(self._of(number)), self)
        except FolderInUseError:
            yield False
            return
        yield True
        give_back()

    @staticmethod
    def name(number: int) -> str:
        """What a trial's folder is called, from its number from 0 on."""
        return f"trial_{number:04d}"

    def _of(self, number: int) -> Path:
        return self.folder / self.name(number)


def run_sweep(command: Sequence[str]) -> int:
    """Runs a sweep in a process of its own, which hears the signals that this one gets.

    Returns:
        int: its exit status; 128 and the signal's number where one stopped it.
    """
    with subprocess.Popen(command) as process:
        heard = (signal.SIGINT, signal.SIGTERM)
        previous = {n: signal.signal(n, lambda n, _: process.send_signal(n)) for n in heard}
        try:
            return process.wait()
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def main(arguments: Iterable[str] | None = None) -> None:
    """Does what the command line says; an error is one line."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if chosen.trials < 1:
        parser.error(f"--trials must be at least 1, got {chosen.trials}")
    if chosen.sampler_seed < 0:
        parser.error(f"--sampler-seed must be at least 0, got {chosen.sampler_seed}")
    with told_in_a_line():
        search = Search(Path(chosen.output), chosen.settings, seed=chosen.sampler_seed)
        os.environ[MARK] = mark = uuid.uuid4().hex
        start_guard(mark)
        for number, values in search.trials(chosen.trials):
            told = ", ".join(f"{name}={short(value)}" for name, value in values.items())
            print(f"{search.name(number)}, {number + 1} of {chosen.trials}: {told}", flush=True)
            status = run_sweep(search.command(number, values))
            if status == 1:
                search.tell_failure(number)
            elif status:
                sys.exit(status if status > 0 else 128 - status)
            else:
                scores = (f"{name} {score:.4g}" for name, score in search.tell(number).items())
                print(f"{search.name(number)}: {', '.join(scores)}", flush=True)
        _report(search)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2.experiment.search",
        description=DESCRIPTION,
        epilog=EXAMPLE.lstrip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("settings", nargs="+", metavar="NAME=VALUE", help="as above")
    add("--trials", type=int, default=30, help="in all (default: 30)")
    add("--output", default="outputs/search", help="folder (default: outputs/search)")
    add("--sampler-seed", type=int, default=0, help="of Optuna's proposals (default: 0)")
    return parser


def _report(search: Search) -> None:
    folder, found = search.folder, find_runs(search.ended("COMPLETE"))
    records = [run.record for run in found.runs]
    if not records:
        raise UserError(
            "no trial has finished: above it is said why, and in the train.log of those runs below "
            f"{str(folder)!r} that began."
        )
    tasks = by_task(group_records(records))
    fronts = [front_table(groups, front_test(groups)) for groups in tasks]
    drawn = {
        f"front_{number}_{plain(groups[0].first.task)}.svg": partial(
            draw_front, groups, front_test(groups)
        )
        for number, groups in enumerate(tasks, 1)
    }
    names = ", ".join(path.name for path in search.ended("FAIL"))
    failed = [f"failed, and count for nothing: {names}"] if names else []
    notes = [*found.notes, *failed]
    page = write_report(folder / "report", records, found.runs, notes, fronts, drawn)
    tables = [table.markdown() for table in fronts]
    print(*tables, *failed, f"report: {page}", sep="\n\n")


if __name__ == "__main__":
    main()
