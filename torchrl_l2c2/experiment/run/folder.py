"""A run's folder: its files, its beginning, and the files that a continued run copies."""

from __future__ import annotations

import contextlib
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.run.files import write_atomically, write_json
from torchrl_l2c2.experiment.run.finished import is_tested

VERSIONED = (
    *("torchrl-l2c2", "torch", "torchrl", "tensordict", "numpy", "gymnasium"),
    *("pybullet", "pybullet-envs-gymnasium", "mujoco"),
)

README = """\
A run of torchrl_l2c2.

config.json           every setting
versions.json         of the packages that decide the numbers
metrics.csv           a line per training episode
train.log             what the run said
checkpoint_*.pt       to continue: run the same command again, or use resume=FOLDER
policy.pt             the acting policy at the end of training, a state_dict
policy_best.pt        the best policy of evaluations.json (evaluate_every)
evaluations.json      tests during training (evaluate_every)
evaluation.json       test episodes at the end
learning_curves.png   a picture of metrics.csv
diagnosis.html        why the policy shakes (experiment.diagnose)
video.mp4             a test episode (record)
export/               the policy as ONNX and torch.export program (experiment.export)

To load the policy, a TorchRL actor, with an environment of its task:

    from torchrl.envs import set_exploration_type
    from torchrl_l2c2.experiment import load_policy
    policy, env, max_steps = load_policy("path of this folder")
    with set_exploration_type("deterministic"):  # the mean; without it, samples as in training
        rollout = env.rollout(max_steps, policy)

To play test episodes with it:

    python -m torchrl_l2c2 evaluate FOLDER --episodes 100
"""
# Files of a training's end, in addition to the test that marks a run as finished.
OF_THE_END = ("video.mp4", "policy.pt", "learning_curves.png", "diagnosis.html")
EXPORTED = tuple(f"export/{name}" for name in ("policy.onnx", "policy.pt2", "contract.json"))
# Files that are written during training; a run that begins anew does not keep them.
OF_THE_WAY = ("metrics.csv", "evaluations.json", "policy_best.pt")


def begin_folder(folder: Path, settings: dict[str, Any], *, begun: bool, ended: bool) -> None:
    """Writes the first files of a run.

    A test with other settings is removed first, and so are the last files of a shorter run that is
    continued. Killed at any moment, the folder holds the older run or an unfinished run, and never
    the settings of a longer run with an older policy. A test of the same policy stays until another
    one replaces it.

    Args:
        folder (Path): The run's folder.
        settings (dict): The run's settings, as in ``config.json``.

    Keyword Args:
        begun (bool): whether it continues from a checkpoint.
        ended (bool): whether its training is over.
    """
    if not ended or not is_tested(folder, settings):
        (folder / "evaluation.json").unlink(missing_ok=True)
    if not ended:
        names = (*OF_THE_END, *EXPORTED, *(() if begun else OF_THE_WAY))
        for path in filter(Path.exists, (folder / name for name in names)):
            path.unlink()
    write_json(folder / "config.json", settings)
    write_json(folder / "versions.json", {**versions(), "commit": code_commit()})
    write_atomically(folder / "README.txt", README.encode())


def bring_files(old: Path, new: Path) -> None:
    """Copies the files that a run in another folder continues to write."""
    for path in filter(Path.exists, (old / name for name in OF_THE_WAY)):
        write_atomically(new / path.name, path.read_bytes())


def versions() -> dict[str, str]:
    """Versions of the packages that decide the numbers, as far as they are installed."""
    found = {}
    for name in VERSIONED:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def code_commit() -> str:
    """The commit of this code, ``-dirty`` if changed since; empty outside of a git checkout."""
    root = Path(__file__).parents[3]
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
