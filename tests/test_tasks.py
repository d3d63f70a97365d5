"""Any task of Gymnasium: what it observes, takes and lasts."""

import copy
import json
import math
from collections import OrderedDict

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from small import ALGORITHMS, replay_of

from torchrl_l2c2.experiment import (
    PAPER_TASKS,
    AdamConfig,
    EpisodeCollector,
    Experiment,
    ExperimentConfig,
    PPOConfig,
    PPORPEConfig,
    TaskConfig,
    make_env,
)
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.envs.environments import TEST_SEED, ActionRatePenalty, time_limit
from torchrl_l2c2.experiment.envs.pictures import Drawing
from torchrl_l2c2.experiment.errors import SimulatorError, UserError
from torchrl_l2c2.experiment.run.evaluation import evaluate_task

INF = float("inf")
VECTOR = spaces.Box(-INF, INF, (2,), np.float32)
ACTION = spaces.Box(-1.0, 1.0, (1,), np.float32)


class Still(gymnasium.Env):
    """Shows the one observation that it is given, and keeps the actions that it gets."""

    def __init__(self, space=VECTOR, seen=None, action=ACTION):
        self.observation_space, self.action_space = space, action
        self.seen = space.sample() if seen is None else seen
        self.taken = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return copy.deepcopy(self.seen), {}

    def step(self, action):
        self.taken.append(action)
        return copy.deepcopy(self.seen), float(self.np_random.normal()), False, False, {}


gymnasium.register("Still-v0", Still)  # without a limit of its own


def task(env_id="Still-v0", **settings):
    return TaskConfig("task", env_id, **{"max_steps": 20, **settings})


def still(monkeypatch, **arguments):
    """Has the next tasks be made with these spaces."""
    monkeypatch.setitem(gymnasium.registry["Still-v0"].kwargs, "space", VECTOR)
    for name, value in arguments.items():
        monkeypatch.setitem(gymnasium.registry["Still-v0"].kwargs, name, value)


def observed(chosen):
    """What the run's own collector shows of a task, which steps it without TorchRL's specs."""
    env = make_env(chosen, 0)
    policy = make_agent(ExperimentConfig(algorithm=PPORPEConfig(squash="none")), env).policy
    episode = EpisodeCollector(env, policy, frames_per_batch=3).rollout()
    assert env.observation_spec["observation"].dtype == torch.float32
    assert episode["observation"].dtype == episode["next", "observation"].dtype == torch.float32
    return episode["observation"][0].tolist()


INTEGERS = spaces.Box(-9, 9, (3,), np.int64)
PARTS = {
    "velocity": spaces.Box(-INF, INF, (2,), np.float64),
    "angle": spaces.Box(-INF, INF, (), np.float32),
    "contact": spaces.MultiBinary(2),
}
SEEN = {"velocity": np.array([1.0, 2.0]), "angle": np.array(3.0, "f4"), "contact": [0, 1]}
MATRIX = spaces.Box(-9.0, 9.0, (2, 2), np.float32)


@pytest.mark.parametrize(
    ("space", "seen", "expected"),
    [
        (spaces.Box(-INF, INF, (2,), np.float64), np.array([0.5, 2.0]), [0.5, 2.0]),
        (INTEGERS, np.array([1, -2, 3]), [1.0, -2.0, 3.0]),
        (spaces.MultiBinary(3), np.array([1, 0, 1], np.int8), [1.0, 0.0, 1.0]),
        (spaces.Dict(PARTS), {**SEEN, "contact": np.array([0, 1], "i1")}, [3, 0, 1, 1, 2]),
        (
            spaces.Dict(OrderedDict(b=VECTOR, a=VECTOR)),
            OrderedDict(b=np.array([1, 2], "f4"), a=np.array([3, 4], "f4")),
            [3.0, 4.0, 1.0, 2.0],
        ),
    ],
    ids=["float64", "integers", "binary", "several", "unsorted"],
)
def test_vectors_of_numbers_are_observed_as_one_of_float32(monkeypatch, space, seen, expected):
    """Several are put together in the order of their names, not of the space."""
    still(monkeypatch, space=space, seen=seen)
    assert observed(task()) == expected


