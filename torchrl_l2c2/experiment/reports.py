"""Pictures and tables of finished runs, beside the paper's numbers.

``python -m torchrl_l2c2.experiment.reports outputs/swingup`` reads every run below a folder,
prints their table and draws their learning curves.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_l2c2.experiment.folder import write_atomically, write_json

if TYPE_CHECKING:
    from torchrl_l2c2.experiment.config import ExperimentConfig

# Kobayashi (2022), Table III: return and L2 norm of temporal actions, mean and (over 18 seeds)
# standard deviation.
PAPER: dict[tuple[str, str], tuple[float, float, float, float]] = {
    ("swingup", "none"): (649.57, 77.96, 0.084, 0.011),
    ("reacher", "none"): (14.73, 4.34, 0.132, 0.032),
    ("hopper", "none"): (1561.85, 879.99, 0.157, 0.097),
    ("ant", "none"): (2724.32, 341.46, 0.635, 0.090),
    ("swingup", "caps"): (239.57, 26.56, 0.026, 0.002),
    ("reacher", "caps"): (-1.57, 1.53, 0.003, 0.001),
    ("hopper", "caps"): (762.20, 321.26, 0.004, 0.001),
    ("ant", "caps"): (911.36, 98.33, 0.002, 0.001),
    ("swingup", "l2c2"): (693.77, 123.78, 0.075, 0.012),
    ("reacher", "l2c2"): (15.42, 4.04, 0.096, 0.018),
    ("hopper", "l2c2"): (2091.76, 563.82, 0.174, 0.055),
    ("ant", "l2c2"): (2762.75, 536.85, 0.531, 0.150),
    ("swingup", "l2c2_policy"): (707.41, 40.94, 0.075, 0.010),
    ("reacher", "l2c2_policy"): (15.81, 4.196, 0.095, 0.023),
    ("hopper", "l2c2_policy"): (1998.54, 714.88, 0.141, 0.063),
    ("ant", "l2c2_policy"): (2690.26, 483.62, 0.521, 0.142),
}
METHODS = {
    "none": ("vanilla", "#777777"),
    "caps": ("CAPS", "#d95f02"),
    "l2c2": ("L2C2", "#1b6ca8"),
    "l2c2_policy": ("L2C2, beta = 0", "#7570b3"),
}


@dataclass(frozen=True)
class FinishedRun:
    """One run's folder, read back: its settings, its learning curve and its test episodes."""

    folder: Path
    task: str
    algorithm: str
    regularizer: str
    seed: int
    solved_at: float | None
    evaluation: dict[str, Any]
    metrics: list[dict[str, str]]

    @classmethod
    def read(cls, folder: Path) -> FinishedRun:
        """Reads a run's folder; ``evaluation.json`` marks it as finished."""
        evaluation = json.loads((folder / "evaluation.json").read_text())
        with open(folder / "metrics.csv", newline="") as file:
            metrics = list(csv.DictReader(file))
        run = evaluation["run"]
        return cls(
            folder,
            run["task"],
            run["algorithm"],
            run["regularizer"],
            run["seed"],
            run["solved_at"],
            evaluation,
            metrics,
        )


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
    write_json(folder / "evaluation.json", {"run": run, **tests["mean"], **rest})
    finished = FinishedRun.read(folder)
    draw_learning_curves([finished], folder / "learning_curves.png")
    return finished


def finished_run(folder: str | Path, settings: dict[str, Any]) -> FinishedRun | None:
    """The finished run of these very settings in a folder; ``None`` where there is none."""
    folder = Path(folder)
    if not (folder / "evaluation.json").exists():
        return None
    saved = json.loads((folder / "config.json").read_text())
    # As JSON, where a tuple and a list are the same.
    return FinishedRun.read(folder) if saved == json.loads(json.dumps(settings)) else None


def read_runs(folder: str | Path) -> list[FinishedRun]:
    """Every finished run below a folder, in the order of method and seed.

    Raises:
        FileNotFoundError: there is none.
    """
    runs = [FinishedRun.read(path.parent) for path in Path(folder).rglob("evaluation.json")]
    if not runs:
        raise FileNotFoundError(
            f"no finished run (evaluation.json) below {str(folder)!r}; name a folder of train.py's."
        )
    return sorted(runs, key=lambda run: (run.task, run.algorithm, _order(run), run.seed))


def _order(run: FinishedRun) -> int:
    return list(METHODS).index(run.regularizer) if run.regularizer in METHODS else len(METHODS)


