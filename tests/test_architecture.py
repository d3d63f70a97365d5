"""The layout: files that can be seen whole, and imports that point one way."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "torchrl_l2c2"
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in PACKAGE.rglob("*.py")
}
# From the bottom up: a module imports from lines above its own alone.
LAYERS = """
_version _checks
neighborhood affinities gains transforms.random
distances transforms.neighbors transforms.noise modules updaters optim.adaterm metrics.actions
divergences
policy_distances
transforms.__init__ optim.__init__ metrics.policy metrics.spectrum
metrics.__init__
presets objectives._fold objectives._specialize objectives._batch
objectives._networks
objectives.regularized
objectives.l2c2 objectives.caps objectives.cats objectives.lcp objectives.sr2l
objectives.grad_caps
objectives.asap objectives.tchebycheff
objectives.ppo_rpe
objectives.__init__
smoothing
rsl_rl.networks rsl_rl.storage
rsl_rl.regularization
rsl_rl.ppo
rsl_rl.__init__
trainers __init__
experiment.errors
experiment.settings experiment._torch_internals experiment.spaces experiment.guard
experiment.compilation
experiment.tracing experiment.frames experiment._torchrl_internals
experiment.loggers experiment.acting experiment.files experiment.versions
experiment.checkpoints experiment.metrics_log
experiment.environments experiment.lock experiment.signals
experiment.process experiment.progress experiment.sweep experiment.optimizers
experiment.tasks experiment.replay experiment.collection
experiment.rollouts
experiment.regularizers.base
experiment.regularizers.none experiment.regularizers.caps experiment.regularizers.l2c2
experiment.regularizers.cats experiment.regularizers.grad_caps experiment.regularizers.lcp
experiment.regularizers.sr2l experiment.regularizers.asap
experiment.regularizers.__init__
experiment.algorithms.normalization
experiment.algorithms.agent experiment.algorithms.networks experiment.algorithms.base
experiment.algorithms.ppo_rpe experiment.algorithms.sac experiment.algorithms.td3
experiment.algorithms.dqn experiment.algorithms.ppo
experiment.algorithms.__init__
experiment.config
experiment.naming experiment.saved
experiment.identity
experiment.folder experiment.differences
experiment.finished
experiment.reports.statistics experiment.reports.names experiment.reports.document
experiment.reports.records
experiment.reports.runs experiment.reports.groups
experiment.reports.tables
experiment.reports.comparison experiment.reports.measures
experiment.reports.figures
experiment.reports.report experiment.reports.results
experiment.reports.__init__
experiment.reports.__main__
experiment.trained
experiment.video
experiment.workers
experiment.evaluate experiment.update experiment.player experiment.manual
experiment.best_policy experiment.export
experiment.diagnosis.measured
experiment.diagnosis.words experiment.diagnosis.pictures experiment.diagnosis.run
experiment.diagnosis.film
experiment.diagnosis.page
experiment.diagnosis.__init__
experiment.diagnose experiment.noise
experiment.learner
experiment.gain
experiment.continuation experiment.schedules
experiment.training
experiment.composition
experiment.command
experiment.__init__
experiment.__main__ __main__
""".strip().splitlines()
RANK = {module: rank for rank, line in enumerate(LAYERS) for module in line.split()}


def imported(path: Path) -> set[str]:
    """What a module imports of the package, functions' own imports among it; types' not."""
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING":
            node.body = []
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchrl_l2c2."):
            base = node.module.removeprefix("torchrl_l2c2.")
            names.add(base if base in MODULES else f"{base}.__init__")
    return names


def test_every_module_has_a_place():
    """A new file says in the list above where it stands."""
    assert MODULES.keys() == RANK.keys()


@pytest.mark.parametrize("module", sorted(MODULES))
def test_imports_point_one_way(module):
    """No circle, no arrow upward."""
    upward = {name for name in imported(MODULES[module]) if RANK[name] >= RANK[module]}
    assert not upward


def test_only_the_experiment_needs_its_extra():
    """Nothing else imports a simulator, a plotting library or, but for trainers, Hydra."""
    foreign = ("hydra", "omegaconf", "gymnasium", "pybullet", "matplotlib", "pydantic", "tqdm")
    for module, path in MODULES.items():
        if not module.startswith("experiment.") and module != "trainers":
            found = [line for line in path.read_text().splitlines() if "import" in line.split()[:3]]
            assert not [line for line in found if any(name in line for name in foreign)], module


def test_a_run_starts_without_tables_and_pictures():
    """Training and its command import reports only within functions; nothing imports the lab."""
    for name in ("training", "command"):
        tree = ast.parse(MODULES[f"experiment.{name}"].read_text())
        begun = {getattr(node, "module", "") or "" for node in tree.body}
        assert not [module for module in begun if ".reports" in module]
    assert not [path for path in MODULES.values() if "studies" in path.read_text()]


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
