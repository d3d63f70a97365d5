"""What a run measures is what it says: whose episodes, with which actions, in which units."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_l2c2 import action_variation, make_actor
from torchrl_l2c2.experiment import (
    AdamConfig,
    EpisodeCollector,
    Experiment,
    ExperimentConfig,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.agents.normalization import Normalization
from torchrl_l2c2.experiment.agents.optimizers import anneal, make_optimizer
from torchrl_l2c2.experiment.collect.player import make_collector
from torchrl_l2c2.experiment.envs.environments import NOISE_SEED
from torchrl_l2c2.experiment.run.checkpoints import list_checkpoints
from torchrl_l2c2.experiment.run.evaluation import Evaluation, LateTests
from torchrl_l2c2.experiment.settings.tasks import Budget

PENDULUM = TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.01, episodes=2, max_steps=40)


def small(**settings):
    values = {"task": PENDULUM, "algorithm": PPORPEConfig(replay_ratio=2.0, hidden=(8,))}
    return ExperimentConfig(**{**values, "compile": False, "test_episodes": 2, **settings})


def test_late_tests_are_of_the_mean_and_seeded_by_their_number():
    """The same episode whatever was played before; samples would vary by more than 1."""
    torch.manual_seed(0)
    policy = make_actor(3, make_env(PENDULUM, 0).action_spec)
    first, second = (LateTests(PENDULUM, 0, policy, False) for _ in range(2))
    second.play(1)
    found = first.play(3)
    assert found == second.play(3)
    assert found["test_return"] != first.play(4)["test_return"]
    assert found["test_action_variation"] < 0.3


def test_tests_play_episodes_of_their_own(monkeypatch):
    """Training, tests on the way, by which the best policy is chosen, and the test at the end."""
    seeds = []
    monkeypatch.setattr(
        "torchrl_l2c2.experiment.run.evaluation.make_env",
        lambda task, seed: seeds.append(seed) or make_env(task, seed),
    )
    run = Experiment(small(evaluate_every=2, late_share=0.0))
    run.train()
    run.test(1)
    assert len({run.config.seed, *seeds}) == 3


def test_simulators_side_by_side_begin_apart():
    """Their seeds differ."""
    algorithm = PPOConfig(num_envs=3, frames=30, hidden=(8,))
    task = replace(PENDULUM, noise_scale=0.0)
    run = Experiment(small(algorithm=algorithm, replay=RolloutReplayConfig(), task=task))
    firsts = [frames["observation"][0] for frames in run.player.play_rollout()[0]]
    assert len(torch.stack(firsts).unique(dim=0)) == 3


def test_the_seeds_of_many_simulators_are_seeds_of_numpy(monkeypatch):
    """Below 2 ** 32; the 278th simulator's is the first that would be above."""
    seeds = []
    monkeypatch.setattr(
        "torchrl_l2c2.experiment.collect.player.make_env", lambda task, seed: seeds.append(seed)
    )
    monkeypatch.setattr(
        "torchrl_l2c2.experiment.collect.player.RolloutCollector", lambda *_, **__: None
    )
    algorithm = PPOConfig(num_envs=300, frames=300, hidden=(8,))
    config = small(algorithm=algorithm, replay=RolloutReplayConfig())
    make_collector(config, None, SimpleNamespace(policy=None), compile=False)
    assert len(set(seeds)) == 299 and all(0 <= seed < 2**32 for seed in seeds)
    assert seeds[:277] == [config.seed + 15_485_863 * i for i in range(1, 278)]


def test_an_episode_that_is_too_short_for_a_measure_is_left_out_of_its_mean():
    """Of the others; without any, the mean is unknown."""
    sm = {"some": [math.nan, 1.0, 2.0], "none": [math.nan] * 3}
    summary = Evaluation([1.0, 2.0, 6.0], [0.0] * 3, [3, 9, 9], sm).summary()
    assert summary["some_mean"] == 1.5 and math.isnan(summary["none_mean"])
    assert summary["return_mean"] == 3.0 and summary["episodes"] == 3


def test_the_variation_in_the_log_is_that_of_the_mean():
    """Which gain=target follows; that of the samples is exploration, for the most part."""
    run = Experiment(small())
    episode = run.player.play()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        mean = run.agent.policy(episode.transitions.select("observation"))["action"]
    assert episode.measures["action_variation"] == action_variation(mean).item()


