"""What leaves the package acts as what was trained."""

import json
import os
import re
import runpy
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from small import ALGORITHMS, replay_of
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import ExplorationType, GymWrapper, set_exploration_type

from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    PPORPEConfig,
    TaskConfig,
    evaluate_policy,
)
from torchrl_l2c2.experiment.analysis.export import export_policy
from torchrl_l2c2.experiment.cli.export import main
from torchrl_l2c2.experiment.envs.pictures import control_rate
from torchrl_l2c2.experiment.run.policies import load_policy

onnxruntime = pytest.importorskip("onnxruntime")
ROOT = Path(__file__).parents[1]


def finished_run(folder, name="ppo_rpe", algorithm=None, **task):
    config = ExperimentConfig(
        task=TaskConfig(
            "task", **{"env_id": "Pendulum-v1", "episodes": 2, "max_steps": 20, **task}
        ),
        algorithm=algorithm or ALGORITHMS[name],
        replay=replay_of(name),
        compile=False,
        test_episodes=1,
        late_share=0.0,
    )
    run = Experiment(config, folder)
    run.train()
    run.finish(run.test())
    run.close()
    return folder


@pytest.fixture(scope="module")
def pendulum(tmp_path_factory):
    """A run with noise on its observations, exported."""
    folder = finished_run(tmp_path_factory.mktemp("run"), noise_scale=0.05, max_steps=40)
    return export_policy(folder), folder


def onnx_actor(path):
    session = onnxruntime.InferenceSession(path)

    def act(observation):
        rows = observation.reshape(-1, observation.shape[-1]).numpy()
        action = torch.from_numpy(session.run(["action"], {"observation": rows})[0])
        return action.reshape(*observation.shape[:-1], -1)

    return TensorDictModule(act, in_keys=["observation"], out_keys=["action"])


def test_over_ten_episodes_the_return_is_that_of_pytorch(pendulum):
    """On the same seeds and noise; so is the action variation."""
    exported, folder = pendulum
    results = []
    for exchange in (lambda policy: policy, lambda _: onnx_actor(exported.folder / "policy.onnx")):
        policy, env, steps = load_policy(folder, seed=3)
        results.append(evaluate_policy(exchange(policy), env, 10, max_steps=steps))
    ours, theirs = results
    np.testing.assert_allclose(theirs.returns, ours.returns, rtol=1e-4)
    np.testing.assert_allclose(theirs.action_variations, ours.action_variations, rtol=1e-3)


def test_the_contract_says_what_the_simulator_says(pendulum):
    """Order, bounds and rate; the difference was measured on a whole episode."""
    exported, folder = pendulum
    contract = json.loads((exported.folder / "contract.json").read_text())
    assert contract == exported.contract
    assert contract["task"] == "Pendulum-v1" and contract["noise_scale"] == 0.05
    assert contract["observation"]["shape"] == ["batch", 3]
    assert contract["observation"]["entries"][2] == "observation[2]"
    assert contract["action"]["low"] == [-2.0] and contract["action"]["high"] == [2.0]
    tested = json.loads((folder / "evaluation.json").read_text())["summary"]
    assert contract["test"].items() < tested.items() and contract["test"]["episodes"] == 1
    assert contract["actions_per_second"] == 20.0 and contract["longest_episode"] == 40
    assert contract["agreement"]["observations"] == 40
    assert contract["agreement"]["largest_difference"] < 1e-5


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithms_policy_is_the_same_in_all_three_forms(tmp_path, name):
    """In batches of any size."""
    folder = finished_run(tmp_path, name)
    exported = export_policy(folder)
    policy, env, _ = load_policy(folder)
    observations = torch.randn(7, env.observation_spec["observation"].shape[-1])
    session = onnxruntime.InferenceSession(exported.folder / "policy.onnx")
    (onnx,) = session.run(["action"], {"observation": observations.numpy()})
    program = torch.export.load(exported.folder / "policy.pt2").module()(observations)
    with torch.no_grad():
        expected = torch.stack([mean_action(policy, each) for each in observations])
    torch.testing.assert_close(program, expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(onnx, expected.numpy(), rtol=1e-4, atol=1e-5)


def mean_action(policy, observation):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return policy(TensorDict({"observation": observation}))["action"]


class Named(gymnasium.Env):
    """Two entries, unsorted."""

    observation_space = gymnasium.spaces.Dict(
        {"speed": gymnasium.spaces.Box(-1, 1, (2,)), "angle": gymnasium.spaces.Box(-1, 1, (1,))}
    )
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


gymnasium.register("Named-v0", Named)


class Clock(gymnasium.Env):
    """Every episode is the same but for its actions, which are its rewards."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, observation_space):
        self.observation_space = observation_space

    def see(self):
        self.observation_space.seed(self.time)
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.see(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.time += 1
        return self.see(), float(action[0]), False, False, {}


gymnasium.register("Clock-v0", Clock)
ANGLE = gymnasium.spaces.Box(-1, 1, (2,))
NESTED = OrderedDict(b=ANGLE, a=gymnasium.spaces.Dict(label=gymnasium.spaces.Discrete(4)))


@pytest.mark.parametrize(
    ("space", "task"),
    [
        (gymnasium.spaces.Box(-9, 9, (2,), np.float64), {}),
        (gymnasium.spaces.Dict(NESTED), {"flatten": True}),
    ],
    ids=["vector", "nested"],
)
def test_the_example_plays_what_the_run_tested(tmp_path, monkeypatch, capsys, space, task):
    """Return, action variation and observations are those of the run's policy."""
    monkeypatch.setitem(gymnasium.registry["Clock-v0"].kwargs, "observation_space", space)
    folder = finished_run(tmp_path, "sac", env_id="Clock-v0", **task)
    # A policy of a few updates does the same at all times.
    weights = torch.load(folder / "policy.pt", weights_only=True)
    torch.manual_seed(0)
    torch.save({k: 3 * torch.randn(v.shape) for k, v in weights.items()}, folder / "policy.pt")
    policy, env, steps = load_policy(folder)
    expected = evaluate_policy(policy, env, 1, max_steps=steps).summary()
    example = runpy.run_path(str(ROOT / "examples" / "onnx_policy.py"))
    exported = export_policy(folder)
    seen = example["observed"](space, Clock(space).reset()[0], exported.contract["observation"])
    np.testing.assert_allclose(env.reset()["observation"], seen, rtol=1e-6)
    example["play"](exported.folder, 1)
    told = dict(re.findall(r"^([a-z ]+) (\S+)$", capsys.readouterr().out, re.M))
    assert float(told["return"]) == pytest.approx(expected["return_mean"], abs=0.05)
    variation = expected["action_variation_mean"]
    assert float(told["action variation"]) == pytest.approx(variation, abs=1e-3)
    assert variation > 0


def test_episodes_of_one_step_are_enough_and_no_bounds_are_made_up(tmp_path):
    """One row is all that there is to trace; an unbounded action has no lowest.

    Named observations keep their names, in the order in which the policy reads them, which is not
    that of the space.
    """
    folder = finished_run(
        tmp_path, algorithm=PPORPEConfig(hidden=(8,), squash="none"), env_id="Free-v0", max_steps=1
    )
    contract = export_policy(folder).contract
    assert contract["agreement"]["observations"] == 1
    assert contract["action"].keys() == {"shape", "dtype", "entries"}
    assert contract["observation"]["entries"] == ["angle[0]", "speed[0]", "speed[1]"]


class Free(Named):
    """Takes any number."""

    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)


