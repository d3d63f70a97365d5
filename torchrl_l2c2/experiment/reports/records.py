"""A run as one line of ``results/runs.csv``, from which every table can be made."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.files import make_folder, write_atomically
from torchrl_l2c2.experiment.identity import BUDGETS
from torchrl_l2c2.experiment.reports.differences import read_differences
from torchrl_l2c2.experiment.reports.names import method_order
from torchrl_l2c2.experiment.reports.paper import TAU, Published, paper_of
from torchrl_l2c2.experiment.saved import read_rows
from torchrl_l2c2.experiment.tasks import TASKS

# Which policies act, and how: the last policy's test episodes, or one episode of every policy
# late in training; with mean actions, or with samples as in training.
TESTS = {
    "late_mean": "late policies, mean actions",
    "late_sampled": "late policies, sampled actions",
    "last_mean": "last policy, mean actions",
    "last_sampled": "last policy, sampled actions",
}
QUANTITIES = {"return": "return", "action_variation": "action variation"}


@dataclass(frozen=True)
class Record:
    """What is kept of a finished run; a number that is not known is NaN, an empty cell.

    Attributes:
        method: the regularizer's name.
        length: how long it was trained, such as ``"400 episodes"``.
        settings: :func:`~.differences.fingerprint` of the others.
        differences: what differs from the defaults, such as ``"algorithm.replay_ratio=10"``.
        late_mean_return: mean over the late policies (those of ``late_share``) of a test episode
            with mean actions.
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

    @property
    def place(self) -> tuple[Any, ...]:
        """Sorts as tables do: the paper's order, and what differs least from the defaults first.

        What differs in the regularizer alone, and so is compared, is together.
        """
        task = list(TASKS).index(self.task) if self.task in TASKS else len(TASKS)
        words = {k: f"{k}={v}" for k, v in self.settings_of_any_length.items()}
        own = [word for name, word in words.items() if name.startswith("regularizer.")]
        others = [word for word in words.values() if word not in own]
        amount, unit = self.length.split()
        reading = (len(others), others, unit, int(amount))
        method = (*method_order(self.method), len(own), own, self.settings)
        return (task, self.task, self.algorithm, *reading, *method, self.seed)

    def value(self, test: str, quantity: str) -> float:
        """By the names of ``TESTS`` and ``QUANTITIES``; ``last_mean`` has ``sm_asap`` too.

        ``policy_scale`` is of the late policies, whatever the test.
        """
        known = quantity if quantity == "policy_scale" else f"{test}_{quantity}"
        value: float = getattr(self, known)
        return value

    @property
    def is_tested(self) -> bool:
        """Whether its last policy was, by its means or samples of it."""
        tests = (self.last_mean_return, self.last_sampled_return)
        return not all(map(math.isnan, tests))

    @cached_property
    def other_settings(self) -> dict[str, str]:
        """What differs from the defaults, by name."""
        return read_differences(self.differences)

    @cached_property
    def settings_of_any_length(self) -> dict[str, str]:
        """Of these all but how long is trained, which :attr:`length` says."""
        return {k: v for k, v in self.other_settings.items() if k not in BUDGETS}

    @property
    def is_of_own_task(self) -> bool:
        """Whether the simulator, its noise and its longest episode are those of the task's name."""
        of_task = {"task.env_id", "task.noise_scale", "task.max_steps"}
        return not of_task & self.other_settings.keys()

    @property
    def paper(self) -> Published | None:
        """The paper's results, where the task, the algorithm and the regularizer are the paper's.

        And the targets' pace, which the paper varies. What else it leaves open may differ; tables
        tell it below.
        """
        if not self.is_of_own_task or any(
            name.startswith(("regularizer.", TAU)) for name in self.other_settings
        ):
            return None
        return paper_of(self.task, self.algorithm, self.method)


def read_records(path: str | Path) -> list[Record]:
    """Reads what :func:`write_records` wrote; an empty or absent file has none.

    Raises:
        ValueError: the file has other columns, a line that is cut, or a cell that is no number
            where one must be.
    """
    path = Path(path)
    columns, lines = read_rows(path) if path.exists() else ([], [])
    names = [field.name for field in fields(Record)]
    if columns and columns != names:
        raise ValueError(f"{path} has the columns {columns}; they must be {names}.")
    return merge([], (_parse(path, number, line) for number, line in enumerate(lines, start=2)))


def write_records(path: str | Path, records: Iterable[Record]) -> None:
    """Writes records as CSV, sorted, whole or not at all; the same records give the same bytes."""
    make_folder(Path(path).parent)
    write_atomically(path, _written(records))


def digest(records: Iterable[Record]) -> str:
    """What tells these records from all others, as a picture of them says in its description."""
    return hashlib.sha256(_written(records)).hexdigest()[:12]


def _written(records: Iterable[Record]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(field.name for field in fields(Record))
    for record in sorted(records, key=lambda record: record.place):
        writer.writerow(_cell(getattr(record, field.name)) for field in fields(Record))
    return text.getvalue().encode()


def merge(old: Iterable[Record], new: Iterable[Record]) -> list[Record]:
    """Old and new records, sorted; a run's newer record takes the place of its older one.

    But not one without its last policy's tests: that of a longer run, cut to the same length.
    """
    merged: dict[tuple[str | int, ...], Record] = {}
    for record in (*old, *new):
        older = merged.get(record.identity)
        if older is None or record.is_tested or not older.is_tested:
            merged[record.identity] = record
    return sorted(merged.values(), key=lambda record: record.place)


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return "" if math.isnan(value) else f"{value:.6g}"


def _number(cell: str) -> float:
    """NaN of an empty cell: what is not known."""
    if cell and not math.isfinite(float(cell)):
        raise ValueError(f"a cell must be a finite number or empty, got {cell!r}")
    return float(cell or "nan")


def _parse(path: Path, number: int, line: dict[str, str]) -> Record:
    readers: dict[str, Callable[[str], Any]] = {"int": int, "float": _number, "str": str}
    try:
        read_differences(line["differences"])
        if not re.fullmatch(r"\d+ (episodes|frames)", line["length"]):
            raise ValueError(f"length must be '<N> episodes' or frames, got {line['length']!r}")
        return Record(**{f.name: readers[str(f.type)](line[f.name]) for f in fields(Record)})
    except ValueError as error:
        raise ValueError(f"{path}, line {number}: {error}.") from None
