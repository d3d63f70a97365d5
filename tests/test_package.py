"""The package as a whole: its style, what importing it needs, and what it says of itself."""

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


def test_importing_the_components_needs_nothing_of_the_experiment():
    """No Hydra, Gymnasium, PyBullet or drawing library beyond what torchrl itself imports."""
    code = (
        "import sys, torchrl, torchrl.modules, torchrl.objectives, torchrl.envs\n"
        "before = set(sys.modules)\n"
        "from torchrl_l2c2 import *\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - before}\n"
        "print(sorted(new & {'hydra', 'gymnasium', 'pybullet', 'matplotlib', 'tqdm'}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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


def test_importing_the_package_puts_off_what_it_exports():
    """Not one of its modules is imported before a name of it is used; then it is there."""
    code = (
        "import sys, torchrl, torchrl_l2c2\n"
        "ours = lambda: sorted(name for name in sys.modules if name.startswith('torchrl_l2c2.'))\n"
        "print(ours(), 'torchrl.objectives' in sys.modules)\n"
        "assert 'L2C2Loss' in dir(torchrl_l2c2)\n"
        "print(torchrl_l2c2.L2C2Loss.__name__, 'torchrl_l2c2.objectives' in ours())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["[] False", "L2C2Loss True"]


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
