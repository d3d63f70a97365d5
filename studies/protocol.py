"""Scores of variants of the experiment: distances from the paper's table (studies/protocol.md).

``python -m studies.protocol FOLDER... --length 200 300`` prints the scores of the runs below
folders, as if their training had ended after 200 and after 300 episodes.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from studies.cells import number_range
from studies.paper import is_of_paper, paper_of, paper_table
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.names import method_name
from torchrl_l2c2.experiment.analysis.reports.records import (
    find_runs,
    merge,
    read_records,
    records_of,
    write_records,
)
from torchrl_l2c2.experiment.analysis.reports.table import Table, or_dash
from torchrl_l2c2.experiment.errors import UserError, one_line_errors
from torchrl_l2c2.experiment.run.finished import QUANTITIES, TESTS, FinishedRun
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.identity import length_dependent_settings

METHODS = ("none", "caps")  # L2C2 is not looked at until a variant is frozen.
CAP = 5.0


@dataclass(frozen=True)
class Variant:
    """A choice of the open details on one task: its runs of the baseline and of CAPS."""

    baseline: Group
    caps: Group

    def cells(self, test: str) -> dict[tuple[str, str], float]:
        """By method and quantity, how many of the paper's standard deviations lie between.

        Args:
            test (str): one of ``TESTS``.

        Returns:
            dict: ``|mean over seeds - the paper's mean| / the paper's standard deviation``, at
            most 5; NaN where the runs do not have the test.
        """
        cells = {}
        for group in (self.baseline, self.caps):
            for quantity in QUANTITIES:
                published = paper_of(group)
                assert published is not None
                center, deviation = published.cell(quantity)
                values = group.scores(test, quantity)
                distance = abs(values.mean() - center) / deviation if len(values) else math.nan
                # A NaN first stays one.
                cells[group.first.method, quantity] = float(min(distance, CAP))
        return cells

    def score(self, test: str) -> float:
        """Mean of the four cells, from 0 to 5; smaller is nearer to the paper."""
        return statistics.fmean(self.cells(test).values())

    @property
    def updates(self) -> float:
        """Mean number of updates of the runs: fewer are preferred if the scores are close."""
        both = pd.concat([self.baseline.runs, self.caps.runs])
        return float(both["updates"].mean())


def variants(groups: Sequence[Group]) -> list[Variant]:
    """Pairs the baseline and CAPS on the paper's tasks if their other settings are the same."""
    found: dict[tuple[Any, ...], dict[str, list[Group]]] = {}
    for group in groups:
        if group.first.method in METHODS and paper_of(group) is not None:
            alike = found.setdefault(group.setup, {method: [] for method in METHODS})
            alike[group.first.method].append(group)
    # Groups of older defaults make further pairs.
    return [
        Variant(*pair)
        for alike in found.values()
        for pair in product(*(alike[method] for method in METHODS))
    ]


def score_table(found: Sequence[Variant]) -> Table:
    """The score of every variant, by late policies with mean and with sampled actions."""
    columns = ["task", "variant", "length", "seeds", "updates", "actions", "score"]
    columns += [
        f"{method_name(method)}: {name}" for method in METHODS for name in QUANTITIES.values()
    ]
    rows = []
    for variant in found:
        first = variant.baseline.first
        others = [f"{name}={value}" for name, value in variant.baseline.settings.items()]
        start = [first.task, " ".join(others) or "the defaults", first.length]
        seeds = list(dict.fromkeys(number_range(g.seeds) for g in (variant.baseline, variant.caps)))
        for test in ("late_mean", "late_sampled"):
            cells = variant.cells(test)
            if all(map(math.isnan, cells.values())):
                continue
            rows.append(
                [
                    *(*start, "; ".join(seeds)),
                    *(f"{variant.updates:.0f}", TESTS[test].split(", ")[1]),
                    or_dash(variant.score(test), ".2f"),
                    *(or_dash(cells[m, q], ".2f") for m in METHODS for q in QUANTITIES),
                ]
            )
    notes = [
        "Cells: the distance of the mean over seeds from the paper's mean, in the paper's standard "
        "deviations, at most 5; the score is their mean, smaller is nearer. Late policies."
    ]
    return Table("Score of the variants", columns, rows, notes)


def until(run: FinishedRun, length: int) -> FinishedRun | None:
    """The run as if its training had ended earlier; ``None`` if it was shorter than that.

    Of a longer run only the training's own episodes, with sampled actions, are known.

    Args:
        run (FinishedRun): The run, returned unchanged if it ended just then.
        length (int): The length in episodes, or in frames if the run's own length is in frames.
    """
    unit = "episodes" if run.config["task"].get("frames") is None else "frames"
    if run.record.length == f"{length} {unit}":
        return run
    column = run.column("episode" if unit == "episodes" else "frames")
    if not column or not 0 < length <= column[-1]:
        return None
    # Training ends with the episode that reaches its length.
    kept = [
        {name: cell for name, cell in row.items() if not name.startswith("test_")}
        for row, before in zip(run.metrics, [0.0, *column[:-1]], strict=True)
        if before < length
    ]
    config = {**run.config, "task": {**run.config["task"], unit: length}}
    return replace(run, config=config, evaluation={}, metrics=kept)


def main(arguments: Iterable[str] | None = None) -> None:
    """The command line: prints scores and the paper's table with these runs."""
    parser = argparse.ArgumentParser(prog="python -m studies.protocol", description=__doc__)
    add = parser.add_argument
    add("paths", nargs="+", metavar="PATH", help="folders of runs, or files of records (CSV)")
    add("--length", nargs="+", type=int, metavar="N", help="episodes, or frames, of training")
    add("--csv", metavar="CSV", help="file that gets a line for every run, or its newer line")
    chosen = parser.parse_args(arguments)
    with one_line_errors():
        records, notes = _read(chosen.paths, chosen.length)
        if chosen.csv:
            write_records(chosen.csv, merge(read_records(chosen.csv), records))
        groups = group_records(records)
        tables = [paper_table([group for group in groups if is_of_paper(group)])]
        if found := variants(groups):
            tables.insert(0, score_table(found))
        print("\n\n".join([*(table.markdown() for table in tables), *notes]))


def _read(paths: Sequence[str], lengths: Sequence[int] | None) -> tuple[pd.DataFrame, list[str]]:
    files = [path for path in paths if Path(path).is_file()]
    found = find_runs(path for path in paths if path not in files)
    if lengths is None:
        return merge(*map(read_records, files), records_of(found.runs)), found.notes
    if files:
        raise UserError(f"Expected folders of runs with --length, got the file {files[0]!r}.")
    cut = [each for run in found.runs for n in lengths if (each := until(run, n)) is not None]
    if not cut:
        raise UserError(
            f"Expected runs of {min(lengths)} episodes or frames, got shorter ones. Name a smaller "
            "--length."
        )
    shorter = [ExperimentConfig.from_dict(run.config) for run in cut if not run.evaluation]
    settings = Counter(
        setting for config in shorter for setting in length_dependent_settings(config)
    )
    notes = [
        f"{many} runs, cut to a length, have {setting} as in their own, longer training: a "
        "training of this length would give other numbers"
        for setting, many in settings.items()
    ]
    return merge(records_of(cut)), [*found.notes, *notes]


if __name__ == "__main__":
    main()