gymnasium.register("Free-v0", Free)


@pytest.mark.parametrize(
    ("env_id", "rate"),
    [
        ("Pendulum-v1", 20.0),
        ("CartPole-v1", 50.0),
        ("MountainCar-v0", 30.0),
        ("Named-v0", None),
        ("pybullet_envs_gymnasium:HopperBulletEnv-v0", 1 / 0.0165),
    ],
)
def test_the_rate_of_control_is_the_simulators(env_id, rate):
    """Of its step, else of its pictures, else unknown."""
    env = GymWrapper(gymnasium.make(env_id), categorical_action_encoding=True)
    env.reset()
    assert control_rate(env) == (None if rate is None else pytest.approx(rate, rel=1e-5))


def test_the_example_plays_it_without_this_package(pendulum, tmp_path):
    """Under 80 lines; neither torch nor this package is imported."""
    exported, _ = pendulum
    example = ROOT / "examples" / "onnx_policy.py"
    assert len(example.read_text().splitlines()) < 80
    hidden = tmp_path / "sitecustomize.py"
    hidden.write_text("import sys; sys.modules.update(torch=None, torchrl_l2c2=None)")
    done = subprocess.run(
        [sys.executable, example, exported.folder, "2"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    told = dict(re.findall(r"^([a-z ]+) (\S+)$", done.stdout, re.M))
    assert -1000 < float(told["return"]) < 0 < float(told["action variation"]) < 4


def test_the_command_prints_the_contract_and_says_what_is_wrong(pendulum, tmp_path, capsys):
    """A folder that is no run, and an extra that is missing, are one line."""
    _, folder = pendulum
    main([str(folder), "--output", str(tmp_path / "elsewhere")])
    assert json.loads(capsys.readouterr().out)["policy"] == "policy.pt"
    assert (tmp_path / "elsewhere" / "policy.onnx").exists()
    with pytest.raises(SystemExit, match=r"error: '.*' is not a run folder"):
        main([str(tmp_path)])


def test_a_folder_that_cannot_be_written_to_is_refused_before_anything_is_played(
    pendulum, tmp_path, monkeypatch
):
    """A file is no folder; the run's own folder is the default."""
    monkeypatch.setattr("torchrl_l2c2.experiment.analysis.export.play_episodes", None)
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit, match=r"error: the folder '.*file' cannot be written to"):
        main([str(pendulum[1]), "--output", str(tmp_path / "file")])


def test_without_the_extra_it_says_how_to_get_it(pendulum, monkeypatch):
    """Before anything is played."""
    monkeypatch.setattr("torchrl_l2c2.experiment.analysis.export.find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r'onnxscript not installed\. .*"\.\[export'):
        export_policy(pendulum[1])
