"""Timing things alternately, and the table that comes of it."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

PACKAGES = (
    "torch",
    "torchrl",
    "tensordict",
    "gymnasium",
    "pybullet",
    "numpy",
    "stable-baselines3",
    "sbx-rl",
    "jax",
    "brax",
)


@dataclass
class Row:
    """A line of the table.

    Attributes:
        group: the name that ``--rows`` knows it by.
        name: the compared things.
        value: the ratio, or the seconds; ``None`` where it was not measured.
        unit: ``"ratio"`` or ``"s"``.
        at_least: the smallest value that is fast enough, if that is the direction.
        at_most: the largest one, if that is.
        parts: what the value was made from; the unit is the end of the name.
        note: why it was not measured.
    """

    group: str
    name: str
    value: float | None = None
    unit: str = "ratio"
    at_least: float | None = None
    at_most: float | None = None
    parts: dict[str, float] = field(default_factory=dict)
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Checks whether the value is fast enough; ``None`` without a value or a limit."""
        if self.value is None:
            return None
        if self.at_least is not None:
            return self.value >= self.at_least
        return None if self.at_most is None else self.value <= self.at_most

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {**asdict(self), "met": self.met}


def alternate(
    actions: Mapping[str, Callable[[], object]], *, repeats: int, calls: int = 1, warm_up: int = 1
) -> dict[str, float]:
    """Times actions in turns, so other work of the machine slows all of them.

    Args:
        actions (Mapping): The timed actions, by name. An action that returns a number has done so
            many units of work, such as frames; any other has done one.

    Keyword Args:
        repeats (int): rounds; in each, every action has its turn.
        calls (int): calls of an action in a turn.
        warm_up (int): calls of each before.

    Returns:
        dict: the median over the rounds of seconds per unit.
    """
    seconds = take_turns(actions, repeats=repeats, calls=calls, warm_up=warm_up)
    return {name: statistics.median(values) for name, values in seconds.items()}


def take_turns(
    actions: Mapping[str, Callable[[], object]],
    *,
    repeats: int,
    calls: int = 1,
    warm_up: int = 1,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, list[float]]:
    """Times actions as :func:`alternate` does; returns the seconds per unit of every round."""
    for action in actions.values():
        for _ in range(warm_up):
            action()
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(repeats):
        for name, action in actions.items():
            units = 0
            start = clock()
            for _ in range(calls):
                done = action()
                units += done if isinstance(done, int) else 1
            seconds[name].append((clock() - start) / units)
    return seconds


def machine() -> dict[str, Any]:
    """The machine and the versions of a measurement."""
    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "threads": torch.get_num_threads(),
        "commit": _commit(),
        "versions": {name: found for name in PACKAGES if (found := _version(name))},
    }


def to_markdown(rows: list[Row], where: Mapping[str, Any], command: str) -> str:
    """The table with its commit, its machine and its command, for a page in ``results/``."""
    lines = [
        "| row | value | limit | met | from |",
        "| --- | --- | --- | --- | --- |",
        *(
            f"| {row.name} | {_value(row)} | {_limit(row)} | {_MET[row.met]} | {_parts(row)} |"
            for row in rows
        ),
        "",
        f"Commit {where['commit']}: {where['cpu']}, {where['cores']} cores, load "
        f"{where['load']:.1f} at the start; "
        f"{where['threads']} thread; "
        + ", ".join(f"{name} {found}" for name, found in where["versions"].items())
        + f", Python {where['python']}.",
        "",
        *("```bash", command, "```"),
    ]
    return "\n".join(lines)


def fill_page(page: str, table: str) -> str:
    """The page with a table between its marks; the table itself if the page has none."""
    start, end = "<!-- speed: start -->", "<!-- speed: end -->"
    before, marked, rest = page.partition(start)
    if not marked:
        return table + "\n"
    return f"{before}{start}\n{table}\n{end}{rest.partition(end)[2]}"


def to_text(row: Row) -> str:
    """A line for the terminal."""
    return f"{row.name}: {_value(row)} ({_limit(row)}; {_MET[row.met]})  {_parts(row)}".rstrip()


_MET = {True: "yes", False: "no", None: "-"}


def _value(row: Row) -> str:
    if row.value is None:
        return row.note
    return f"{row.value:.2f}" + ("" if row.unit == "ratio" else f" {row.unit}")


def _limit(row: Row) -> str:
    if row.at_least is not None:
        return f"at least {row.at_least:g}"
    return "-" if row.at_most is None else f"at most {row.at_most:g}"


def _parts(row: Row) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in row.parts.items())


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> str:
    describe = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    try:
        told = subprocess.run(
            describe, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        # A copy without the repository can be told its commit.
        return os.environ.get("COMMIT", "unknown")
    return told.stdout.strip()


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None