@pytest.mark.parametrize(
    ("space", "seen", "expected"),
    [
        (MATRIX, np.array([[1, 2], [3, 4]], "f4"), [1.0, 2.0, 3.0, 4.0]),
        (spaces.Discrete(3), 1, [0.0, 1.0, 0.0]),
        (
            spaces.Dict({"m": MATRIX, "d": spaces.Dict({"label": spaces.Discrete(2)})}),
            {"m": np.array([[1, 2], [3, 4]], "f4"), "d": {"label": 1}},
            [0.0, 1.0, 1.0, 2.0, 3.0, 4.0],
        ),
    ],
    ids=["matrix", "label", "nested"],
)
def test_matrices_labels_and_nested_entries_become_a_vector_on_request(
    monkeypatch, space, seen, expected
):
    """And without it are refused in one line that says so."""
    still(monkeypatch, space=space, seen=seen)
    assert observed(task(flatten=True)) == expected
    with pytest.raises(ValueError, match=r"vector of numbers: set task\.flatten=true") as refused:
        make_env(task(), 0)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("flatten", [False, True])
@pytest.mark.parametrize(
    "space", [spaces.Tuple([VECTOR, VECTOR]), spaces.Text(3), spaces.Dict(a=spaces.Text(3))]
)
def test_what_is_no_numbers_is_refused(monkeypatch, space, flatten):
    """In one line that says what to do."""
    still(monkeypatch, space=space)
    with pytest.raises(ValueError, match=r"observes a (Tuple|Text|Dict).*vector") as refused:
        make_env(task(flatten=flatten), 0)
    assert "\n" not in str(refused.value)


def test_an_observation_without_entries_is_refused(monkeypatch):
    """In one line, before anything is made of it."""
    still(monkeypatch, space=spaces.Box(-1, 1, (0,)))
    with pytest.raises(UserError, match="observation is a vector without entries"):
        make_env(task(), 0)