def table(runs: Sequence[FinishedRun]) -> str:
    """A Markdown table: a row per task, algorithm and method, beside the paper's.

    Each figure is the mean over seeds of the mean over test episodes, with the standard deviation
    over seeds in brackets; the seeds' own figures stand behind it, in order.
    """
    groups: dict[tuple[str, str, str], list[FinishedRun]] = defaultdict(list)
    for run in runs:
        groups[run.task, run.algorithm, run.regularizer].append(run)
    lines = [
        "| task | algorithm | method | seeds | return | action variation "
        "| paper: return | paper: action variation |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (task, algorithm, regularizer), group in groups.items():
        returns = [run.evaluation["summary"]["return_mean"] for run in group]
        variations = [run.evaluation["summary"]["action_variation_mean"] for run in group]
        paper = PAPER.get((task, regularizer)) if algorithm == "ppo_rpe" else None
        cells = [
            task,
            algorithm,
            _method(regularizer),
            ", ".join(str(run.seed) for run in group),
            _figure(returns, ".1f"),
            _figure(variations, ".3f"),
            f"{paper[0]:.1f} ({paper[1]:.1f})" if paper else "",
            f"{paper[2]:.3f} ({paper[3]:.3f})" if paper else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _figure(values: Sequence[float], spec: str) -> str:
    each = ", ".join(format(value, spec) for value in values)
    if len(values) == 1:
        return each
    return f"{statistics.fmean(values):{spec}} ({statistics.stdev(values):{spec}}): {each}"


def _method(regularizer: str) -> str:
    return METHODS.get(regularizer, (regularizer, ""))[0]


def draw_learning_curves(runs: Sequence[FinishedRun], path: str | Path) -> None:
    """Draws return and action variation against frames: a thin line per run, smoothed by method.

    Args:
        runs (sequence of FinishedRun): of one task.
        path (str or Path): of the PNG file.
    """
    # Imported here: drawing takes a second to import and no other function needs it.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    panels = (("return", "return"), ("action_variation", "action variation (smaller: smoother)"))
    for axis, (column, label) in zip(axes, panels, strict=True):
        named: set[str] = set()
        for run in runs:
            name, color = METHODS.get(run.regularizer, (run.regularizer, "#444444"))
            frames = [int(row["frames"]) for row in run.metrics]
            values = [float(row[column]) for row in run.metrics]
            axis.plot(frames, values, color=color, alpha=0.2, linewidth=0.7)
            axis.plot(
                frames,
                _moving_average(values),
                color=color,
                linewidth=1.6,
                label=None if name in named else name,
            )
            named.add(name)
        axis.set_xlabel("thousand frames")
        axis.xaxis.set_major_formatter(lambda frames, _: f"{frames / 1000:g}")
        axis.set_ylabel(label)
        axis.grid(alpha=0.25)
    if runs[0].solved_at is not None:
        axes[0].axhline(runs[0].solved_at, color="black", linestyle=":", linewidth=1)
    axes[0].legend(frameon=False)
    figure.suptitle(f"{runs[0].task}, {runs[0].algorithm}: training episodes and their mean of 10")
    _save(figure, path)


def _moving_average(values: Sequence[float], window: int = 10) -> list[float]:
    return [
        statistics.fmean(values[max(0, end - window) : end]) for end in range(1, len(values) + 1)
    ]


def _save(figure: Any, path: str | Path) -> None:
    import io

    content = io.BytesIO()
    figure.savefig(content, dpi=110, format="png")
    write_atomically(path, content.getvalue())


def compare_with_paper(run: FinishedRun) -> str:
    """The end of a run in lines: its results and, for the paper's tasks, the paper's."""
    lines = [f"{'':>20}  {'return':>18}  {'action variation':>18}"]
    tests = {"mean actions": run.evaluation, "sampled actions": run.evaluation.get("sampled")}
    for name, test in tests.items():
        if test is not None:
            own = test["summary"]
            lines.append(
                _compared(
                    name,
                    (own["return_mean"], own["return_std"]),
                    (own["action_variation_mean"], own["action_variation_std"]),
                    f"{own['episodes']} test episodes, seed {run.seed}",
                )
            )
    paper = PAPER.get((run.task, run.regularizer)) if run.algorithm == "ppo_rpe" else None
    if paper:
        lines.append(_compared("the paper", paper[:2], paper[2:], "18 seeds"))
    return "\n".join(lines)


def _compared(name: str, total: tuple[float, ...], variation: tuple[float, ...], what: str) -> str:
    return (
        f"{name:>20}  {total[0]:>9.1f} ({total[1]:>6.1f})  {variation[0]:>10.3f} "
        f"({variation[1]:.3f})   {what}"
    )


def main(arguments: Iterable[str] | None = None) -> None:
    """The command line: prints the table and draws one picture per task and algorithm."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2.experiment.reports", description=(__doc__ or "").strip()
    )
    parser.add_argument("folder", help="a folder of runs, e.g. outputs/swingup")
    folder = Path(parser.parse_args(arguments).folder)
    try:
        runs = read_runs(folder)
    except FileNotFoundError as error:
        sys.exit(f"error: {error}")
    print(table(runs))
    for task, algorithm in dict.fromkeys((run.task, run.algorithm) for run in runs):
        path = folder / f"learning_curves_{task.replace('/', '_')}_{algorithm}.png"
        draw_learning_curves([r for r in runs if (r.task, r.algorithm) == (task, algorithm)], path)
        print(f"picture: {path}")


if __name__ == "__main__":
    main()
