"""Which errors a command shows in one line, and which with a traceback."""

import os
import subprocess
import sys

import pytest
import torch
from processes import ROOT, run_train

from torchrl_l2c2.experiment.cli.main import main
from torchrl_l2c2.experiment.cli.train import _print_error
from torchrl_l2c2.experiment.errors import (
    MissingPackageError,
    SimulatorError,
    UserError,
    one_line_errors,
)
from torchrl_l2c2.experiment.run.checkpoints import CheckpointError
from torchrl_l2c2.experiment.run.lock import FolderInUseError
from torchrl_l2c2.experiment.settings.fields import SettingError

TOLD = [
    UserError("a mistake"),
    SettingError("seed", "must be at least 0, got -1."),
    CheckpointError("cut short"),
    FolderInUseError("in use"),
    MissingPackageError("onnx is missing"),
    OSError("no space left"),
    FloatingPointError("reward is not finite"),
    SimulatorError("failed after frame 3"),
]
BUGS = [
    ValueError("unknown mode"),
    TypeError("not callable"),
    RuntimeError("cannot reallocate the plan"),
    NotImplementedError("soon"),
    ImportError("cannot import name 'smooth'"),
    KeyError("observation"),
]


@pytest.mark.parametrize("error", TOLD, ids=lambda error: type(error).__name__)
def test_what_a_user_can_mend_is_one_line(error, capsys):
    """In the command that trains, and in all others."""
    assert str(error) in _print_error(error)
    assert capsys.readouterr().err.startswith(f"error: {error}")
    with pytest.raises(SystemExit) as ended, one_line_errors():
        raise error
    assert ended.value.code == f"error: {error}"


@pytest.mark.parametrize("error", BUGS, ids=lambda error: type(error).__name__)
def test_a_bug_is_a_traceback(error, capsys):
    """Only its first line is kept for a sweep's end."""
    with pytest.raises(type(error)), one_line_errors():
        raise error
    assert _print_error(error) == f"{type(error).__name__}: {error}"
    told = capsys.readouterr().err
    assert told.startswith("Traceback (most recent call last):") and "error: " not in told


def test_an_error_without_a_text_has_its_name():
    """For a sweep's end."""
    assert _print_error(AssertionError()) == "AssertionError"


def too_large(size):
    with pytest.raises((RuntimeError, MemoryError)) as refused:
        torch.empty(size)
    return refused.value


@pytest.mark.parametrize(
    "error",
    [MemoryError("std::bad_alloc"), torch.OutOfMemoryError("CUDA"), 10**15, 2**61],
    ids=["C++", "GPU", "CPU", "any machine"],
)
def test_too_little_memory_is_told_with_the_settings_that_need_it(error):
    """PyTorch's own errors on the CPU are plain RuntimeErrors."""
    error = too_large(error) if isinstance(error, int) else error
    told = _print_error(error)
    assert "Not enough memory: decrease algorithm.hidden, replay.capacity" in told
    assert "algorithm.frames, task.max_steps or threads." in told  # of rollouts


def test_help_may_have_no_reader():
    """As in ``--help | head``, which leaves before the end."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, str(ROOT / "train.py"), "--help"]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, b"")


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("task.env_id=Nowhere-v0", "'Nowhere-v0' is not a task that Gymnasium can create here"),
        ("task.env_id=my_robot:Robot-v0", "No module named 'my_robot'"),
    ],
)
def test_what_is_not_there_is_told_before_torch_is_imported(tmp_path, setting, told):
    """Which takes many seconds."""
    program = (
        "import sys\nfrom torchrl_l2c2.experiment.cli.train import main\n"
        "try:\n    main()\nfinally:\n    print('torch' in sys.modules)"
    )
    settings = ("task=gymnasium", "task.env_id=Pendulum-v1", setting)
    ended = subprocess.run(
        [sys.executable, "-c", program, *settings],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 1 and told in ended.stderr and "Traceback" not in ended.stderr
    assert ended.stdout.splitlines()[-1] == "False" and not [*tmp_path.iterdir()]


# A regularizer and an algorithm of a user's own, which a line each makes known to the command.
OWN = """
import sys
from torchrl_l2c2.experiment.agents.build import make_algorithm
from torchrl_l2c2.experiment.agents.ppo_rpe import make_ppo_rpe
from torchrl_l2c2.experiment.agents.regularizers import wrap
from torchrl_l2c2.experiment.settings.algorithms import ALGORITHMS, PPORPEConfig
from torchrl_l2c2.experiment.cli.train import main
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig
from torchrl_l2c2.experiment.settings.fields import settings