def test_an_image_is_refused_with_the_setting_that_flattens_it(monkeypatch):
    """The experiment has no convolutional networks."""
    still(monkeypatch, space=spaces.Box(0, 255, (8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match=r"observes a Box of uint8 .*task.flatten=true"):
        make_env(task(), 0)


def experiment(name, chosen, folder=None, **settings):
    return Experiment(
        ExperimentConfig(
            **{
                "task": chosen,
                "algorithm": ALGORITHMS[name],
                "replay": replay_of(name),
                "optimizer": AdamConfig(lr=0.001),
                "compile": False,
                "test_episodes": 1,
                "late_share": 0.0,
                **settings,
            }
        ),
        folder,
    )


def actions(run):
    return np.array(run.player.collector._simulation._gymnasium.unwrapped.taken)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_fill_asymmetric_bounds_and_stay_within(monkeypatch, name):
    """Of every algorithm, in the dtype that the task takes."""
    low, high = np.array([-1.0, 2.0]), np.array([3.0, 2.5])
    still(monkeypatch, action=spaces.Box(low, high, dtype=np.float64))
    run = experiment(name, task(episodes=3))
    run.train()
    taken = actions(run)
    assert taken.dtype == np.float64 and run.learner.updates > 0
    assert (taken >= low).all() and (taken <= high).all()
    middle = (low + high) / 2
    assert (np.abs(taken.mean(0) - middle) < 0.5 * (high - low)).all()


@pytest.mark.parametrize("low", [-INF, 0.0])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_without_bounds_are_refused_where_they_are_squashed(monkeypatch, name, low):
    """Also where one side is open; the error says what takes them."""
    still(monkeypatch, action=spaces.Box(low, INF, (1,), np.float32))
    with pytest.raises(ValueError, match=r"squashes actions.*algorithm\.squash=none") as refused:
        experiment(name, task())
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_actions_that_can_take_one_value_alone_are_refused_where_they_are_drawn(monkeypatch, name):
    """With which they are; a deterministic policy takes that value."""
    still(monkeypatch, action=spaces.Box(np.array([-1.0, 2.0], "f4"), np.array([1.0, 2.0], "f4")))
    if name == "td3":
        experiment(name, task())
        return
    with pytest.raises(ValueError, match=r"entries \[1\] of this task's actions have only one"):
        experiment(name, task())


SEVERAL_ENVS = PPOConfig(frames=20, num_envs=2, epochs=1, hidden=(8,))


@pytest.mark.parametrize(
    ("name", "settings"),
    [("sac", {}), ("ppo", {}), ("ppo", {"algorithm": SEVERAL_ENVS})],
    ids=["frame by frame", "episodes", "rollouts"],
)
def test_a_reward_may_be_an_array_of_one_number(monkeypatch, name, settings):
    """However it is played; of several, the task is named."""
    step = Still.step
    for count in (1, 2):

        def paid(self, action, count=count):
            seen, reward, *rest = step(self, action)
            return seen, np.full(count, reward), *rest

        monkeypatch.setattr(Still, "step", paid)
        still(monkeypatch)
        run = experiment(name, task(episodes=2), **settings)
        if count == 1:
            assert all(math.isfinite(row["return"]) for row in run.train())
            continue
        with pytest.raises(
            SimulatorError,
            match=r"Still-v0 failed .* expected one number as the reward",
        ):
            run.train()


@pytest.mark.parametrize("flags", [(1, 0), (np.array([True]), None), (np.int64(1), np.bool_(0))])
@pytest.mark.parametrize(
    ("name", "settings"),
    [("sac", {}), ("ppo", {}), ("ppo", {"algorithm": SEVERAL_ENVS})],
    ids=["frame by frame", "episodes", "rollouts"],
)
def test_the_ends_of_an_episode_need_not_be_booleans(monkeypatch, name, settings, flags):
    """Integers would be learned from as integers, where not 0 is -1."""
    step = Still.step

    def ended(self, action):
        seen, reward, *_ = step(self, action)
        return seen, reward, *flags, {}

    monkeypatch.setattr(Still, "step", ended)
    still(monkeypatch)
    run = experiment(name, task(episodes=2, max_steps=3), **settings)
    monkeypatch.setattr(run.learner.replay, "empty", lambda *_: None)
    run.train()
    stored = run.learner.replay[:]["next"]
    for key in ("done", "terminated"):
        assert stored[key].dtype == torch.bool and stored[key].all(), key
    assert run.test(1).lengths == [1]
    assert len(make_env(task(max_steps=3), 0).rollout(3)) == 1  # as for diagnose


@pytest.mark.parametrize(
    ("method", "raises", "message"),
    [
        ("__init__", KeyError("licence"), "Still-v0 could not start: KeyError: 'licence'"),
        ("reset", TypeError("no seed"), "Still-v0 could not start: TypeError: no seed"),
        ("reset", SystemExit(3), "Still-v0 could not start: SystemExit: 3"),
    ],
)
def test_what_a_task_raises_before_it_plays_names_it(monkeypatch, method, raises, message):
    """With the error behind it, whose lines are shown."""
    still(monkeypatch)

    def fail(*_, **__):
        raise raises

    monkeypatch.setattr(Still, method, fail)
    with pytest.raises(SimulatorError, match=message) as raised:
        make_env(task(), 0)
    assert raised.value.__cause__ is raises


@pytest.mark.parametrize(("name", "settings"), [("sac", {}), ("ppo", {"algorithm": SEVERAL_ENVS})])
def test_a_task_of_an_old_generator_is_refused(monkeypatch, name, settings):
    """Its state could not be saved as that of NumPy's generators."""
    still(monkeypatch)
    monkeypatch.setattr(Still, "np_random", np.random.RandomState(0))
    found = "Expected a numpy.random.Generator as np_random of Still, got RandomState"
    with pytest.raises(UserError, match=found):
        experiment(name, task(), **settings)


def test_a_task_that_cannot_be_seeded_is_named(monkeypatch):
    """Its reset raises only if it gets a seed."""
    still(monkeypatch)
    reset = Still.reset

    def seeded(self, *, seed=None, options=None):
        if seed == 7:
            raise RuntimeError("seeds are even")
        return reset(self, seed=seed)

    monkeypatch.setattr(Still, "reset", seeded)
    with pytest.raises(SimulatorError, match=r"Still-v0 could not start: .*seeds are even"):
        make_env(task(), 7)


@pytest.mark.parametrize(
    ("where", "settings"),
    [
        ("the test after episode 1", {"late_share": 1.0}),
        ("test episode 1", {"evaluate_every": 1}),
        ("test episode 1", {}),
    ],
    ids=["late", "during training", "at the end"],
)
def test_what_a_task_raises_in_a_test_is_told_as_in_training(monkeypatch, where, settings):
    """Tests play in environments of their own, which may fail where training's do not."""
    still(monkeypatch)
    trained, step = experiment("sac", task(episodes=1), **settings), Still.step
    training = trained.player.collector._simulation._gymnasium.unwrapped

    def fail(self, action):
        if self is not training:
            raise KeyError("cable")
        return step(self, action)

    monkeypatch.setattr(Still, "step", fail)
    with pytest.raises(SimulatorError, match=f"failed in {where}: KeyError: 'cable'"):
        trained.train()
        trained.test(1)


def test_a_reset_that_fails_in_a_late_test_is_told_as_well(monkeypatch):
    """It is reset with the seed of the test after episode 1."""
    still(monkeypatch)
    trained, reset = experiment("sac", task(episodes=1), late_share=1.0), Still.reset

    def fail(self, *, seed=None, options=None):
        if seed == trained.config.seed + TEST_SEED + 1:
            raise KeyError("cable")
        return reset(self, seed=seed)

    monkeypatch.setattr(Still, "reset", fail)
    with pytest.raises(SimulatorError, match="failed in the test after episode 1: KeyError"):
        trained.train()


class Drawn(Still):
    """Takes a way of drawing, as usual, and what it says of it."""

    def __init__(self, render_mode=None, modes=("rgb_array",), **spaces):
        super().__init__(**spaces)
        self.render_mode, self.metadata = render_mode, {"render_modes": list(modes)}


gymnasium.register("Drawn-v0", Drawn)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("modes", [["rgb_array"], ["human"], []])
def test_a_task_that_cannot_draw_says_so(monkeypatch, modes):
    """It has no render(), or none that gives pictures."""
    for name, value in {"space": VECTOR, "modes": modes}.items():
        monkeypatch.setitem(gymnasium.registry["Drawn-v0"].kwargs, name, value)
    with pytest.raises(ValueError, match="Drawn-v0 cannot render pictures: it has no render_mode"):
        make_env(task("Drawn-v0"), 0, render=Drawing())
    make_env(task("Drawn-v0"), 0).close()


def test_an_action_with_equal_bounds_has_no_action_rate_penalty(monkeypatch):
    """Its range is 0; the other action moves over its whole range: 2 halves, squared, over 2."""
    action = spaces.Box(np.float32([-1.0, 0.5]), np.float32([1.0, 0.5]))
    env = ActionRatePenalty(Still(action=action), weight=3.0)
    monkeypatch.setattr(Still, "step", lambda self, action: (self.seen, 0.0, False, False, {}))
    env.reset()
    rewards = [env.step(np.float32([u, 0.5]))[1] for u in (-1.0, 1.0, 1.0)]
    assert rewards == [0.0, -3.0 * 2.0**2 / 2, 0.0]


def test_the_action_rate_is_that_of_the_given_actions(monkeypatch):
    """The task changes them in place: by 0, then 2 halves of the range, as without the change."""
    env = ActionRatePenalty(Still(), weight=3.0)

    def step(self, action):
        action *= 0.1
        return self.seen, 0.0, False, False, {}

    monkeypatch.setattr(Still, "step", step)
    env.reset()
    rewards = [env.step(np.float32([u]))[1] for u in (-1.0, -1.0, 1.0)]
    assert rewards == [0.0, 0.0, -3.0 * 2.0**2]


def test_a_failed_test_closes_its_environment(monkeypatch):
    """Some simulators keep a window or a process."""
    closed = []
    monkeypatch.setattr(Still, "close", lambda self: closed.append(self))
    policy = make_agent(ExperimentConfig(task=task()), make_env(task(), 0)).policy
    monkeypatch.setattr(Still, "step", lambda self, action: 1 / 0)
    with pytest.raises(SimulatorError, match="ZeroDivisionError"):
        evaluate_task(policy, task(), 0, 1, threads=1)
    assert len(closed) == 1


def test_returns_that_are_no_number_are_not_averaged(monkeypatch):
    """Each of the rewards is finite, and their sum is not."""
    still(monkeypatch)
    step = Still.step

    def paid(self, action):
        seen, _, *rest = step(self, action)
        return seen, 3e38, *rest

    run = experiment("sac", task(episodes=1))
    monkeypatch.setattr(Still, "step", paid)
    with pytest.raises(FloatingPointError, match=r"of a test episode is inf, the sum of \d+ fin"):
        run.test(1)


def test_ppo_rpe_acts_without_bounds_where_it_does_not_squash(monkeypatch):
    """A normal's samples reach beyond 1, and training is finite."""
    still(monkeypatch, action=spaces.Box(-INF, INF, (1,), np.float32))
    run = experiment("ppo_rpe", task(episodes=3), algorithm=PPORPEConfig(squash="none"))
    run.train()
    assert run.learner.updates > 0 and np.abs(actions(run)).max() > 1.0


@pytest.mark.parametrize(
    "action",
    [
        spaces.Discrete(3),
        spaces.MultiBinary(2),
        spaces.Box(0, 3, (2,), np.int64),
        MATRIX,
        spaces.Dict(a=ACTION),
    ],
)
def test_actions_that_are_no_vector_are_refused(monkeypatch, action):
    """In one line that says what may be."""
    still(monkeypatch, action=action)
    with pytest.raises(ValueError, match="must be one vector of floats"):
        make_env(task(), 0)


def test_noise_is_not_what_a_policy_draws_with_the_same_seed(monkeypatch):
    """A run's seed is that of torch's global generator, and of its task."""
    still(monkeypatch, seen=np.zeros(2, np.float32))
    noise = make_env(task(noise_scale=1.0), 7).rollout(10)["observation"]
    torch.manual_seed(7)
    drawn = torch.cat([torch.randn(1) for _ in range(100)])
    assert noise.std() > 0.5 and not torch.isin(noise, drawn).any()


def test_an_episode_is_as_long_as_the_task_is_registered():
    """Pendulum's 200 steps; the paper's tasks have their own; a setting goes before."""
    assert time_limit(TaskConfig("pendulum", "Pendulum-v1")) == 200
    limits = {name: time_limit(chosen) for name, chosen in PAPER_TASKS.items()}
    assert limits == {"swingup": 1000, "reacher": 150, "hopper": 1000, "ant": 1000}
    assert time_limit(TaskConfig("pendulum", "Pendulum-v1", max_steps=7)) == 7
    run = experiment("ppo", TaskConfig("pendulum", "Pendulum-v1", episodes=1))
    assert run.train()[0]["length"] == 200 and run.test().lengths == [200]


def test_a_task_without_a_limit_needs_one():
    """In one line with the setting's name."""
    with pytest.raises(ValueError, match=r"without a time limit: set task\.max_steps"):
        make_env(task(max_steps=None), 0)


def test_training_ends_with_the_first_episode_that_reaches_the_frames():
    """And late tests are those of the frames' last share; as many again continue the run."""
    run = experiment("td3", task(frames=70), late_share=0.5)
    rows = run.train()
    assert [row["frames"] for row in rows] == [20, 40, 60, 80]
    assert [math.isnan(row["test_return"]) for row in rows] == [True, False, False, False]


def test_a_run_continues_for_more_frames(tmp_path):
    """Its numbers are those of one that was longer from the start."""
    experiment("td3", task(frames=40), tmp_path / "a").train()
    longer = experiment("td3", task(frames=70), tmp_path / "a").train()
    at_once = experiment("td3", task(frames=70), tmp_path / "b").train()
    assert [row["frames"] for row in longer] == [20, 40, 60, 80]
    assert [row["return"] for row in longer] == [row["return"] for row in at_once]


def test_a_checkpoint_of_before_a_setting_has_its_default(tmp_path):
    """So that what came later does not end older runs."""
    run = experiment("td3", task(episodes=1), tmp_path)
    run.train()
    state = run.state_dict()
    saved = json.loads(state["config"])
    del saved["task"]["flatten"], saved["task"]["frames"]
    run.load_state_dict({**state, "config": json.dumps(saved)})
    saved["task"]["flatten"] = True
    with pytest.raises(ValueError, match=r"task\.flatten=True, not False"):
        run.load_state_dict({**state, "config": json.dumps(saved)})


def test_whole_floats_are_integers_on_a_command_line():
    """1e6, which YAML and Hydra read as a float; a broken one is refused."""
    config = ExperimentConfig.from_dict({"task": {"name": "swingup", "frames": 1e6}})
    assert config.task.frames == 1_000_000 and isinstance(config.task.frames, int)
    layers = ExperimentConfig.from_dict({"algorithm": {"name": "sac", "hidden": [1e2, 64]}})
    assert layers.algorithm.hidden == (100, 64)
    with pytest.raises(ValueError, match=r"task\.frames must be a valid integer, got 0\.5"):
        ExperimentConfig.from_dict({"task": {"name": "swingup", "frames": 0.5}})
