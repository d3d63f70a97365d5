"""What decides the numbers of a run beside its settings: versions of packages, and the code's."""

from __future__ import annotations

import contextlib
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

VERSIONED = (
    *("torchrl-l2c2", "torch", "torchrl", "tensordict", "numpy", "gymnasium"),
    *("pybullet", "pybullet-envs-gymnasium", "mujoco"),
)


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers, as far as they are installed."""
    found = {}
    for name in VERSIONED:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def code_commit() -> str:
    """The commit of this code, ``-dirty`` if changed since; empty outside of a git checkout."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return ""
    describe = ("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    try:
        done = subprocess.run(
            ("git", "-C", str(root), *describe), capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
