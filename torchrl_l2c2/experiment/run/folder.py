"""Files of a run's folder."""

from __future__ import annotations

import contextlib
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.files import read_json, write_atomically, write_json
from torchrl_l2c2.experiment.run.finished import is_tested

VERSIONED = (
    *("torchrl-l2c2", "torch", "torchrl", "tensordict", "numpy", "gymnasium"),
    *("pybullet", "pybullet-envs-gymnasium", "mujoco"),
)

README = """\
A run of torchrl_l2c2.

config.json           all settings
versions.json         versions of the packages that affect the numbers
metrics.csv           one line per training episode
train.log             messages of the run
checkpoint_*.pt       to continue, run the same command again
policy.pt             state_dict of the acting policy after training
policy_best.pt        best policy of evaluations.json (evaluate_every)
evaluations.json      tests during training (evaluate_every)
evaluation.json       test episodes after training
learning_curves.png   plot of metrics.csv
diagnosis.html        why the policy shakes (command diagnose)
video.mp4             test episode (the command video)
export/               policy as ONNX and as a torch.export program (command export)

Load the policy, a TorchRL actor, and an environment of its task:

    from torchrl.envs import set_exploration_type
    from torchrl_l2c2.experiment import load_policy
    policy, env, max_steps = load_policy("path of this folder")
    with set_exploration_type("deterministic"):  # Mean actions; otherwise samples, as in training.
        rollout = env.rollout(max_steps, policy)

Play test episodes:

    python -m torchrl_l2c2 evaluate FOLDER --episodes 100
"""
# Settings that may change, but have an effect only during training.
TRAINING_ONLY = ("evaluate_every", "late_share")
# Files written after training, in addition to evaluation.json.
FINAL_FILES = ("video.mp4", "policy.pt", "learning_curves.png", "diagnosis.html")
EXPORT_FILES = tuple(f"export/{name}" for name in ("policy.onnx", "policy.pt2", "contract.json"))
# Files written during training; a new run removes them.
TRAINING_FILES = ("metrics.csv", "evaluations.json", "policy_best.pt")


def prepare_folder(
    folder: Path, settings: dict[str, Any], *, resumed: bool, ended: bool
) -> list[str]:
    """Removes outdated files from a run's folder, and writes settings, versions and README.

    Outdated results are removed first: a test with other settings, and the final files of a shorter
    run that is extended. If the process is killed, the folder has the old run or an unfinished run,
    never new settings with an old policy. After training, settings and versions of the training
    stay. A run that was continued at another commit has both, such as ``"a+b"``.

    Args:
        folder (Path): Run folder.
        settings (dict): Settings of the run, as in ``config.json``.

    Keyword Args:
        resumed (bool): Whether the run continues from a checkpoint.
        ended (bool): Whether training is over.

    Returns:
        list: Names of the removed results.
    """
    outdated = [] if ended and is_tested(folder, settings) else ["evaluation.json"]
    if not ended:
        outdated += [*FINAL_FILES, *EXPORT_FILES, *(() if resumed else TRAINING_FILES)]
    removed = [name for name in outdated if (folder / name).exists()]
    for name in removed:
        (folder / name).unlink()
    before = {name: _written(folder / name) for name in ("config.json", "versions.json")}
    if ended and before["config.json"]:
        kept = {k: v for k, v in before["config.json"].items() if k in TRAINING_ONLY}
        settings = {**settings, **kept}
    write_json(folder / "config.json", settings)
    if not ended or not before["versions.json"]:
        earlier = before["versions.json"].get("commit", "").split("+") if resumed else []
        commits = dict.fromkeys(commit for commit in [*earlier, code_commit()] if commit)
        write_json(folder / "versions.json", {**versions(), "commit": "+".join(commits)})
    write_atomically(folder / "README.txt", README.encode())
    return removed


def _written(path: Path) -> dict[str, Any]:
    """Reads a file that is written anew; empty if it is missing or damaged."""
    with contextlib.suppress(FileNotFoundError, UserError):
        return read_json(path)
    return {}


def versions() -> dict[str, str]:
    """Returns the versions of installed packages that affect the numbers."""
    found = {}
    for name in VERSIONED:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def code_commit() -> str:
    """Returns the code's commit, ``-dirty`` if changed; empty outside of a git checkout."""
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
