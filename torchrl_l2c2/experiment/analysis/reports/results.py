"""The results that a run and a sweep print and write when they end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.analysis.reports.comparison import comparison_table, known_tests
from torchrl_l2c2.experiment.analysis.reports.groups import group_records
from torchrl_l2c2.experiment.analysis.reports.runs import find_runs
from torchrl_l2c2.experiment.analysis.reports.tables import settings_notes
from torchrl_l2c2.experiment.run.files import read_back
from torchrl_l2c2.experiment.run.finished import QUANTITIES, FinishedRun, Record


def result_lines(run: FinishedRun) -> str:
    """The end of a run in lines: return and action variation of its test episodes.

    Raises:
        ValueError: its folder is damaged.
    """
    lines = [f"{'':>20}  {'return':>18}  {'action variation':>18}"]
    tests = {"mean actions": run.evaluation, "sampled actions": run.evaluation.get("sampled")}
    for name, test in tests.items():
        own = (test or {}).get("summary")
        if own is not None:
            with read_back(run.folder):
                total, variation = ((own[f"{q}_mean"], own[f"{q}_std"]) for q in QUANTITIES)
                episodes = "episode" if own["episodes"] == 1 else "episodes"
                lines.append(
                    f"{name:>20}  {total[0]:>9.1f} ({total[1]:>6.1f})  {variation[0]:>10.3f} "
                    f"({variation[1]:.3f})   {own['episodes']} test {episodes}, seed {run.seed}"
                )
    return "\n".join(lines)


def printed_table(records: Sequence[Record]) -> str:
    """The table that is printed of runs: of the last policy with mean actions, if it was tested."""
    groups = group_records(records)
    tables = [comparison_table(test, groups).markdown() for test in known_tests(groups)[:1]]
    return "\n\n".join([*tables, *settings_notes(groups)])


def sweep_summary(folders: Sequence[str | Path]) -> str:
    """The end of a sweep: a table of all runs below its folders, and what did not finish.

    Args:
        folders (sequence of str or Path): of its runs, or that hold them.

    Returns:
        str: Markdown; no error where nothing finished.
    """
    found = find_runs(folders)
    if not found.runs:
        return "\n\n".join([f"No finished run below {', '.join(map(str, folders))}.", *found.notes])
    return "\n\n".join([printed_table([run.record for run in found.runs]), *found.notes])
