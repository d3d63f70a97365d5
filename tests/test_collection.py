"""The lean collector gives what TorchRL's own gives, to the bit."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import (
    ExplorationType,
    GymEnv,
    RewardSum,
    SerialEnv,
    TransformedEnv,
    set_exploration_type,
)

from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import TaskConfig, make_env
from torchrl_l2c2.experiment.collection import EpisodeCollector

HOPPER = TaskConfig("hopper", "pybullet_envs_gymnasium:HopperBulletEnv-v0", noise_scale=0.001)


def make(task):
    torch.manual_seed(0)
    env = make_env(task, seed=3)
    size = env.observation_spec["observation"].shape[-1]
    actor = make_actor(size, env.action_spec)
    return env, actor


@pytest.mark.parametrize(
    "task",
    [
        TaskConfig(max_steps=25),
        HOPPER,
        TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.0, max_steps=25),
    ],
    ids=lambda task: task.name,
)
def test_batches_equal_those_of_torchrls_collector_across_episodes(task):
    """Observations, noise, sampled actions, rewards, ends and resets: the same numbers."""
    batches = {}
    for kind, extra in ((EpisodeCollector, {"stop_at_done": False}), (Collector, {})):
        env, actor = make(task)
        collector = kind(env, actor, frames_per_batch=60, **extra)
        # Torch's own collector draws numbers while it is made.
        torch.manual_seed(1)
        batches[kind] = [batch for _, batch in zip(range(2), collector, strict=False)]
    for ours, theirs in zip(batches[EpisodeCollector], batches[Collector], strict=True):
        assert ours["next", "done"].sum() >= 1
        theirs = theirs.exclude("collector")
        assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
        for key in theirs.keys(True, True):
            torch.testing.assert_close(ours[key], theirs[key], rtol=0, atol=0, msg=str(key))


def test_a_batch_ends_where_the_episode_ends():
    """stop_at_done cuts the batch at the end, and the next one starts with the reset."""
    env, actor = make(HOPPER)
    collector = iter(EpisodeCollector(env, actor, frames_per_batch=1000))
    for _ in range(3):
        episode = next(collector)
        assert episode["next", "done"].flatten().nonzero().flatten().tolist() == [len(episode) - 1]


def test_the_policys_mean_acts_on_request():
    """Under DETERMINISTIC exploration the action is the distribution's deterministic sample."""
    env, actor = make(TaskConfig(max_steps=5))
    collector = EpisodeCollector(
        env, actor, frames_per_batch=5, exploration_type=ExplorationType.DETERMINISTIC
    )
    episode = next(iter(collector))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = actor(episode.select("observation"))["action"]
    torch.testing.assert_close(episode["action"], expected)


def test_other_environments_are_referred_to_torchrls_collector():
    """Batched environments and other transforms are refused by name."""
    env, actor = make(TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.0))
    with pytest.raises(TypeError, match=r"one GymEnv, got SerialEnv.*torchrl.collectors"):
        EpisodeCollector(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), actor, frames_per_batch=5)
    with pytest.raises(TypeError, match=r"RewardSum.*torchrl.collectors"):
        EpisodeCollector(TransformedEnv(env, RewardSum()), actor, frames_per_batch=5)
