"""The lean collector gives what TorchRL's own gives, to the bit."""

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import (
    CatFrames,
    ExplorationType,
    GymEnv,
    GymWrapper,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    set_exploration_type,
)

from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import (
    AdamConfig,
    EpisodeCollector,
    Experiment,
    ExperimentConfig,
    SACConfig,
    TaskConfig,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.collect.episodes import play_episodes
from torchrl_l2c2.experiment.collect.rollouts import RolloutCollector
from torchrl_l2c2.experiment.envs.frames import Frame, stack_frames

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


def test_frames_played_one_by_one_are_the_episode():
    """Stacked they are its rollout, the random ones too; a row has all entries of each."""

    def collector():
        torch.manual_seed(0)
        env = GymEnv("Pendulum-v1", max_episode_steps=7)
        env.set_seed(2)
        actor = make_actor(3, env.action_spec)
        return EpisodeCollector(env, actor, frames_per_batch=7, random_frames=3)

    whole, alone = collector(), collector()
    torch.manual_seed(1)
    episodes = [whole.rollout() for _ in range(2)]
    torch.manual_seed(1)
    for episode in episodes:
        frames = [alone.step() for _ in range(7)]
        batch = stack_frames(frames)
        assert [frame.done for frame in frames] == [False] * 6 + [True]
        for key in batch.keys(True, True):
            assert torch.equal(batch[key], episode[key]), key
        row = frames[-1].row()
        assert all(torch.equal(row[key], batch[key][-1]) for key in batch.keys(True, True))


def test_an_episode_that_was_interrupted_is_not_gone_on_with(monkeypatch):
    """Its frames are lost: the next batch is a whole episode."""
    env, actor = make(TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.0, max_steps=9))
    collector = EpisodeCollector(env, actor, frames_per_batch=9)
    play, calls = collector._play, iter(range(100))

    def interrupted():
        if next(calls) == 4:
            raise KeyboardInterrupt
        return play()

    monkeypatch.setattr(collector, "_play", interrupted)
    with pytest.raises(KeyboardInterrupt):
        collector.rollout()
    episode = collector.rollout()
    assert len(episode) == 9 and episode["next", "done"].sum() == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_an_episode_is_not_gone_on_with_between_its_updates(monkeypatch, error):
    """Of an algorithm that learns after every frame, and is stopped in a notebook."""
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=3, max_steps=9)
    run = Experiment(
        ExperimentConfig(
            task=task,
            algorithm=SACConfig(hidden=(8,)),
            replay=UniformReplayConfig(),
            optimizer=AdamConfig(),
            compile=False,
        )
    )
    remember, calls = run.learner.remember_frame, iter(range(100))

    def interrupted(frame):
        remember(frame)
        if next(calls) == 12:
            raise error

    monkeypatch.setattr(run.learner, "remember_frame", interrupted)
    with pytest.raises(error):
        run.train()
    assert [row["frames"] for row in run.train()] == [9, 22, 31]  # 4 were lost
    assert {row["length"] for row in run.metrics} == {9}


@pytest.mark.parametrize("key", ["observation", "next_observation", "action", "reward"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_frame_knows_what_is_not_finite(key, value):
    """Wherever it is."""
    zeros = {"observation": torch.zeros(3), "next_observation": torch.zeros(3), "reward": 0.0}
    frame = Frame(outputs={"action": torch.zeros(1)}, terminated=False, truncated=False, **zeros)
    assert frame.is_finite()
    bad = torch.tensor([0.0, value, 0.0])
    if key == "action":
        frame = frame._replace(outputs={"action": bad})
    else:
        frame = frame._replace(**{key: value if key == "reward" else bad})
    assert not frame.is_finite()


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


def stacked(env):
    """The last two observations."""
    return TransformedEnv(env, CatFrames(2, dim=-1, in_keys=["observation"]))


OTHERS = {
    "another transform": lambda: stacked(GymEnv("Pendulum-v1", max_episode_steps=7)),
    "several": lambda: SerialEnv(2, lambda: stacked(GymEnv("Pendulum-v1", max_episode_steps=7))),
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize(
    "make", [EpisodeCollector, lambda env, *a, **k: RolloutCollector([env], *a, **k)]
)
def test_other_environments_are_refused(name, make):
    """With what plays them."""
    env = OTHERS[name]()
    actor = make_actor(6, env.action_spec_unbatched)
    with pytest.raises(ValueError, match=r"no transform except ObservationNoise, got"):
        make(env, actor, frames_per_batch=20)


@pytest.mark.parametrize("transforms", [[], [StepCounter()]], ids=("fast", "by torchrl"))
def test_a_test_episode_that_is_cut_is_not_gone_on_with(transforms):
    """Where the environment's own limit is longer, or it has none."""
    env = GymEnv("Pendulum-v1")
    env = TransformedEnv(env, *transforms) if transforms else env
    first, second = play_episodes(make_actor(3, env.action_spec), env, 2, max_steps=5)
    assert len(first) == len(second) == 5
    assert not second["observation"][0].equal(first["next", "observation"][-1])


class Counting(gymnasium.Env):
    """Shows the same array at every step, and writes into what it is given."""

    observation_space = gymnasium.spaces.Box(-99.0, 99.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.shown = np.zeros(1, dtype=np.float32)
        return self.shown, {}

    def step(self, action):
        self.shown += 1
        action *= 0
        return self.shown, 0.0, False, False, {}


@pytest.mark.parametrize(
    "make", [EpisodeCollector, lambda env, *a, **k: RolloutCollector([env], *a, **k)]
)
def test_what_a_simulator_writes_over_is_kept_as_it_was(make):
    """States, successors and actions, where it has one array for all of an episode."""
    env = GymWrapper(Counting())
    collector = make(env, make_actor(1, env.action_spec), frames_per_batch=4)
    played = collector.rollout()
    frames = played[0] if isinstance(played, list) else played
    assert frames["observation"].flatten().tolist() == [0.0, 1.0, 2.0, 3.0]
    assert frames["next", "observation"].flatten().tolist() == [1.0, 2.0, 3.0, 4.0]
    assert frames["action"].abs().min() > 0
