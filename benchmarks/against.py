"""Speed of this checkout and of another revision: ``python -m benchmarks.against REVISION``.

A process with this checkout and one with another revision take turns at the compiled update and at
collecting: other work of the machine slows both. Prints the fastest time of each, and the median
and quartiles of the turns' ratios.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
UPDATES, FRAMES = 200, 1000
WORK = f"""
import logging, sys, time
import torch
logging.getLogger("torchrl").setLevel(logging.ERROR)
torch.set_num_threads(1)
from benchmarks.setups import Effort, updates
from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import EpisodeCollector, TaskConfig, make_env

update = updates(Effort(), 32, "l2c2", True)
env = make_env(TaskConfig(), 0)
actor = make_actor(env.observation_spec["observation"].shape[-1], env.action_spec)
collector = EpisodeCollector(
    env, actor, frames_per_batch={FRAMES}, stop_at_done=False, compile_policy=True
)
actions = {{"update": lambda: [update() for _ in range({UPDATES})], "collect": collector.rollout}}
for action in actions.values():
    action()
print("ready", flush=True)
for line in sys.stdin:
    start = time.perf_counter()
    actions[line.strip()]()
    print(time.perf_counter() - start, flush=True)
"""


def start(tree: Path) -> subprocess.Popen[str]:
    """A process with the code in a folder, once it is ready."""
    process = subprocess.Popen(
        [sys.executable, "-c", WORK],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdout is not None
    while (line := process.stdout.readline()).strip() != "ready":
        if not line:
            sys.exit(f"the code in {tree} could not be measured.")
    return process


def turn(process: subprocess.Popen[str], action: str) -> float:
    """Seconds of one turn."""
    assert process.stdin is not None and process.stdout is not None
    print(action, file=process.stdin, flush=True)
    return float(process.stdout.readline())


def in_turns(
    ours: subprocess.Popen[str], theirs: subprocess.Popen[str], action: str, number: int
) -> tuple[float, float]:
    """Seconds of both; who comes first alternates."""
    if number % 2:
        second = turn(theirs, action)
        return turn(ours, action), second
    return turn(ours, action), turn(theirs, action)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.against", description=__doc__)
    parser.add_argument("revision", help="what to compare with: a commit, a tag or a branch")
    parser.add_argument("--rounds", type=int, default=40, help="turns of each (default: 40)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "-q", "--detach", str(other), options.revision], check=True)
        try:
            ours, theirs = start(ROOT), start(other)
            for action, units in (("update", UPDATES), ("collect", FRAMES)):
                turns = [in_turns(ours, theirs, action, n) for n in range(options.rounds)]
                fastest = [1e6 * min(times) / units for times in zip(*turns, strict=True)]
                low, middle, high = statistics.quantiles((a / b for a, b in turns), n=4)
                print(
                    f"{action}: at the fastest {fastest[0]:.1f} us here, {fastest[1]:.1f} us at "
                    f"{options.revision}, ratio {fastest[0] / fastest[1]:.3f}; ratios of turns "
                    f"{middle:.3f} ({low:.3f} to {high:.3f})",
                    flush=True,
                )
            for process in (ours, theirs):
                process.communicate()
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)


if __name__ == "__main__":
    main()
