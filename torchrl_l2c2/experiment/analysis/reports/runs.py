"""The finished runs below some folders, and notes on what else lies there."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.analysis.reports.records import place
from torchrl_l2c2.experiment.run.finished import LATE, FinishedRun


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
    return Found(sorted(newest, key=lambda run: place(run.record)), notes)


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
                where = path.parent.resolve()
                marks.setdefault(where, set()).add(name)
                shown.setdefault(where, path.parent)
    stages: dict[str, list[Path]] = {"finished": [], "unfinished": []}
    for where in sorted(marks):
        stage = "finished" if "evaluation.json" in marks[where] else "unfinished"
        stages[stage].append(shown[where])
    return stages


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
