"""``diagnose``: writes a page that shows why policies shake."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.errors import one_line_errors


def main(arguments: Sequence[str] | None = None) -> None:
    """Measures runs or recordings, writes the page, and prints the findings."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    if chosen.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {chosen.episodes}")
    if len(set(chosen.names or ())) < len(chosen.names or ()):
        parser.error(f"--names must differ from each other, got {chosen.names}")
    with one_line_errors():
        from torchrl_l2c2.experiment.analysis import diagnosis
        from torchrl_l2c2.experiment.envs.environments import TEST_SEED
        from torchrl_l2c2.experiment.run.files import check_output, write_atomically

        folders = diagnosis.run_folders(chosen.folders)
        if chosen.names and len(chosen.names) != len(folders):
            parser.error(f"--names must have {len(folders)} names, one per run, got {chosen.names}")
        if (chosen.bounds or chosen.columns) and not any(map(_is_recording, folders)):
            parser.error("--bounds and --columns are of recorded actions: no CSV file was given")
        first = Path(chosen.folders[0])
        page = (
            first.with_name(f"{first.stem}_diagnosis.html")
            if _is_recording(first)
            else first / "diagnosis.html"
        )
        path = Path(chosen.output or page)
        # Before the episodes, whose results could otherwise be lost.
        if chosen.output or page.parent.is_dir():  # Otherwise the missing run is reported below.
            check_output(path, ".html")
        if chosen.actions:
            check_output(chosen.actions, ".svg")
        names = chosen.names or diagnosis.run_names(folders)
        diagnoses = [
            diagnosis.diagnose_recording(
                folder, name=name, columns=chosen.columns, bounds=chosen.bounds
            )
            if _is_recording(folder)
            else diagnosis.diagnose_run(
                folder,
                name=name,
                episodes=chosen.episodes,
                seed=TEST_SEED if chosen.seed is None else chosen.seed,
                noise_scale=chosen.noise,
                best=chosen.best,
                with_pictures=not chosen.no_video,
            )
            for folder, name in zip(folders, names, strict=True)
        ]
        diagnosis.write_page(path, diagnoses)
        if chosen.actions:
            write_atomically(chosen.actions, diagnosis.draw_together(diagnoses))
    compared = "\n".join(diagnosis.comparison(diagnoses))
    parts = [*map(diagnosis.summary, diagnoses), compared, f"page: {path}"]
    print("\n\n".join(filter(None, parts)))


def _is_recording(path: str | Path) -> bool:
    return Path(path).suffix.lower() == ".csv"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 diagnose",
        description="Writes a page that shows why policies shake.",
    )
    add = parser.add_argument
    add(
        "folders",
        nargs="+",
        metavar="FOLDER",
        help="run folders, folders that contain runs, or CSV files of recorded actions: a column "
        "for each action, a row for each control step, and optionally a column named time, in "
        "seconds. Every run is compared with the first one, which in a folder is a baseline",
    )
    add("--names", nargs="+", help="names of the runs (default: the settings that differ)")
    add(
        "--output",
        help="HTML file (default: diagnosis.html in the first folder, or NAME_diagnosis.html next "
        "to NAME.csv)",
    )
    add(
        "--bounds",
        nargs=2,
        action="append",
        type=float,
        metavar=("LOW", "HIGH"),
        help="bounds of all recorded actions, or repeated, of each action in the order of the "
        "columns (default: the smallest and largest of each action)",
    )
    add("--actions", help="SVG file for the actions of all runs, row by row (default: none)")
    add("--columns", nargs="+", help="columns that are actions (default: all but time)")
    add("--episodes", type=int, default=3, help="number of measured episodes (default: 3)")
    add("--seed", type=int, help="random seed, the same for all runs (default: 1000003)")
    add(
        "--noise",
        type=float,
        help="standard deviation of the noise on observations (default: the task's)",
    )
    add("--best", action="store_true", help="policy_best.pt instead of policy.pt")
    add("--no-video", action="store_true", help="no video of the task, which is faster")
    return parser
