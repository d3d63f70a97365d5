"""The layout: imports that point one way, eight layers, paths that exist."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "torchrl_l2c2"
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
}


def test_imports_point_one_way():
    """The contracts of pyproject.toml: rooms of the experiment, components, studies."""
    done = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "3 kept, 0 broken" in done.stdout, done.stdout


def test_the_experiment_has_eight_rooms():
    """A new file belongs to a room."""
    folders = {path.parent.name for path in (PACKAGE / "experiment").glob("*/__init__.py")}
    rooms = {"settings", "envs", "agents", "learn", "collect", "run", "analysis", "cli"}
    assert folders == rooms
    modules = {path.name for path in (PACKAGE / "experiment").glob("*.py")}
    assert modules == {"__init__.py", "errors.py"}


def test_only_the_experiment_needs_its_extra():
    """Nothing else imports a simulator, a plotting library or, but for trainers, Hydra."""
    foreign = ("hydra", "omegaconf", "gymnasium", "pybullet", "matplotlib", "pydantic", "tqdm")
    for module, path in MODULES.items():
        if not module.startswith("experiment.") and module != "trainers":
            found = [line for line in path.read_text().splitlines() if "import" in line.split()[:3]]
            assert not [line for line in found if any(name in line for name in foreign)], module


def test_a_run_starts_without_tables_and_pictures():
    """Training and its command import reports only within functions."""
    for name in ("run.experiment", "cli.train"):
        tree = ast.parse(MODULES[f"experiment.{name}"].read_text())
        begun = {getattr(node, "module", "") or "" for node in tree.body}
        assert not [module for module in begun if ".reports" in module]


def test_paths_that_are_written_down_lead_somewhere():
    """Comments, pages and settings name files and folders that are there."""
    folders = "benchmarks|conf|docs|examples|notebooks|results|studies|tests|torchrl_l2c2"
    written = re.compile(rf"(?<![\w/.])(?:{folders})/[\w./-]*\w")
    files = [
        *(path for name in folders.split("|") for path in (ROOT / name).rglob("*")),
        *ROOT.glob("*.md"),
    ]
    read = [path for path in files if path.suffix in {".md", ".py", ".yaml"}]
    found = {(name, path.name) for path in read for name in written.findall(path.read_text())}
    assert len(found) > 50
    assert not {(name, where) for name, where in found if not (ROOT / name).exists()}
