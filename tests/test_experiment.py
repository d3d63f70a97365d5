"""Runs of the experiment, as a user starts them: short, but of every task and regularizer."""

import csv
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import (
    AdamConfig,
    CAPSConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPORPEConfig,
    TaskConfig,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.reports import read_runs, table
from torchrl_l2c2.experiment.training import check_finite

ROOT = Path(__file__).parent.parent
TASKS = {
    "swingup": "InvertedPendulumSwingupBulletEnv-v0",
    "reacher": "ReacherBulletEnv-v0",
    "hopper": "HopperBulletEnv-v0",
    "ant": "AntBulletEnv-v0",
}
PENDULUM = TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.01, episodes=2, max_steps=40)


def small(**settings):
    return ExperimentConfig(**{"task": PENDULUM, "compile": False, "test_episodes": 2, **settings})


@pytest.mark.parametrize("regularizer", [NoRegularizerConfig(), CAPSConfig(), L2C2Config()])
@pytest.mark.parametrize("task", TASKS)
def test_200_steps_of_every_task_with_every_regularizer(task, regularizer):
    """Collects, replays, updates and logs finite numbers, the regularizer's terms among them."""
    # Untrained, these fall after some twenty steps.
    episodes = 20 if task in ("hopper", "ant") else 2
    config = TaskConfig(
        task, f"pybullet_envs_gymnasium:{TASKS[task]}", episodes=episodes, max_steps=100
    )
    experiment = Experiment(
        ExperimentConfig(task=config, regularizer=regularizer, compile=False, test_episodes=1)
    )
    metrics = experiment.train()
    assert experiment.frames >= 200
    assert experiment.updates > 0
    terms = {key for key in metrics[-1] if key.startswith("loss_")}
    added = {
        "none": set(),
        "caps": {"loss_caps_temporal", "loss_caps_spatial"},
        "l2c2": {"loss_l2c2_actor", "loss_l2c2_critic"},
    }[regularizer.name]
    assert terms == {"loss_actor", "loss_critic"} | added
    assert len(experiment.test().returns) == 1


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others():
    """Everything random hangs on the seed."""

    def numbers(seed):
        row = Experiment(small(seed=seed)).train()[-1]
        return {key: value for key, value in row.items() if key != "frames_per_second"}

    assert numbers(0) == numbers(0)
    assert numbers(0) != numbers(1)


@pytest.mark.parametrize(
    "settings",
    [
        {"replay": UniformReplayConfig()},
        {"optimizer": AdamConfig()},
        {"algorithm": PPORPEConfig(schedule="step", updates=2)},
        {"algorithm": PPORPEConfig(acting_policy="online", baseline="target")},
        {"algorithm": PPORPEConfig(squash="none", threshold="ema", critic_weighting="none")},
        {"algorithm": PPORPEConfig(reward_scale=1.0, hidden=(8,), num_heads=1, updates=3)},
        {"task": replace(PENDULUM, noise_scale=0.0)},
    ],
    ids=str,
)
def test_every_alternative_changes_the_run(settings):
    """No option is read nowhere: each gives other parameters than the defaults do."""

    def parameters(**chosen):
        experiment = Experiment(small(**chosen))
        experiment.train()
        return torch.cat([p.detach().flatten() for p in experiment.agent.loss.parameters()])

    first, second = parameters(), parameters(**settings)
    assert second.isfinite().all()
    assert first.shape != second.shape or not torch.equal(first, second)


def test_updates_follow_the_schedule():
    """One pass over the buffer after each episode, or so many after each step."""
    episode = Experiment(small())
    episode.train()
    assert episode.updates == 40 // 32 + 80 // 32
    step = Experiment(small(algorithm=PPORPEConfig(schedule="step", updates=2)))
    step.train()
    # From the step on that fills the first batch of 32.
    assert step.updates == 2 * (2 * 40 - 31)


