"""Writes the table of the regularizers' costs into ``docs/isaac_lab.md``.

``python -m studies.cost`` reads ``results/cost.json``, which ``python -m benchmarks.cost --json
results/cost.json`` has made.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from studies.files import ROOT, write_parts
from torchrl_l2c2.experiment.analysis.reports.table import pipe_table

PAGE = ROOT / "docs" / "isaac_lab.md"
MEASURED = ROOT / "results" / "cost.json"


_TIMES = {"cpu": "processor time of one thread", "cuda": "time by the clock"}


def cost_table(measured: Mapping[str, Any]) -> str:
    """The table as Markdown, with its command, commit, machine and versions.

    Args:
        measured: the content of a file that ``benchmarks.cost`` has written.
    """
    rows = measured["rows"]
    sizes = list(dict.fromkeys(row["states"] for row in rows))
    fractions = list(dict.fromkeys(row["fraction"] for row in rows))
    found = {(row["method"], row["fraction"], row["states"]): row for row in rows}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    head = ["method", "`fraction`"]
    head += [f"{what}, {size:,} states" for what in ("time", "memory") for size in sizes]
    table = [head]
    for method in methods:
        for fraction in fractions:
            lines = [found.get((method, fraction, size)) for size in sizes]
            if None not in lines:
                table.append([method, f"{fraction:g}", *_cells(lines)])
    where = measured["machine"]
    versions = ", ".join(
        f"{name} {where['versions'][name]}" for name in ("torch", "torchrl", "tensordict")
    )
    load = "" if where["load"] is None else f", load {where['load']:.1f} at the start"
    device = where["cuda"] if measured["device"] == "cuda" else where["cpu"]
    networks = measured["networks"]
    layers = "-".join(map(str, networks["layers"]))
    return "\n".join(
        [
            f"`{measured['command']}`, commit {where['commit']}, {device}{load}, {versions}:",
            "",
            pipe_table(table),
            "",
            "Each number is a multiple of the baseline's; the baseline's own numbers are in ms and "
            f"MiB. Time: {_TIMES[measured['device']]} for the loss and its gradients, median of "
            f"{measured['rounds']} rounds in turns with the baseline, with quartiles in "
            f"parentheses. Memory: {measured['memory']}. {networks['observations']} observations, "
            f"{networks['actions']} actions, layers {layers} for actor and critic.",
        ]
    )


def _cells(rows: list[Any]) -> list[str]:
    """Times and memories; the baseline's are absolute."""
    if rows[0]["method"] == "baseline":
        return [
            *(_milliseconds(row) for row in rows),
            *(f"{row['memory_mib']:,.0f} MiB" for row in rows),
        ]
    return [
        *(f"{row['time']:.2f} ({row['time_low']:.2f}, {row['time_high']:.2f})" for row in rows),
        *(f"{row['memory']:.2f}" for row in rows),
    ]


def _milliseconds(row: Mapping[str, Any]) -> str:
    return f"{row['milliseconds']:,.{0 if row['milliseconds'] > 20 else 2}f} ms"


def main() -> None:
    """Writes the page if it is not as the file has it, and names it."""
    write_parts(PAGE, {"cost": cost_table(json.loads(MEASURED.read_text()))})


if __name__ == "__main__":
    main()
