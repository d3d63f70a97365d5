"""Writes the page of the measurements on a GPU, from the files of ``benchmarks/gpu.sh``.

``python -m studies.gpu FOLDER`` writes ``gpu.md`` into the folder of results. A part without a file
is named as not measured.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

from studies.cost import cost_table
from studies.files import ROOT
from torchrl_l2c2.experiment.analysis.reports.table import pipe_table
from torchrl_l2c2.experiment.run.files import write_atomically

PAGE = ROOT / "results" / "gpu.md"
NOT_MEASURED = "Not measured."


def gpu_page(folder: Path) -> str:
    """The page as Markdown.

    Args:
        folder: the folder with ``cost.json``, ``tests.json``, ``speed.json`` and ``brax.json``.

    Raises:
        FileNotFoundError: the folder has none of them.
    """
    parts = {}
    for name in ("cost", "tests", "speed", "brax"):
        path = folder / f"{name}.json"
        if path.exists():
            parts[name] = json.loads(path.read_text())
    if not parts:
        raise FileNotFoundError(
            f"Expected results of benchmarks/gpu.sh in {folder}, got none. "
            f"Run it with OUT={folder}."
        )
    where = next(iter(parts.values()))["machine"]
    quick = any(part.get("quick") for part in parts.values())
    lines = [
        "# On a GPU",
        "",
        f"`benchmarks/gpu.sh`, then `python -m studies.gpu FOLDER`; commit {where['commit']}, "
        f"{where['cuda'] or 'no GPU: ' + where['cpu']}, Python {where['python']}, "
        + ", ".join(f"{name} {found}" for name, found in where["versions"].items())
        + ".",
        *(["", "**These are the numbers of a quick run, which say nothing.**"] if quick else []),
    ]
    sections = {
        "What a regularizer costs": ("cost", cost_table),
        "Compiled updates": ("speed", speed_table),
        "PPO on Brax's Ant": ("brax", brax_table),
        "Tests that need a GPU": ("tests", tests_table),
    }
    for title, (name, make) in sections.items():
        text = make(parts[name]) if name in parts else NOT_MEASURED
        lines += ["", f"## {title}", "", text]
    return "\n".join(lines) + "\n"


def speed_table(measured: Mapping[str, Any]) -> str:
    """Ratios of the rows of ``benchmarks.speed``, with their parts."""
    rows = [["row", "value", "from"]]
    for row in measured["rows"]:
        value = row["note"] if row["value"] is None else f"{row['value']:.2f}"
        parts = ", ".join(f"{name} {part:.4g}" for name, part in row["parts"].items())
        rows.append([row["name"], value, parts])
    return pipe_table(rows)


def brax_table(measured: Mapping[str, Any]) -> str:
    """Time and results of the trainings, with and without L2C2."""
    if measured["note"]:
        return f"{measured['note'].capitalize()}."
    rows = [["method", "iterations", "s until the first", "s of each further one (median)"]]
    rows[0] += ["reward of a step in the last", "action variation in the last"]
    for run in measured["runs"]:
        found = run["iterations"]
        count = f"{len(found)}{'' if run['ended'] else ', stopped'}"
        cells = [run["method"], count]
        if found:
            times = [each["seconds"] for each in found]
            further = [b - a for a, b in pairwise(times)]
            cells += [f"{times[0]:.1f}", f"{statistics.median(further):.2f}" if further else ""]
            cells += [f"{found[-1][key]:.3f}" for key in ("reward", "action_variation")]
        rows.append(cells + [""] * (len(rows[0]) - len(cells)))
    return (
        f"`{measured['command']}`, and with `--baseline`; one seed, at most "
        f"{measured['limit']:g} s each. The first iteration includes the compilation."
        f"\n\n{pipe_table(rows)}"
    )


def tests_table(measured: Mapping[str, Any]) -> str:
    """The outcome of each test."""
    rows = [["test", "outcome", "s"]]
    for test in measured["tests"]:
        rows.append([f"`{test['test']}`", test["outcome"], f"{test['seconds']:.1f}"])
    return pipe_table(rows)


def main(arguments: list[str] | None = None) -> None:
    """Writes the page."""
    parser = argparse.ArgumentParser(prog="python -m studies.gpu", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder that benchmarks/gpu.sh wrote to")
    parser.add_argument("--output", type=Path, default=PAGE, help="page to write")
    options = parser.parse_args(arguments)
    write_atomically(options.output, gpu_page(options.folder).encode())
    print(f"written: {options.output}")


if __name__ == "__main__":
    main()