def test_the_acting_policy_is_the_current_target():
    """It shares the target's parameters, so it follows every update."""
    experiment = Experiment(small())
    before = [p.clone() for p in experiment.agent.policy.parameters()]
    experiment.train()
    target = experiment.agent.loss.target_actor_network_params
    observation = torch.randn(4, 3)
    with target.to_module(experiment.agent.loss.actor_network):
        expected = experiment.agent.loss.actor_network.module[0](observation)
    torch.testing.assert_close(experiment.agent.policy.module[0](observation), expected)
    after = list(experiment.agent.policy.parameters())
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_nan_from_the_environment_stops_the_run_with_key_and_frame():
    """Nothing is learned from it, and the message says where it began."""
    env = make_env(PENDULUM, seed=0)
    batch = env.rollout(10, make_actor(3, env.action_spec))
    batch["next", "reward"][4] = float("nan")
    with pytest.raises(FloatingPointError, match=r"'next', 'reward'.*frame 104"):
        check_finite(batch.detach(), first_frame=100)


def run_train(*overrides, folder, check=True):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [sys.executable, ROOT / "train.py", f"outputs={folder}", "compile=false", *overrides],
        cwd=folder,
        env=environment,
        check=check,
        capture_output=True,
        text=True,
    )


PENDULUM_OVERRIDES = (
    "task=gymnasium",
    "task.env_id=Pendulum-v1",
    "task.episodes=3",
    "task.max_steps=50",
    "test_episodes=2",
)


def test_a_run_from_the_command_line_leaves_everything_behind(tmp_path):
    """Configuration, versions, metrics, policy, test episodes, picture; the result is printed."""
    finished = run_train(*PENDULUM_OVERRIDES, "logger=tensorboard", folder=tmp_path)
    assert "this run" in finished.stdout and "2 test episodes, seed 0" in finished.stdout
    (run,) = read_runs(tmp_path)
    assert run.regularizer == "l2c2" and len(run.evaluation["episodes"]["returns"]) == 2
    with open(run.folder / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frames"] for row in rows] == ["50", "100", "150"]
    assert {"return", "action_variation", "loss_l2c2_actor", "l2c2_gain"} <= set(rows[0])
    assert "torchrl" in json.loads((run.folder / "versions.json").read_text())
    config = json.loads((run.folder / "config.json").read_text())
    assert ExperimentConfig.from_dict(config).task.env_id == "Pendulum-v1"
    assert (run.folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    assert list((run.folder / "tensorboard").glob("events*"))
    policy = torch.load(run.folder / "policy.pt", weights_only=True)
    make_actor(3, make_env(PENDULUM, 0).action_spec).load_state_dict(policy)


def test_a_sweep_gives_one_table(tmp_path):
    """Methods and seeds in their order; figures over seeds with every seed's own behind them."""
    overrides = ("-m", "regularizer=none,l2c2", "seed=0,1", "hydra/launcher=basic")
    run_train(*PENDULUM_OVERRIDES, *overrides, folder=tmp_path)
    runs = read_runs(tmp_path)
    assert [(run.regularizer, run.seed) for run in runs] == [
        ("none", 0),
        ("none", 1),
        ("l2c2", 0),
        ("l2c2", 1),
    ]
    rows = table(runs).splitlines()
    assert len(rows) == 4 and "| vanilla | 0, 1 |" in rows[2] and "| L2C2 | 0, 1 |" in rows[3]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["task=gymnasium", "task.env_id=Nowhere-v0"], "Nowhere-v0' is not a task that Gymnasium"),
        (["regularizer.sigma=-1"], "sigma must be finite and greater than 0"),
        (["regularizer.lambda_min=2"], "lambda_max must be greater than"),
        (["regularizer.beta=-0.1"], "beta"),
        (["algorithm.kappa=9"], "kappa must be in"),
        (["task=gymnasium", "task.env_id=CartPole-v1"], "needs continuous actions"),
    ],
)
def test_a_wrong_setting_ends_with_one_clear_line(tmp_path, overrides, message):
    """No traceback: what was given and what is allowed; and nothing is written half."""
    failed = run_train(*overrides, folder=tmp_path, check=False)
    assert failed.returncode == 1
    assert "Traceback" not in failed.stderr
    assert failed.stderr.strip().splitlines()[-1].startswith("error: ")
    assert message in failed.stderr
    assert not list(tmp_path.rglob("metrics.csv"))


def test_an_unwritable_folder_is_named(tmp_path):
    """Found before anything is computed."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="cannot be written to"):
        Experiment(small(), folder=tmp_path / "file")
