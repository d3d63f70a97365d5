"""Rollouts of a fixed length: what is in them, what is learned from them, how they are saved."""

import json
import os
import re
import signal
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from studies.noise import play_with_noise
from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import (
    AdamConfig,
    EpisodeCollector,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    RolloutReplayConfig,
    TaskConfig,
    load_policy,
    make_env,
)
from torchrl_l2c2.experiment.analysis.diagnosis.run import value_function
from torchrl_l2c2.experiment.cli import evaluate
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.run.evaluation import evaluate_policy
from torchrl_l2c2.experiment.run.signals import Interrupted
from torchrl_l2c2.metrics import action_rate, saturation

NOISY = TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.1, max_steps=9)
LANDER = TaskConfig("lunarlander", "LunarLanderContinuous-v3")
HOPPER = TaskConfig("hopper_v5", "Hopper-v5")


def actor_of(env, squash="tanh"):
    torch.manual_seed(0)
    size = env.observation_spec["observation"].shape[-1]
    return make_actor(size, env.action_spec, squash=squash)


def collector_of(task, seeds, frames, **settings):
    envs = [make_env(task, seed) for seed in seeds]
    return RolloutCollector(envs, actor_of(envs[0]), frames_per_batch=frames, **settings)


def played(collector, rollouts):
    """All frames of each simulator."""
    parts = [collector.rollout() for _ in range(rollouts)]
    return [torch.cat(stream) for stream in zip(*parts, strict=True)]


def assert_same(ours, theirs):
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    for key in theirs.keys(True, True):
        torch.testing.assert_close(ours[key], theirs[key], msg=str(key))


@pytest.mark.parametrize("task", [NOISY, HOPPER], ids=lambda task: task.name)
def test_a_simulator_gives_what_it_gives_alone(task):
    """Across ends and cuts, with sampled actions: the frames of the other collector."""
    env = make_env(task, 3)
    alone = EpisodeCollector(env, actor_of(env), frames_per_batch=240, stop_at_done=False)
    ours = collector_of(task, [3], 80)
    torch.manual_seed(1)
    expected = alone.rollout()
    torch.manual_seed(1)
    (frames,) = played(ours, 3)
    assert expected["next", "done"].sum() >= 1
    assert_same(frames, expected)


def test_several_simulators_play_their_own_episodes():
    """Each as if it were alone; ended episodes are whole, and come in the order of their ends."""
    mean = {"exploration_type": ExplorationType.DETERMINISTIC}
    seeds = (3, 4, 5)
    together = played(collector := collector_of(NOISY, seeds, 30, **mean), 2)
    for seed, frames in zip(seeds, together, strict=True):
        assert_same(frames, played(collector_of(NOISY, [seed], 10, **mean), 2)[0])
    # Of 20 frames each, nine an episode: in the second rollout the one of frames 9 to 17 ends.
    assert [episode.frame for episode in collector.finished_episodes] == [22, 23, 24]
    for frames, episode in zip(together, collector.finished_episodes, strict=True):
        assert_same(episode.transitions, frames[9:18])


@pytest.mark.parametrize("task", [NOISY, LANDER, HOPPER], ids=lambda task: task.name)
def test_episodes_in_the_middle_are_saved(task):
    """Noise, simulator and what was played of them: to the bit."""
    first = collector_of(task, [3, 4], 50)
    first.rollout()
    state, draws = first.generator_state(), torch.get_rng_state()
    expected, ended = played(first, 4), [e.transitions for e in first.finished_episodes]
    again = collector_of(task, [8, 9], 50)
    again.set_generator_state(state)
    torch.set_rng_state(draws)
    frames = played(again, 4)
    assert sum(stream["next", "done"].sum() for stream in expected) >= 1
    for ours, theirs in zip(frames, expected, strict=True):
        assert (ours == theirs).all()
    for ours, theirs in zip(again.finished_episodes, ended, strict=True):
        assert (ours.transitions == theirs).all()


