"""Tasks that observe images: what the networks see of them, and that they learn from it."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

from torchrl_l2c2.experiment import (
    AdamConfig,
    CAPSConfig,
    DQNConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.run.policies import load_policy

INF = float("inf")


class Lamp(gymnasium.Env):
    """A lit half of an image says where to press: the reward is 1 there, and -1 elsewhere."""

    def __init__(self, discrete=False, shape=(10, 12, 3)):
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.action_space = spaces.Discrete(2) if discrete else spaces.Box(-1, 1, (1,), np.float32)
        self._discrete = discrete

    def _see(self):
        self.right = bool(self.np_random.integers(2))
        image = np.zeros(self.observation_space.shape, np.uint8)
        half = image.shape[1] // 2
        image[:, slice(half, None) if self.right else slice(half)] = 255
        return image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._see(), {}

    def step(self, action):
        pressed = bool(action) if self._discrete else float(action[0]) > 0
        reward = 1.0 if pressed == self.right else -1.0
        return self._see(), reward, False, False, {}


class Shown(gymnasium.Env):
    """Shows one image."""

    def __init__(self, space=None, seen=None):
        self.observation_space, self.seen = space, seen
        self.action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.seen, {}

    def step(self, action):
        return self.seen, 0.0, False, False, {}


gymnasium.register("Lamp-v0", Lamp)
gymnasium.register("DiscreteLamp-v0", Lamp, kwargs={"discrete": True})
gymnasium.register("Shown-v0", Shown)


def task(env_id="Lamp-v0", **settings):
    return TaskConfig("lamp", env_id, **{"max_steps": 20, "images": True, **settings})


def shown(monkeypatch, space, seen):
    monkeypatch.setitem(gymnasium.registry["Shown-v0"].kwargs, "space", space)
    monkeypatch.setitem(gymnasium.registry["Shown-v0"].kwargs, "seen", seen)
    return make_env(task("Shown-v0"), 0)


@pytest.mark.parametrize(
    ("space", "seen", "expected"),
    [
        # A pixel of 51 in the second channel, at row 4 and column 1.
        (spaces.Box(0, 255, (5, 6, 3), np.uint8), ((4, 1, 1), 51), ((1, 4, 1), 0.2, (3, 5, 6))),
        (spaces.Box(0, 255, (4, 6, 7), np.uint8), ((3, 4, 1), 51), ((3, 4, 1), 0.2, (4, 6, 7))),
        (spaces.Box(0, 255, (5, 6), np.uint8), ((4, 1), 51), ((0, 4, 1), 0.2, (1, 5, 6))),
        (spaces.Box(-1.0, 1.0, (1, 5, 6)), ((0, 4, 1), 0.5), ((0, 4, 1), 0.75, (1, 5, 6))),
    ],
    ids=["channels last", "channels first", "gray", "floats"],
)
def test_an_image_is_seen_with_channels_first_from_0_to_1(monkeypatch, space, seen, expected):
    """A value by hand, in the place where it belongs."""
    image = np.full(space.shape, space.low.min(), space.dtype)
    image[seen[0]] = seen[1]
    observation = shown(monkeypatch, space, image).reset()["observation"]
    place, value, shape = expected
    assert observation.dtype == torch.float32 and tuple(observation.shape) == shape
    assert observation[place].item() == pytest.approx(value)
    observation[place] = 0.0
    assert not observation.any()


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(0.0, 1.0, (3,)),
        spaces.Dict(camera=spaces.Box(0, 255, (5, 6, 3), np.uint8)),
        spaces.Box(-INF, INF, (5, 6, 3)),
    ],
)
def test_what_is_no_image_is_refused(monkeypatch, space):
    """In one line that says what one is, or what it needs."""
    with pytest.raises(ValueError, match=r"task\.images=true: .*image") as refused:
        shown(monkeypatch, space, None)
    assert "\n" not in str(refused.value)


ALGORITHMS = {
    "ppo_rpe": (PPORPEConfig(hidden=(16,), gamma=0.0, reward_scale=1.0), UniformReplayConfig()),
    "sac": (SACConfig(random_frames=40, hidden=(16,), gamma=0.0), UniformReplayConfig()),
    "td3": (TD3Config(random_frames=40, hidden=(16,), gamma=0.0), UniformReplayConfig()),
    "ppo": (PPOConfig(frames=100, hidden=(16,), gamma=0.0), RolloutReplayConfig()),
    "dqn": (
        DQNConfig(random_frames=40, hidden=(16,), gamma=0.0, epsilon_frames=200),
        UniformReplayConfig(),
    ),
}


def lamp_experiment(name, regularizer, folder=None, episodes=40):
    algorithm, replay = ALGORITHMS[name]
    if name != "ppo":
        replay = UniformReplayConfig(batch_size=32)
    return Experiment(
        ExperimentConfig(
            task=task("DiscreteLamp-v0" if name == "dqn" else "Lamp-v0", episodes=episodes),
            algorithm=algorithm,
            regularizer=regularizer,
            replay=replay,
            optimizer=AdamConfig(lr=0.003),
            compile=False,
            test_episodes=5,
            late_share=0.0,
        ),
        folder,
    )


def test_where_to_press_is_learned_from_the_image(tmp_path):
    """It can be known from nothing else; the saved policy knows it too."""
    run = lamp_experiment("ppo", L2C2Config(), tmp_path, episodes=30)
    run.train()
    result = run.test()
    run.finish(result)
    run.close()
    assert np.mean(result.returns) > 15.0  # of 20; 0 without looking
    policy, env, steps = load_policy(tmp_path)
    assert env.rollout(steps, policy)["next", "reward"].sum() > 10.0


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_trains_its_convolutional_layers_with_l2c2(name):
    """All of them: those of policy and values."""
    run = lamp_experiment(name, L2C2Config(), episodes=6 if name == "ppo" else 3)
    seen = {
        key: value.clone()
        for key, value in run.agent.loss.named_parameters()
        if "encoder" in key and not key.startswith("target")
    }
    rows = run.train()
    learned = dict(run.agent.loss.named_parameters())
    assert seen and all(not torch.equal(learned[key], value) for key, value in seen.items())
    assert any(np.isfinite(row["l2c2_distance"]) for row in rows)


def test_caps_takes_images():
    """Its noisy states are images as well."""
    run = lamp_experiment("ppo_rpe", CAPSConfig(), episodes=2)
    rows = run.train()
    assert rows[-1]["updates"] > 0 and np.isfinite(rows[-1]["loss_caps_spatial"])