BUG = sys.argv.pop()

@settings
class OwnRegularizer(RegularizerConfig):
    'A regularizer.'
    name: str = "own"

@wrap.register
def own_regularizer(config: OwnRegularizer, loss):
    from torchrl_l2c2 import RegularizedLoss

    class OwnLoss(RegularizedLoss):
        def __init__(self, base_loss):
            self.declare_networks(["actor_network"])
            self.declare_terms(policy=["loss_own"])
            if BUG == "constructor":
                raise ValueError("not the mode of 1999")
            if BUG == "call":
                len(5)

        def policy_regularizer(self, tensordict):
            if BUG == "term":
                raise RuntimeError("cannot reallocate the plan")
            terms = super().policy_regularizer(tensordict)
            states = tensordict.select("observation")[None]
            _, mean = self.policies_at(tensordict, states)
            return terms.set("loss_own", mean.loc.square().mean())

    return OwnLoss(loss)

@settings
class OwnAlgorithm(PPORPEConfig):
    'An algorithm.'
    name: str = "own"

@make_algorithm.register
def own_algorithm(config: OwnAlgorithm, env, regularizer, optimizer):
    agent = make_ppo_rpe(config, env, regularizer, optimizer)
    agent.policy.register_forward_pre_hook(limp)
    return agent

def limp(policy, inputs):
    if BUG == "policy":
        raise IndexError("no joint 9")

REGULARIZERS["own"], ALGORITHMS["own"] = OwnRegularizer(), OwnAlgorithm()
if __name__ == "__main__":
    main()
"""


@pytest.mark.parametrize(
    ("bug", "line", "told"),
    [
        ("constructor", "in __init__", "ValueError: not the mode of 1999"),
        ("call", "len(5)", "TypeError: object of type 'int' has no len()"),
        ("term", "in policy_regularizer", "RuntimeError: cannot reallocate the plan"),
        ("policy", "in limp", "IndexError: no joint 9"),
    ],
)
def test_a_bug_in_a_users_own_code_shows_its_traceback_and_logs_it(tmp_path, bug, line, told):
    """Wherever it is: in a constructor, in a term of the loss, in the policy."""
    script, run = tmp_path / "own.py", tmp_path / "run"
    script.write_text(OWN)
    settings = (
        "task=gymnasium", "task.env_id=Pendulum-v1", "task.episodes=2", "task.max_steps=40",
        "algorithm=own", "regularizer=own", "replay=prioritized", "optimizer=adam",
        "compile=false", "test_episodes=1", f"hydra.run.dir={run}",
    )  # fmt: skip
    done = run_train(*settings, bug, cwd=tmp_path, check=False, script=script)
    assert done.returncode == 1
    for text in (done.stderr, (run / "train.log").read_text()):
        assert "Traceback (most recent call last):" in text
        assert str(script) in text and line in text and told in text


def test_a_command_names_the_packages_that_are_missing(monkeypatch):
    """Before it imports anything that needs them."""
    monkeypatch.setattr("torchrl_l2c2.experiment.cli.main.find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"error: evaluate needs the packages gymnasium, hydra"):
        main(["evaluate", "anywhere"])


def test_ctrl_c_while_a_command_is_imported_is_one_line(monkeypatch, capsys):
    """Its packages take a second."""

    def stopped(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchrl_l2c2.experiment.cli.main.import_module", stopped)
    with pytest.raises(SystemExit) as ended:
        main(["train"])
    assert ended.value.code == 130 and capsys.readouterr().err == "interrupted.\n"