@pytest.mark.parametrize("kind", ["rollouts", "episodes"])
def test_the_observation_before_is_kept(kind):
    """Over cuts, but not over ends: in an episode's first frame it is the frame's own."""
    if kind == "rollouts":
        (frames,) = played(collector_of(NOISY, [3], 5, keep_previous=True), 4)
    else:
        env = make_env(NOISY, 3)
        options = {"frames_per_batch": 5, "stop_at_done": False, "keep_previous": True}
        collector = EpisodeCollector(env, actor_of(env), **options)
        frames = torch.cat([collector.rollout() for _ in range(4)])
    seen, before = frames["observation"], frames["previous_observation"]
    first = torch.tensor([step % 9 == 0 for step in range(20)])
    assert before[first].equal(seen[first])
    assert before[1:][~first[1:]].equal(seen[:-1][~first[1:]])


class Moody(gymnasium.Env):
    """Shows what no generator of its own has drawn, and keeps the actions that it gets."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-0.1, 0.2, (1,), np.float32)
    count = 0

    def __init__(self):
        self.taken = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.show(), {}

    def step(self, action):
        self.taken.append(action)
        return self.show(), 1.0, False, False, {}

    def show(self):
        Moody.count += 1
        return np.array([Moody.count], np.float32)


class Global(gymnasium.Env):
    """Draws its rewards from NumPy's global generator, once where it is made."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.random.normal(size=1).astype(np.float32), {}

    def step(self, action):
        reward = float(np.random.normal())
        return np.random.normal(size=1).astype(np.float32), reward, False, False, {}


gymnasium.register("Global-v0", Global, max_episode_steps=20)


class Half(Moody):
    """Its actions have a least, and no largest."""

    action_space = spaces.Box(0.0, np.inf, (1,), np.float32)


gymnasium.register("Half-v0", Half, max_episode_steps=20)
gymnasium.register("Moody-v0", Moody, max_episode_steps=20)
MOODY = TaskConfig("moody", "Moody-v0", episodes=2)


def test_a_simulator_that_does_not_repeat_itself_is_told():
    """And begins another episode."""
    collector = collector_of(MOODY, [0], 10)
    collector.rollout()
    with pytest.warns(UserWarning, match="is not reproducible"):
        collector.set_generator_state(collector.generator_state())
    played(collector, 2)
    assert len(collector.finished_episodes[-1].transitions) == 20


ADAM, NONE = AdamConfig(), NoRegularizerConfig()


def experiment(task, folder=None, optimizer=ADAM, regularizer=NONE, **algorithm):
    settings = {"num_envs": 2, "frames": 40, "epochs": 1, "hidden": (8,), **algorithm}
    return Experiment(
        ExperimentConfig(
            task=task,
            algorithm=PPOConfig(**settings),
            regularizer=regularizer,
            replay=RolloutReplayConfig(batch_size=20),
            optimizer=optimizer,
            compile=False,
            test_episodes=1,
            late_share=0.0,
        ),
        folder,
    )


def test_the_task_gets_clipped_actions_and_the_loss_those_that_were_drawn():
    """Their likelihood is that of the normal; the mean that is deployed is clipped, too."""
    run = experiment(MOODY, clip_actions=True, log_scale=0.0)
    frames = torch.cat(run.player.play_rollout()[0])
    drawn = frames["action"].flatten()
    taken = [stream._gymnasium.unwrapped.taken for stream in run.player.collector._simulations]
    assert np.concatenate(taken).max() == np.float32(0.2) and drawn.max() > 0.2
    given = torch.from_numpy(np.concatenate(taken)).flatten()
    torch.testing.assert_close(given, drawn.clamp(-0.1, 0.2))
    normal = torch.distributions.Normal(frames["loc"], frames["scale"])
    expected = normal.log_prob(frames["action"]).squeeze(-1)
    torch.testing.assert_close(frames["action_log_prob"], expected)
    assert frames["scale"].eq(1.0).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        written = run.agent.policy(frames.select("observation"))
    assert not written["loc"].equal(written["action"])
    assert written["action"].equal(written["loc"].clamp(-0.1, 0.2))