def test_the_observation_before_is_normalized_as_the_others():
    """Grad-CAPS and ASAP compare the policy at both."""
    torch.manual_seed(0)
    norm = Normalization(2, observations=True, rewards=False, gamma=0.9, streams=1)
    seen, ends = 5 + 3 * torch.randn(21, 2), torch.zeros(20, 1, dtype=torch.bool)
    then = {"observation": seen[1:], "reward": torch.ones(20, 1), "done": ends}
    now = {"observation": seen[:-1], "previous_observation": seen[:-1].clone()}
    frames = TensorDict({**now, "next": then}, [20])
    norm([frames])
    norm.apply_statistics()
    (given,) = norm([frames])
    assert given["previous_observation"].equal(given["observation"])
    assert not given["observation"].allclose(frames["observation"])


def test_a_frames_reward_is_scaled_as_an_episodes():
    """Of algorithms that learn after every frame."""
    algorithm = PPORPEConfig(schedule="step", reward_scale=0.5, hidden=(8,))
    run = Experiment(small(algorithm=algorithm))
    frame = run.player.step()
    run.learner.remember_frame(frame)
    stored = run.learner.replay[:]["next", "reward"].item()
    assert stored == pytest.approx(0.5 * frame.reward)


def test_parameters_that_are_not_finite_are_not_saved(tmp_path):
    """The last good checkpoint stays the last."""
    run = Experiment(small(), tmp_path)
    run.train(1)
    before = list_checkpoints(tmp_path)
    next(iter(run.agent.loss.parameters())).data.view(-1)[0] = math.inf
    run.metrics.append(run.metrics[0])
    with pytest.raises(FloatingPointError):
        run.save()
    run.close()
    assert list_checkpoints(tmp_path) == before


@pytest.mark.parametrize("delay", [2, 3])
def test_the_policy_is_updated_at_every_so_many_updates(delay):
    """In a run, and not by who calls the update."""
    algorithm = TD3Config(hidden=(8,), random_frames=0, policy_delay=delay)
    replay = UniformReplayConfig(batch_size=8)
    run = Experiment(small(algorithm=algorithm, replay=replay, optimizer=AdamConfig()))
    run.learner.remember(run.player.collector.env.rollout(20, run.agent.policy))
    update, turns = run.learner.update, []
    run.learner.update = lambda with_policy: turns.append(with_policy) or update(with_policy)
    run.learner.learn(2 * delay)
    assert turns == ([False] * (delay - 1) + [True]) * 2


def test_a_late_share_is_one_episode_at_least():
    """Of a training of five, a hundredth is the last; of none there is none."""
    assert [Budget(5).is_late(spent, 0.01) for spent in (4, 5)] == [False, True]
    assert not Budget(5).is_late(5, 0.0)


def test_a_training_that_goes_beyond_its_end_has_no_negative_learning_rate():
    """As a last rollout does."""
    config = AdamConfig(linear=True)
    optimizer = make_optimizer(config, [torch.nn.Parameter(torch.ones(1))])
    anneal(config, optimizer, 1.2)
    assert optimizer.param_groups[0]["lr"] == 0.0


def test_rewards_are_scaled_by_what_the_discount_leaves():
    """So that values are of the rewards' size, unless a factor is given."""
    assert PPORPEConfig(gamma=0.9).reward_factor == pytest.approx(0.1)
    assert PPORPEConfig(gamma=0.9, reward_scale=2.0).reward_factor == 2.0


def test_a_seed_of_the_collectors_gives_its_noise_another():
    """As where the environment is made: simulator and noise draw from streams of their own."""
    env = make_env(PENDULUM, 0)
    collector = EpisodeCollector(env, make_actor(3, env.action_spec), frames_per_batch=40)
    collector.set_seed(5)
    assert env.transform.generator.initial_seed() == 5 + NOISE_SEED
    collector.shutdown()


def test_random_frames_that_are_left_are_continued():
    """A run that goes on from the second frame of three has one more."""
    env = make_env(replace(PENDULUM, max_steps=2), 0)
    options = {"frames_per_batch": 2, "random_frames": 3}
    collector = EpisodeCollector(env, make_actor(3, env.action_spec), **options)
    collector.rollout()
    state = collector.generator_state()
    assert state["random_frames_left"] == 1
    collector.rollout()
    collector.set_generator_state(state)
    assert collector.generator_state()["random_frames_left"] == 1
    collector.shutdown()
