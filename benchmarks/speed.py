"""Speed of the experiment, as ratios: ``python -m benchmarks.speed``.

Every row compares things that are measured alternately in one process (where the row is about
processes, by one process that starts them), and is made of medians. ``docs/speed.md`` explains
the rows.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import logging
import os
import sys
import time
import warnings
from importlib import import_module
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

# Module and function of each group of rows; imported when it is measured: --help is quick.
ROWS = {
    "import": "run_rows.import_rows",
    "update": "update_rows.update_rows",
    "ppo_update": "update_rows.ppo_update_rows",
    "regularizers": "regularizer_rows.regularizer_rows",
    "update_4096": "update_rows.large_update_rows",
    "products": "update_rows.product_rows",
    "collection": "collection_rows.collection_rows",
    "run": "run_rows.run_rows",
    "start": "run_rows.start_rows",
    "peers": "peers.peer_rows",
    "processes": "run_rows.process_rows",
    "cuda": "update_rows.cuda_rows",
}


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed", description=__doc__)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="default: all")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--markdown", type=Path, help="file to write the table to")
    parser.add_argument(
        "--quick", action="store_true", help="one short uncompiled round: shows that it runs"
    )
    parser.add_argument(
        "--peer-python", default=sys.executable, help="interpreter that has SBX (default: this)"
    )
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Measures, prints and writes the rows."""
    options = _parse(arguments)
    import torch
    from tqdm import tqdm

    from benchmarks.run_rows import work
    from benchmarks.setups import QUICK, Effort
    from benchmarks.timing import fill_page, machine, to_markdown, to_text
    from torchrl_l2c2.experiment.run.process import keep_freed_memory

    for chatty in ("torchrl", "torch"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    keep_freed_memory()
    effort = dataclasses.replace(
        QUICK if options.quick else Effort(), peer_python=options.peer_python
    )
    if options.worker:
        work(effort)
        return
    where, rows, started = machine(), [], time.monotonic()
    for group in tqdm(options.rows, disable=None):
        # Functions of one source share their compiled code: start without any.
        torch.compiler.reset()
        module, _, function = ROWS[group].partition(".")
        for row in getattr(import_module(f"benchmarks.{module}"), function)(effort):
            tqdm.write(to_text(row))
            rows.append(row)
            result = {
                "machine": where,
                "quick": options.quick,
                "minutes": (time.monotonic() - started) / 60,
                "rows": [row.to_dict() for row in rows],
            }
            if options.json:  # After each row: an interrupted run keeps its rows.
                options.json.write_text(json.dumps(result, indent=2) + "\n")
    if options.markdown:
        given = sys.argv[1:] if arguments is None else arguments
        command = " ".join(("python -m benchmarks.speed", *given))
        page = options.markdown.read_text() if options.markdown.exists() else ""
        options.markdown.write_text(fill_page(page, to_markdown(rows, where, command)))


if __name__ == "__main__":
    main()