def test_a_task_of_numpys_generator_is_tested_as_it_was(tmp_path, capsys):
    """By the command, and without noise; elsewhere than in the run's own process."""
    task = TaskConfig("global", "Global-v0", episodes=2)
    run = experiment(task, folder=tmp_path)
    run.train()
    finished = run.finish(run.test())
    expected = json.loads((tmp_path / "evaluation.json").read_text())["summary"]
    np.random.seed(7)
    evaluate.main([str(tmp_path), "--episodes", str(run.config.test_episodes)])
    assert json.loads(capsys.readouterr().out) == expected
    ((_, summaries),) = play_with_noise([finished], levels=[0.0], episodes=run.config.test_episodes)
    assert summaries[0.0]["return_mean"] == expected["return_mean"]


def test_a_bound_on_one_side_clips_what_is_deployed_too():
    """As it clips what training gives the task."""
    run = experiment(TaskConfig("half", "Half-v0", episodes=2), clip_actions=True, log_scale=0.0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        written = run.agent.policy(TensorDict({"observation": torch.randn(200, 1) * 100}, [200]))
    assert written["loc"].min() < 0 == written["action"].min()
    assert written["action"].equal(written["loc"].clamp_min(0.0))


def test_a_test_with_samples_gives_the_task_clipped_actions():
    """As training does; they are what is measured."""
    run = experiment(MOODY, clip_actions=True, log_scale=0.0)
    env = make_env(run.config.task, run.config.seed)
    result = evaluate_policy(run.agent.policy, env, 1, sampled=True)
    taken = torch.from_numpy(np.stack(env._env.unwrapped.taken))
    assert taken.max() == np.float32(0.2) and taken.min() == np.float32(-0.1)
    assert result.measures["sampled_saturation"] == [saturation(taken, -0.1, 0.2).item()]
    # Beyond a bound is at it, for the saturation; not for the change.
    assert result.measures["sampled_action_rate"] == pytest.approx([action_rate(taken).item()])


def test_what_a_cut_leaves_is_bootstrapped(monkeypatch):
    """At the cut and at a limit of time, from the true next observation; at an end, not."""
    run = experiment(HOPPER, num_envs=1, frames=60, gamma=0.5, gae_lambda=0.0)
    kept = []
    monkeypatch.setattr(run.learner.replay, "extend", kept.append)
    ((frames,), _) = run.player.play_rollout()
    ends = frames["next", "terminated"].squeeze(-1)
    assert ends.any() and not ends[-1]
    run.learner.remember(frames)
    value = run.agent.advantage.value_network
    following = value(frames["next"].select("observation"))["state_value"]
    expected = frames["next", "reward"] + 0.5 * following * ~ends.unsqueeze(-1)
    torch.testing.assert_close(kept[0]["value_target"], expected)


def test_training_learns_after_every_rollout_and_tells_ended_episodes():
    """40 frames a rollout of two simulators with episodes of 30: 60 and 120 frames end two each.

    130 frames end the training with the fourth rollout, which no episode ends in.
    """
    task = TaskConfig("pendulum", "Pendulum-v1", frames=130, max_steps=30)
    run = experiment(task)
    rows = run.train()
    assert [row["frames"] for row in rows] == [59, 60, 119, 120]
    assert [row["length"] for row in rows] == [30] * 4
    # Batches of 20 in a rollout's 40 frames.
    assert [row["updates"] for row in rows] == [4, 4, 6, 6]
    assert run.player.frames == 160 and run.learner.updates == 8


def test_a_signal_is_heeded_after_a_rollout_that_no_episode_ended_in(tmp_path, monkeypatch):
    """And saved, with the losses since the last episode: the run is the one in one go."""
    task = TaskConfig("pendulum", "Pendulum-v1", frames=160, max_steps=60)
    ramp = L2C2Config(policy_distance="mean", gain="ramp")
    settings = {"optimizer": AdamConfig(linear=True), "regularizer": ramp}
    whole = experiment(task, **settings)
    whole.train()
    first = experiment(task, tmp_path / "first", **settings)
    learn = first.learner.learn_rollout
    end = partial(os.kill, os.getpid(), signal.SIGTERM)
    monkeypatch.setattr(first.learner, "learn_rollout", lambda epochs: (learn(epochs), end()))
    with pytest.raises(Interrupted, match="SIGTERM ended the training after episode 0"):
        first.train()
    assert first.player.frames == 40 and 0.0 < first.agent.loss.regularizer_gain < 0.3
    first.close()
    again = Experiment(first.config, tmp_path / "first")
    again.train()
    for row in (*again.metrics, *whole.metrics):
        del row["frames_per_second"]
    assert str(again.metrics) == str(whole.metrics)  # Many are NaN.


def test_a_training_ends_with_an_episode_at_least():
    """Its results are of that, though the frames were used up before."""
    run = experiment(TaskConfig("pendulum", "Pendulum-v1", frames=10, max_steps=30))
    assert len(run.train()) == 2 and run.player.frames == 80


def test_a_policy_is_read_back_with_its_normalization(tmp_path):
    """From a checkpoint and from policy.pt; its tests are those of the run."""
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=4, max_steps=30)
    run = experiment(task, tmp_path, normalize_observations=True, normalize_rewards=True)
    run.train()
    assert run.agent.normalization.seen.count > 100
    assert not run.agent.normalization.mean.eq(0.0).any()
    result = run.test()
    observation = torch.tensor([[0.5, 0.5, 3.0]])
    for finished in (False, True):
        if finished:
            run.finish(result)
        policy = load_policy(tmp_path)[0]
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            ours, theirs = (
                each(TensorDict({"observation": observation}, [1]))["action"]
                for each in (policy, run.agent.policy)
            )
        assert ours.equal(theirs)
    seen = run.agent.normalization.normalize(observation)
    expected = run.agent.advantage.value_network(TensorDict({"observation": seen}, [1]))
    value = value_function(run.agent.loss, run.agent.normalization)
    assert value(observation, torch.zeros(1, 1)).equal(expected["state_value"])


