"""The examples run as they stand, and stay short."""

from __future__ import annotations

import math
import re
import runpy
import sys
import warnings
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
# One plays what a run has exported, test_export.py; others are for rsl_rl, test_rsl_rl.py, for
# mjlab, test_hosts.py, for several processes, test_several_devices.py, and for Brax, below.
ELSEWHERE = (
    "brax_ant",
    "mjlab_cartpole",
    "onnx_policy",
    "rsl_rl_gymnasium",
    "rsl_rl_l2c2",
    "rsl_rl_points",
    "several_devices",
)
EXAMPLES = sorted(p for p in (ROOT / "examples").glob("*.py") if p.stem not in ELSEWHERE)

# Of those that make an update for every frame fewer than by themselves; one of them random ones.
FRAMES = {"own_regularizer": "100", "sac_loop": "250", "torchrl_trainer": "100"}


@pytest.fixture(params=EXAMPLES, ids=lambda path: path.stem)
def example(request: pytest.FixtureRequest) -> Path:
    """Each script of the folder."""
    return request.param


def test_all_four_are_there() -> None:
    """Without them the tests below would have nothing to run."""
    names = {path.stem for path in EXAMPLES}
    assert names >= {"sac_loop", "ppo_loop", "own_regularizer", "torchrl_trainer"}


def test_it_trains_and_says_what_it_learned(
    example: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """It ends well, with a return and an action variation that are numbers."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(example), *filter(None, [FRAMES.get(example.stem)])])
    with torch.random.fork_rng(), warnings.catch_warnings():
        warnings.filterwarnings("error", ".*(set_progress|differentiated)")
        runpy.run_path(str(example), run_name="__main__")
    told = dict(re.findall(r"^([a-z_ ]+) (\S+)$", capsys.readouterr().out, re.M))
    assert {"return", "action variation"} <= told.keys()
    assert all(math.isfinite(float(number)) for number in told.values())
    assert -2000 < float(told["return"]) < 0  # what 200 steps of the pendulum can give
    assert 0 < float(told["action variation"]) <= 4  # its actions lie in [-2, 2]


def test_a_search_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial that was interrupted is the first to be finished, and the next ones are new."""
    monkeypatch.chdir(tmp_path)
    search = runpy.run_path(str(ROOT / "examples" / "search.py"))
    search["main"].__globals__["measure"] = lambda number, *_: [float(number), 0.1]
    search["main"](1, 1)
    lost = search["open_study"](1).ask(search["SPACE"])
    search["main"](3, 1)
    trials = search["open_study"](1).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 3
    assert trials[1].params == lost.params and trials[1].values == [1.0, 0.1]
    assert len({tuple(trial.params.values()) for trial in trials}) == 3
    assert not search["open_study"](2).trials  # Longer trials would not be comparable.


def test_it_is_short(example: Path) -> None:
    """Under 80 lines, to be read in one go."""
    assert len(example.read_text().splitlines()) < 80


@pytest.mark.parametrize("method", [[], ["--baseline"]], ids=["l2c2", "baseline"])
def test_brax_trains(
    method: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a small environment, with a finite reward and action variation in each iteration."""
    pytest.importorskip("brax")
    example = ROOT / "examples" / "brax_ant.py"
    small = ["--env", "fast", "--envs", "4", "--steps", "6", "--iterations", "2"]
    monkeypatch.setattr(sys, "argv", [str(example), *small, *method])
    with torch.random.fork_rng():
        runpy.run_path(str(example), run_name="__main__")
    line = r"^(\d+): reward (\S+), action variation (\S+)$"
    told = re.findall(line, capsys.readouterr().out, re.M)
    assert [iteration for iteration, _, _ in told] == ["1", "2"]
    assert all(math.isfinite(float(reward)) and float(change) > 0 for _, reward, change in told)
    assert len(example.read_text().splitlines()) < 80
