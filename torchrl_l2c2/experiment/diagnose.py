"""The command that writes a page of why policies shake: ``diagnosis/`` has what is on it."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from itertools import compress
from pathlib import Path

from torchrl_l2c2.experiment.diagnosis import (
    Diagnosis,
    comparison,
    diagnose_run,
    draw_together,
    findings,
    write_page,
)
from torchrl_l2c2.experiment.differences import differences
from torchrl_l2c2.experiment.environments import TEST_SEED
from torchrl_l2c2.experiment.errors import UserError, told_in_a_line
from torchrl_l2c2.experiment.files import make_folder_of, write_atomically
from torchrl_l2c2.experiment.reports.names import method_name, name_with_settings
from torchrl_l2c2.experiment.saved import read_config


def main(arguments: Iterable[str] | None = None) -> None:
    """Does what the command line says; an error is one line."""
    parser = _parser()
    chosen = parser.parse_args(arguments)
    above, chosen.folders = chosen.folders[0], _runs(chosen.folders)
    if chosen.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {chosen.episodes}")
    if chosen.names and len(chosen.names) != len(chosen.folders):
        parser.error(f"--names: one for each of the {len(chosen.folders)} runs, got {chosen.names}")
    if len(set(chosen.names or ())) < len(chosen.names or ()):
        parser.error(f"--names: each run needs one of its own, got {chosen.names}")
    if chosen.actions and not chosen.actions.endswith(".svg"):
        parser.error(f"--actions must be an SVG file, named FILE.svg, got {chosen.actions}")
    with told_in_a_line():
        # Before anything is played that could be lost.
        for given in filter(None, (chosen.output, chosen.actions)):
            make_folder_of(given)
        names = chosen.names or _names(chosen.folders)
        diagnoses = [
            diagnose_run(
                folder,
                name=name,
                episodes=chosen.episodes,
                seed=chosen.seed,
                noise_scale=chosen.noise,
                best=chosen.best,
                with_pictures=not chosen.no_video,
            )
            for folder, name in zip(chosen.folders, names, strict=True)
        ]
        path = Path(chosen.output or Path(above) / "diagnosis.html")
        write_page(path, diagnoses)
        if chosen.actions:
            write_atomically(chosen.actions, draw_together(diagnoses))
    compared = "\n".join(comparison(diagnoses))
    parts = [*map(_told, diagnoses), *([compared] if compared else []), f"page: {path}"]
    print("\n\n".join(parts))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2.experiment.diagnose",
        description="Writes one page that shows why the policies of runs shake, and says it.",
    )
    add = parser.add_argument
    add("folders", nargs="+", metavar="FOLDER", help="of runs, finished or not, at any depth")
    add("--names", nargs="+", help="what the runs are called (default: what tells them apart)")
    add("--output", help="the page (default: diagnosis.html in the first folder)")
    add("--actions", help="an SVG file for the actions of all runs, row by row (default: none)")
    add("--episodes", type=int, default=3, help="of the measures' means (default: 3)")
    add("--seed", type=int, default=TEST_SEED, help=f"of every policy (default: {TEST_SEED})")
    add("--noise", type=float, help="on observations (default: the task's)")
    add("--best", action="store_true", help="policy_best.pt instead of policy.pt")
    add("--no-video", action="store_true", help="draw no pictures of the task, which is quicker")
    return parser


def _told(one: Diagnosis) -> str:
    total, variation = (one.measures[name] for name in ("return", "action_variation"))
    head = f"{one.name}: return {total:.4g}, action variation {variation:.3g}"
    return "\n".join([head, *(f"  - {found.text}" for found in findings(one))])


def _runs(folders: Iterable[str]) -> list[str]:
    """Finds the runs at or below folders; a folder without any stays."""
    below = [sorted(Path(folder).rglob("config.json")) or [Path(folder, "_")] for folder in folders]
    return [str(path.parent) for paths in below for path in paths]


def _names(folders: Sequence[str]) -> list[str]:
    """What tells runs apart of task, algorithm, method and seed, or else of their folders' paths.

    Methods have the names that they have in tables.

    Examples:
        >>> _names(["a/sac/none/seed_0", "a/sac/caps/seed_0"])
        ['vanilla', 'CAPS']
        >>> _names(["a/sac/none/seed_0", "a/td3/none/seed_0", "b/sac/caps/seed_0"])
        ['sac/vanilla', 'td3/vanilla', 'sac/CAPS']
        >>> _names(["/a/sac/none/seed_0"])
        ['sac/vanilla/seed_0']
    """
    paths = [Path(folder).resolve().parts for folder in folders]
    if len(set(paths)) < len(paths):
        raise UserError("a run is named twice; its page would show the same thing twice.")
    paths = [tuple(map(method_name, path)) for path in paths]
    told = [each for each in map(_by_settings, map(Path, folders)) if each is not None]
    # Settings that no method's name tells are in the folders' own.
    if len(set(told)) == len(folders) > 1:
        differing = [len(set(each)) > 1 for each in zip(*told, strict=True)]
        return ["/".join(compress(each, differing)) for each in told]
    if len(paths) == 1:
        return ["/".join(paths[0][-3:])]
    longest = max(map(len, paths))
    length = next(n for n in range(1, longest + 1) if len({p[-n:] for p in paths}) == len(paths))
    ends = [path[-length:] for path in paths]
    while len({end[-1] for end in ends}) == 1:
        ends = [end[:-1] for end in ends]
    return ["/".join(end) for end in ends]


def _by_settings(folder: Path) -> tuple[str, ...] | None:
    """Task, algorithm, method and seed; ``None`` of a folder without settings."""
    try:
        config = read_config(folder)
        groups = ("task", "algorithm", "regularizer")
        task, algorithm, method = (config[group]["name"] for group in groups)
        name, _ = name_with_settings(method, differences(config))
    except (OSError, ValueError, KeyError):
        return None
    return task, algorithm, name, f"seed_{config['seed']}"


if __name__ == "__main__":
    main()
