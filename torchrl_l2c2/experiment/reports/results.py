"""What is said and drawn of runs when they end: one run's results, a sweep's table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_l2c2.experiment.files import write_json
from torchrl_l2c2.experiment.reports.choice import choice_table
from torchrl_l2c2.experiment.reports.faster_targets import faster_targets_table
from torchrl_l2c2.experiment.reports.field import field_table
from torchrl_l2c2.experiment.reports.figures import draw_learning_curves
from torchrl_l2c2.experiment.reports.gain_targets import gain_targets_table
from torchrl_l2c2.experiment.reports.groups import group_records
from torchrl_l2c2.experiment.reports.pairwise import pairwise_tables
from torchrl_l2c2.experiment.reports.paper_table import paper_table
from torchrl_l2c2.experiment.reports.records import QUANTITIES, Record
from torchrl_l2c2.experiment.reports.runs import FinishedRun, find_runs
from torchrl_l2c2.experiment.reports.tables import Table, results_tables
from torchrl_l2c2.experiment.saved import read_back

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.config import ExperimentConfig


def write_results(
    folder: Path, config: ExperimentConfig, tests: dict[str, dict[str, Any]]
) -> FinishedRun:
    """Writes what a finished run's folder holds beside its policy: test episodes and picture.

    Args:
        folder (Path): of the run.
        config (ExperimentConfig): its settings.
        tests (dict): ``"mean"`` and, where there is one, ``"sampled"``: ``"summary"`` and
            ``"episodes"`` of the test with the policy's mean and with samples.

    Returns:
        FinishedRun: the folder, read back.
    """
    named = {group: getattr(config, group).name for group in ("task", "algorithm", "regularizer")}
    run = {**named, "seed": config.seed, "solved_at": config.task.solved_at}
    rest = {name: test for name, test in tests.items() if name != "mean"}
    evaluation = {"run": run, **tests["mean"], **rest}
    draw_learning_curves([FinishedRun.read(folder, evaluation)], folder / "learning_curves.png")
    # Last, as it marks the run as finished.
    write_json(folder / "evaluation.json", evaluation)
    return FinishedRun.read(folder)


def compare_with_paper(run: FinishedRun) -> str:
    """The end of a run in lines: its results and, for the paper's tasks, the paper's.

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
                what = f"{own['episodes']} test {episodes}, seed {run.seed}"
                lines.append(_compared(name, total, variation, what))
    paper = run.record.paper
    if paper:
        lines.append(_compared("the paper", paper[:2], paper[2:], "18 seeds"))
    return "\n".join(lines)


def printed_tables(records: Sequence[Record]) -> list[Table]:
    """What is told of runs without a report: results, and beside them what was published."""
    groups = group_records(records)
    beside = (
        paper_table(groups),
        faster_targets_table(records),
        gain_targets_table(records),
        field_table(records),
        choice_table(records),
    )
    told = [table for table in beside if table is not None]
    return [*results_tables(groups), *told, *pairwise_tables(records)]


def sweep_summary(folders: Sequence[str | Path]) -> str:
    """The end of a sweep: tables of all runs below its folders, and what did not finish.

    Args:
        folders (sequence of str or Path): of its runs, or that hold them.

    Returns:
        str: Markdown; no error where nothing finished.
    """
    found = find_runs(folders)
    tables = printed_tables([run.record for run in found.runs]) if found.runs else []
    none = [] if found.runs else [f"No finished run below {', '.join(map(str, folders))}."]
    return "\n\n".join([*(table.markdown() for table in tables), *none, *found.notes])


def _compared(name: str, total: tuple[float, ...], variation: tuple[float, ...], what: str) -> str:
    return (
        f"{name:>20}  {total[0]:>9.1f} ({total[1]:>6.1f})  {variation[0]:>10.3f} "
        f"({variation[1]:.3f})   {what}"
    )
