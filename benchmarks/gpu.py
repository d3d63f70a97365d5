"""Parts of ``benchmarks/gpu.sh``: ``python -m benchmarks.gpu tests|brax --json FILE``.

Each part writes its file again after every test or iteration, so a part that is stopped by its time
limit keeps its measurements.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benchmarks.timing import machine

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "brax_ant.py"
LINE = re.compile(r"(\d+): reward (\S+), action variation (\S+)")
METHODS = {"baseline": ["--baseline"], "L2C2": []}


def write(path: Path, content: dict[str, Any]) -> None:
    """Writes a part's file."""
    path.write_text(json.dumps(content, indent=2) + "\n")


def test(path: Path, where: dict[str, Any]) -> None:
    """Runs the tests that need a CUDA device, compiled updates last."""
    import pytest

    found: list[dict[str, Any]] = []

    class Recorder:
        def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
            items.sort(key=lambda item: "True" in item.name)

        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            if report.when == "call" or report.outcome != "passed":
                name = report.nodeid.partition("::")[2]
                found.append({"test": name, "outcome": report.outcome, "seconds": report.duration})
                write(path, {"machine": where, "tests": found})

    write(path, {"machine": where, "tests": found})
    files = [str(ROOT / "tests" / f"test_{name}.py") for name in ("device", "benchmarks")]
    sys.exit(pytest.main([*files, "-k", "cuda", "-p", "no:cacheprovider"], plugins=[Recorder()]))


def brax(path: Path, where: dict[str, Any], given: list[str], seconds: float) -> None:
    """Trains on Brax's Ant with and without L2C2.

    Args:
        path: file to write to.
        where: the machine.
        given: arguments of the example.
        seconds: time limit of each of the two runs.
    """
    result: dict[str, Any] = {
        "machine": where,
        "command": " ".join(("python examples/brax_ant.py", *given)),
        "limit": seconds,
        "note": why_not(given),
        "runs": [],
    }
    write(path, result)
    for method, more in METHODS.items() if not result["note"] else ():
        run: dict[str, Any] = {"method": method, "iterations": [], "ended": False}
        result["runs"].append(run)
        start = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-u", str(EXAMPLE), *given, *more],
            stdout=subprocess.PIPE,
            text=True,
            # JAX otherwise takes most of the GPU's memory at the start.
            env=os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false", "PYTHONPATH": _path()},
        )
        limit = threading.Timer(seconds, process.kill)
        limit.start()
        assert process.stdout is not None
        for line in process.stdout:
            if told := LINE.match(line):
                reward, change = float(told[2]), float(told[3])
                after = time.monotonic() - start
                run["iterations"].append(
                    {"seconds": after, "reward": reward, "action_variation": change}
                )
                write(path, result)
        run["ended"] = process.wait() == 0
        limit.cancel()
        write(path, result)


def why_not(given: list[str]) -> str:
    """Why Brax cannot be measured, or nothing."""
    for name in ("jax", "brax"):
        if find_spec(name) is None:
            return f"not measured: {name} is not installed"
    import jax

    if "cuda" in given and jax.default_backend() == "cpu":
        return "not measured: JAX finds no GPU"
    return ""


def _path() -> str:
    return os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))


def main(arguments: list[str] | None = None) -> None:
    """Runs one part."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.gpu", description=__doc__, allow_abbrev=False
    )
    parser.add_argument("part", choices=["tests", "brax"])
    parser.add_argument("--json", type=Path, required=True, help="file to write to")
    parser.add_argument("--seconds", type=float, default=80.0, help="limit of a training on Ant")
    options, given = parser.parse_known_args(arguments)
    where = machine()
    if options.part == "tests":
        test(options.json, where)
    else:
        brax(options.json, where, given, options.seconds)


if __name__ == "__main__":
    main()
