"""The package as a whole: its style, what importing it needs, and what it says of itself."""

import json
import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

import torchrl_l2c2

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("arguments", [["check"], ["format", "--check"]])
def test_ruff_is_content(arguments):
    """Lint and format, with the rules of pyproject.toml."""
    command = [sys.executable, "-m", "ruff", *arguments, "."]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_types_fit():
    """With the rules of pyproject.toml, over the whole package."""
    command = [sys.executable, "-m", "mypy"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# What is imported, and when, in a process that has imported nothing yet.
IMPORTS = """
import json, sys, torchrl
begun = set(sys.modules)
ours = lambda: sorted(name for name in sys.modules if name.startswith('torchrl_l2c2.'))
new = lambda before: sorted({name.split('.')[0] for name in set(sys.modules) - before} & FOREIGN)
FOREIGN = {'hydra', 'omegaconf', 'gymnasium', 'pybullet', 'matplotlib', 'tqdm'}
import torchrl_l2c2
told = {'at first': [*ours(), *new(begun)], 'losses': 'torchrl.objectives' in sys.modules}
import torchrl.modules, torchrl.objectives, torchrl.envs
before = set(sys.modules)
told['dir'] = 'L2C2Loss' in dir(torchrl_l2c2)
told['named'] = torchrl_l2c2.L2C2Loss.__name__, 'torchrl_l2c2.objectives' in ours()
from torchrl_l2c2 import *
told['components'] = new(before)
import torchrl_l2c2.trainers
from hydra.core.config_store import ConfigStore
repo = ConfigStore.instance().repo
told['stored'] = ['sac.yaml' in repo['loss'], 'l2c2.yaml' in repo['loss']]
torchrl_l2c2.trainers.register()
told['registered'] = 'l2c2.yaml' in repo['loss']
print(json.dumps(told))
"""


def test_importing_the_package_imports_only_what_is_used():
    """No module before one of its names is used, and nothing of the experiment's packages.

    Importing the configurations for TorchRL's trainers stores none of them.
    """
    command = [sys.executable, "-c", IMPORTS]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = json.loads(done.stdout.splitlines()[-1])
    assert imported["at first"] == [] and not imported["losses"]
    assert imported["dir"] and imported["named"] == ["L2C2Loss", True]
    assert imported["components"] == []
    assert imported["stored"] == [True, False] and imported["registered"]


# As where none of them is installed.
WITHOUT = """
import sys
for name in ("gymnasium", "hydra", "matplotlib", "omegaconf", "pybullet", "pydantic", "tqdm"):
    sys.modules[name] = None
import torch
import torchrl_l2c2
from torchrl.envs import PendulumEnv, TransformedEnv
for name in torchrl_l2c2.__all__:
    getattr(torchrl_l2c2, name)
import torchrl_l2c2.rsl_rl
noise = torchrl_l2c2.ObservationNoise(0.5, ["th"], torch.Generator().manual_seed(0))
rollout = TransformedEnv(PendulumEnv(), noise).rollout(3)
print(torch.equal(rollout["next", "th"][:-1], rollout["th"][1:]))
"""


def test_the_components_work_without_the_experiments_packages():
    """Every public name can be imported, and an environment of TorchRL's own gets its noise."""
    command = [sys.executable, "-c", WITHOUT]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "True\n", done.stderr


def test_the_package_says_what_there_is_without_torch():
    """Commands that exist."""
    code = "import runpy, sys; runpy.run_module('torchrl_l2c2'); print('torch' in sys.modules)"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            code.replace("'torchrl_l2c2'", "'torchrl_l2c2', run_name='__main__'"),
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.endswith("False\n")
    for command in re.findall(r"python -m (\S+)", done.stdout):
        assert find_spec(command), command


def test_every_public_name_is_documented_with_an_example():
    """A docstring, and for classes and functions a runnable example in it."""
    for name in set(torchrl_l2c2.__all__) - {"__version__"}:
        public = getattr(torchrl_l2c2, name)
        assert "Examples:" in public.__doc__ and ">>>" in public.__doc__, name


def test_an_installed_package_is_complete():
    """Every folder with modules, and what conf/ combines, is named among the packages."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {path.parent for path in (ROOT / "torchrl_l2c2").rglob("*.py")}
    modules = {".".join(folder.relative_to(ROOT).parts) for folder in folders}
    configurations = {folder.parent for folder in (ROOT / "conf").rglob("*.yaml")}
    mapped = {
        ".".join(("torchrl_l2c2", *folder.relative_to(ROOT).parts)): str(folder.relative_to(ROOT))
        for folder in configurations
    }
    assert set(settings["packages"]) == modules | mapped.keys()
    assert settings["package-dir"] == mapped
