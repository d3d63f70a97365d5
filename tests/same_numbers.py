"""Whether a change of the code leaves the numbers as they were, to the bit.

``python tests/same_numbers.py REVISION`` trains six short, uncompiled runs with this checkout and
with another revision of it, and compares every parameter, target and buffer of the loss.
"""

from __future__ import annotations

import argparse
import io
import os
import struct
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parent.parent
HEADER = struct.calcsize("<13sI32s")  # of a checkpoint; torch.save follows
SWINGUP = [
    "task=swingup",
    "task.episodes=4",
    "task.max_steps=200",
    # Not left to defaults, which a revision may change.
    "algorithm.critic_weighting=ratio",
    "algorithm.updates=15",
]
PENDULUM = [
    "task=gymnasium",
    "task.env_id=Pendulum-v1",
    "task.episodes=4",
    "task.max_steps=80",
    "task.noise_scale=0.01",
    "replay.batch_size=32",
]
REPLAYED = ["algorithm.hidden=[32,32]", "algorithm.random_frames=60"]
# With SAC and PPO as well.
PAPERS = [
    "regularizer=l2c2",
    "regularizer.policy_distance=hellinger",
    "regularizer.lambda_min=0.01",
    "regularizer.lambda_max=1.0",
    "regularizer.beta=0.1",
    "regularizer.neighbors=line",
    "regularizer.gain=constant",
    "regularizer.relative=false",
]
RUNS = {
    "ppo_rpe": [*SWINGUP, "regularizer=none"],
    "ppo_rpe, CAPS": [*SWINGUP, "regularizer=caps"],
    "ppo_rpe, L2C2": [*SWINGUP, "regularizer=l2c2"],
    "sac, L2C2": [*PENDULUM, *PAPERS, "algorithm=sac", *REPLAYED],
    "td3, L2C2": [*PENDULUM, *PAPERS, "algorithm=td3", *REPLAYED],
    "ppo, L2C2": [*PENDULUM, *PAPERS, "algorithm=ppo", "algorithm.frames=150"],
}


def trained(tree: Path, settings: list[str]) -> dict[str, torch.Tensor]:
    """The tensors of the loss after a run with the code in a folder."""
    with tempfile.TemporaryDirectory() as outputs:
        free = ["compile=false", "test_episodes=1", f"outputs={outputs}"]
        run = subprocess.run(
            [sys.executable, "train.py", *settings, *free],
            cwd=tree,
            env={**os.environ, "PYTHONPATH": str(tree)},
            capture_output=True,
            text=True,
        )
        if run.returncode:
            sys.exit(f"{' '.join(run.args)} in {tree} failed:\n{run.stderr}")
        newest = max(Path(outputs).rglob("checkpoint_*.pt"))
        state = torch.load(io.BytesIO(newest.read_bytes()[HEADER:]), weights_only=True)
    return {k: v for k, v in state["loss"].items() if isinstance(v, torch.Tensor)}


def differing(ours: dict[str, Any], theirs: dict[str, Any]) -> list[str]:
    """Names of what is not the same tensor in both."""
    names = ours.keys() | theirs.keys()
    return sorted(
        n for n in names if n not in ours or n not in theirs or not torch.equal(ours[n], theirs[n])
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").strip())
    parser.add_argument("revision", help="what to compare with: a commit, a tag or a branch")
    revision, failed = parser.parse_args().revision, False
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "-q", "--detach", str(other), revision], check=True)
        try:
            for name, settings in RUNS.items():
                ours, theirs = trained(ROOT, settings), trained(other, settings)
                different = differing(ours, theirs)
                failed = failed or bool(different)
                told = f"differ: {', '.join(different)}" if different else "the same"
                print(f"{name}: {len(ours)} tensors, {told}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
