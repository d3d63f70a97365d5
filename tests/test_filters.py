"""studies.filters: low-pass filters, noise and delay at deployment; and the action-rate penalty."""

import csv

import gymnasium
import numpy as np
import pytest

from studies.filters import COLUMNS, CONDITIONS, main, play
from torchrl_l2c2.experiment import Experiment, ExperimentConfig, PPORPEConfig, TaskConfig
from torchrl_l2c2.experiment.analysis.reports import FinishedRun
from torchrl_l2c2.experiment.envs.environments import ActionRatePenalty
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS


def flipping():
    """A policy that flips from 2 to -2 and back."""
    sign = -1.0

    def act(observation):
        nonlocal sign
        sign = -sign
        return np.array([2.0 * sign], np.float32)

    return act


def played(**options):
    env = gymnasium.make("Pendulum-v1", max_episode_steps=4)
    return play(env, flipping(), 0, **options)


def test_the_filter_moves_towards_the_action_by_its_weight():
    """By hand: 2, then half of the way to -2, 2, -2."""
    assert played(weight=0.5)[1].flatten().tolist() == [2.0, 0.0, 1.0, -0.5]
    assert played()[1].flatten().tolist() == [2.0, -2.0, 2.0, -2.0]


def test_a_delay_applies_the_action_of_the_step_before():
    assert played(delay=True)[1].flatten().tolist() == [2.0, 2.0, -2.0, 2.0]


def test_noise_reaches_the_policy_and_not_the_state():
    """The policy observes other numbers; the episode of a policy that ignores them is the same."""
    env, seen = gymnasium.make("Pendulum-v1", max_episode_steps=4), []

    def act(observation):
        seen.append(observation)
        return np.zeros(1, np.float32)

    _, _, states = play(env, act, 0)
    _, _, same = play(env, act, 0, noise=np.array([0.0, 0.0, 1.0]))
    assert np.array_equal(states, same)
    clean, noisy = np.stack(seen[:4]), np.stack(seen[4:])
    assert np.array_equal(clean[:, :2], noisy[:, :2]) and (clean[:, 2] != noisy[:, 2]).all()


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A baseline, one with an action-rate penalty, and L2C2; without updates to speak of."""
    folder = tmp_path_factory.mktemp("runs")
    for name, action_rate in (("none", 0.0), ("none", 5.0), ("l2c2", 0.0)):
        task = TaskConfig(
            "pendulum", "Pendulum-v1", episodes=1, max_steps=20, action_rate=action_rate
        )
        config = ExperimentConfig(
            task=task,
            algorithm=PPORPEConfig(replay_ratio=1.0),
            regularizer=REGULARIZERS[name],
            compile=False,
            test_episodes=1,
        )
        experiment = Experiment(config, folder / f"{name}_{action_rate:g}")
        experiment.train()
        experiment.finish(experiment.test())
        experiment.close()
    return folder


def test_every_deployment_of_every_run_is_a_line_once(runs, tmp_path, monkeypatch):
    """The baseline has three filters, L2C2 one; started again, nothing is played twice."""
    monkeypatch.setattr("studies.filters.EPISODES", 1)
    main(runs, tmp_path / "filters.csv")
    with (tmp_path / "filters.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == COLUMNS and len(rows) == (4 + 1 + 2) * len(CONDITIONS)
    assert all(np.isfinite(float(row["return"])) for row in rows)
    main(runs, tmp_path / "filters.csv")
    assert len((tmp_path / "filters.csv").read_text().splitlines()) == len(rows) + 1


def test_only_training_has_the_action_rate_penalty(runs):
    """Without updates, both policies are the same: their tests agree, their training does not."""
    first, other = (FinishedRun.read(runs / name) for name in ("none_0", "none_5"))
    assert first.evaluation["episodes"] == other.evaluation["episodes"]
    assert first.column("return")[0] > other.column("return")[0] + 0.01
    free = gymnasium.make("Pendulum-v1")
    free.action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(UserError, match=r"Expected bounded actions with task\.action_rate=1"):
        ActionRatePenalty(free, 1.0)