def test_the_learning_rate_falls_in_a_line():
    """By frames: half of it is left after half of them; a compiled step's rate is a tensor."""
    task = TaskConfig("pendulum", "Pendulum-v1", frames=400, max_steps=10)
    run = experiment(task, optimizer=AdamConfig(lr=0.1, linear=True))
    (group,), rates = run.agent.optimizer.param_groups, []
    learn = run.learner.learn_rollout
    run.learner.learn_rollout = lambda epochs: (rates.append(float(group["lr"])), learn(epochs))
    group["lr"] = torch.tensor(group["lr"])
    run.train()
    # 40 frames a rollout, known after the one that follows.
    assert rates == pytest.approx([0.1 * (1 - 0.1 * i) for i in range(10)], abs=1e-6)


@pytest.mark.parametrize("saved", [True, False])
def test_a_signal_in_the_last_episode_ends_the_run_too(saved, tmp_path, monkeypatch):
    """Before its tests and the next runs of a sweep; the training is complete."""
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=60)
    folder = tmp_path if saved else None
    run = experiment(task, folder)
    record, end = run._record, partial(os.kill, os.getpid(), signal.SIGINT)
    monkeypatch.setattr(run, "_record", lambda *of: (record(*of), len(run.metrics) == 2 and end()))
    then = f"the same command continues it from {folder}." if saved else "nothing was saved, bec"
    with pytest.raises(Interrupted, match=re.escape(f"after episode 2; {then}")):
        run.train()
    run.close()
    if saved:
        again = Experiment(run.config, folder)
        assert len(again.train()) == 2 and again.player.frames == run.player.frames
