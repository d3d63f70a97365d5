from __future__ import annotations

import copy
import functools
import math
import pickle
from importlib.util import find_spec

import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import (
    Bounded,
    Composite,
    LazyTensorStorage,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.data.replay_buffers.samplers import SumSegmentTreeFp32
from torchrl.envs import (
    Compose,
    GymEnv,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    check_env_specs,
)
from torchrl.modules import Actor, ValueOperator
from torchrl.objectives import DDPGLoss

from torchrl_l2c2 import L2C2Loss, Neighborhood, NeighborTransform, ObservationNoise
from torchrl_l2c2.transforms import draw_neighbors

NEAR = Neighborhood(sigma=2.0, lambda_min=0.1, lambda_max=1.0)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def transitions(*batch: int, **entries: tuple[int, ...]) -> TensorDict:
    """Transitions whose every coordinate moves by exactly 1."""
    entries = entries or {"observation": (3,)}
    source = generator(9)
    states = {key: torch.randn(*batch, *shape, generator=source) for key, shape in entries.items()}
    successors = {key: state + 1.0 for key, state in states.items()}
    return TensorDict({**states, "next": successors}, batch)


# NeighborTransform


@pytest.mark.parametrize("order", [("wide", "thin"), ("thin", "wide")])
def test_one_number_for_all_entries_leaves_each_its_dtype(order):
    """Whichever is the first, from which it is drawn; the part of the way is the same."""
    data = transitions(6, wide=(3,), thin=(2,))
    for key in ("wide", ("next", "wide")):
        data[key] = data[key].double()
    near = Neighborhood(neighbors="line")
    NeighborTransform(near, in_keys=list(order), generator=generator())(data)
    found = {key: data["neighbor", key] for key in order}
    assert {key: each.dtype for key, each in found.items()} == {
        "wide": torch.float64,
        "thin": torch.float32,
    }
    parts = {key: found[key][:, 0] - data[key] for key in order}  # every step is 1
    torch.testing.assert_close(parts["wide"][:, :2].float(), parts["thin"], atol=1e-6, rtol=0)


@pytest.mark.parametrize("batch", [(), (6,), (6, 4)])
def test_neighbors_are_those_of_the_neighborhood(batch):
    """The entry holds what the neighborhood samples, in the batch size of the batch."""
    data = transitions(*batch)
    size, before = data.batch_size, data.clone()
    assert NeighborTransform(NEAR, num_samples=2, generator=generator())(data) is data
    state, successor = before["observation"], before["next", "observation"]
    neighbor, distance = NEAR.sample(state, successor, 2, generator(), batch_dims=len(batch))
    assert data.batch_size == data["neighbor"].batch_size == size
    assert data["neighbor", "observation"].shape == (*batch, 2, 3)
    torch.testing.assert_close(data["neighbor", "observation"], neighbor, rtol=0, atol=0)
    torch.testing.assert_close(data["neighbor", "distance"], distance, rtol=0, atol=0)
    assert (data.exclude("neighbor") == before).all()


def test_several_keys_are_one_state():
    """Parts of a state move independently; their joint distance is the largest part's."""
    data = TensorDict(
        {
            "agent": {"position": torch.zeros(50, 2)},
            "image": torch.zeros(50, 1, 2, 2),
            "next": {
                "agent": {"position": torch.ones(50, 2)},
                "image": torch.ones(50, 1, 2, 2),
            },
        },
        [50],
    )
    transform = NeighborTransform(NEAR, [("agent", "position"), "image"], "near", num_samples=3)
    near = transform(data)["near"]
    parts = near["agent", "position"].abs().amax(-1), near["image"].abs().flatten(2).amax(-1)
    assert near["agent", "position"].shape == (50, 3, 2)
    assert near["image"].shape == (50, 3, 1, 2, 2)
    torch.testing.assert_close(near["distance"], torch.maximum(*parts) + NEAR.epsilon)
    assert stats.spearmanr(*(part.flatten() for part in parts)).pvalue > 1e-3


def test_a_step_that_is_too_long_leaves_the_whole_state_where_it_is():
    """Of several keys, whichever jumped; the diagnostics would have the others' moves."""
    near = Neighborhood(max_step=1.0)
    far, short = torch.tensor([[10.0], [0.5]]), torch.tensor([[[0.5]], [[0.5]]])
    batch = TensorDict({"a": torch.zeros(2, 1), "b": torch.zeros(2, 1, 1)}, [2])
    batch["next"] = TensorDict({"a": far, "b": short}, [2])
    found = NeighborTransform(near, in_keys=["a", "b"], num_samples=3)(batch)["neighbor"]
    assert found["distance"].isinf().all(-1).tolist() == [True, False]
    assert found["b"].shape == (2, 3, 1, 1)
    assert not found["a"][0].any() and not found["b"][0].any() and found["b"][1].any()


def test_neighbors_of_episode_ends_are_finite():
    """A successor of NaN, as at some episode ends, has the state itself as neighbor, far away."""
    data = transitions(4)
    data["next", "observation"][1] = math.nan
    neighbors = NeighborTransform(NEAR)(data)["neighbor"]
    torch.testing.assert_close(neighbors["observation"][1, 0], data["observation"][1])
    assert neighbors["distance"].isfinite().flatten().tolist() == [True, False, True, True]
    assert not (neighbors["observation"][0, 0] == data["observation"][0]).any()


def replay(kind, transform, **options):
    arguments = {"alpha": 1.0, "beta": 0.5} if "Prioritized" in kind.__name__ else {}
    if arguments and SumSegmentTreeFp32 is None:
        pytest.skip("torchrl does not load its compiled trees with this version of torch")
    buffer = kind(
        storage=LazyTensorStorage(64), batch_size=8, generator=generator(3), **arguments, **options
    )
    return buffer.append_transform(transform)


@pytest.mark.parametrize("kind", [TensorDictReplayBuffer, TensorDictPrioritizedReplayBuffer])
@pytest.mark.parametrize("prefetch", [None, 2])
def test_in_replay_buffers(kind, prefetch):
    """Each sampled batch has neighbors of its own states, which are not stored."""
    buffer = replay(kind, NeighborTransform(NEAR, num_samples=2), prefetch=prefetch)
    buffer.extend(transitions(50))
    for _ in range(3):
        batch = buffer.sample()
        assert batch.batch_size == (8,)
        shift = batch["neighbor", "observation"] - batch["observation"][:, None]
        distance = shift.abs().amax(-1) + NEAR.epsilon
        torch.testing.assert_close(batch["neighbor", "distance"], distance, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(
            buffer.storage.get(batch["index"])["observation"], batch["observation"]
        )
    assert "neighbor" not in buffer.storage[:]


def test_prioritized_metadata_survives():
    """Indices, priority weights and the update of priorities work as without the transform."""
    buffer = replay(TensorDictPrioritizedReplayBuffer, NeighborTransform(NEAR))
    buffer.extend(transitions(50))
    batch = buffer.sample()
    assert batch["priority_weight"].shape == batch["index"].shape == (8,)
    batch["td_error"] = torch.full((8,), 1e6)
    buffer.update_tensordict_priority(batch)
    favored = set(batch["index"].tolist())
    again = buffer.sample()
    assert set(again["index"].tolist()) <= favored
    assert again["neighbor", "observation"].shape == (8, 1, 3)


def test_slices_keep_their_time():
    """A buffer of trajectories gives neighbors of every step."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20), batch_size=4)
    buffer.append_transform(NeighborTransform(NEAR, num_samples=2))
    buffer.extend(transitions(10, 5))
    batch = buffer.sample()
    assert batch.batch_size == batch["neighbor"].batch_size == (4, 5)
    assert batch["neighbor", "observation"].shape == (4, 5, 2, 3)


@pytest.mark.parametrize("prefetch", [None, 1])
def test_reproducible_with_a_generator(prefetch):
    """With generators the neighbors repeat, whatever the global generator does meanwhile."""

    def samples(seed: int) -> torch.Tensor:
        torch.manual_seed(seed)
        transform = NeighborTransform(NEAR, generator=generator(5))
        buffer = replay(TensorDictReplayBuffer, transform, prefetch=prefetch)
        buffer.extend(transitions(50))
        return torch.stack([buffer.sample()["neighbor", "observation"] for _ in range(4)])

    first = samples(0)
    torch.testing.assert_close(first, samples(1), rtol=0, atol=0)
    assert not (first[0] == first[1]).any()


def test_what_cannot_move_is_named():
    """A loss that reads a mask makes a transform that would move it."""
    mask = torch.ones(4, 2, dtype=torch.bool)
    near = {"observation": torch.zeros(4, 3), "mask": mask}
    batch = TensorDict({**near, "next": dict(near)}, [4])
    transform = NeighborTransform(NEAR, in_keys=["observation", "mask"])
    with pytest.raises(TypeError, match=r"'mask' is torch.bool: name .* in in_keys \(or moved_key"):
        transform(batch)


@pytest.mark.parametrize("form", ["state_dict", "files"])
def test_generator_is_saved_with_the_buffer(form, tmp_path):
    """A restored buffer goes on with the neighbors that would have come next."""
    first, second = (
        replay(TensorDictReplayBuffer, NeighborTransform(NEAR, generator=generator(seed)))
        for seed in (1, 2)
    )
    for buffer in (first, second):
        buffer.extend(transitions(50))
    first.sample()
    if form == "files":
        first.dumps(tmp_path / "replay")
        second.loads(tmp_path / "replay")
    else:
        second.load_state_dict(copy.deepcopy(first.state_dict()))
    for _ in range(2):
        expected, restored = first.sample(), second.sample()
        assert (expected["neighbor"] == restored["neighbor"]).all()


@pytest.mark.parametrize(
    ("saved", "present", "words"), [(None, 0, ("without", "with")), (0, None, ("with", "without"))]
)
def test_generator_must_match_what_was_saved(saved, present, words):
    """A state saved with a generator is not restored without one, nor the other way around."""
    build = [
        NeighborTransform(NEAR, generator=None if seed is None else generator(seed))
        for seed in (saved, present)
    ]
    with pytest.raises(ValueError, match=f"saved {words[0]} a generator and built {words[1]} one"):
        build[1].load_state_dict(build[0].state_dict())


def test_a_generator_of_another_kind_of_device_is_told():
    """Its state has another size."""
    transform = NeighborTransform(NEAR, generator=generator())
    with pytest.raises(ValueError, match="a generator of another kind of device than cpu: build"):
        transform.set_extra_state(torch.zeros(16, dtype=torch.uint8))


def test_deep_copies_have_their_own_generator():
    """A deep copy draws the same neighbors and leaves the original's generator alone."""
    transform = NeighborTransform(NEAR, generator=generator())
    twin = copy.deepcopy(transform)
    draws = [t(transitions(6))["neighbor", "observation"] for t in (twin, twin, transform)]
    torch.testing.assert_close(draws[0], draws[2], rtol=0, atol=0)
    assert not (draws[0] == draws[1]).any()


@pytest.mark.parametrize(
    "attach",
    [
        TransformedEnv,
        lambda env, transform: TransformedEnv(env, Compose(StepCounter(), transform)),
        lambda env, transform: TransformedEnv(env).append_transform(transform),
    ],
)
def test_neighbors_are_refused_to_environments(attach):
    """In an environment there is no successor yet, and the error says where it belongs."""
    transform = NeighborTransform(NEAR)
    with pytest.raises(ValueError, match="belongs to a replay buffer"):
        attach(GymEnv("Pendulum-v1"), transform)
    replay(TensorDictReplayBuffer, transform)  # There it still can be put.


@pytest.mark.parametrize(
    ("missing", "name"), [("observation", "'observation'"), ("next", r"\('next', 'observation'\)")]
)
def test_missing_entries_are_named(missing, name):
    """A batch without the state or its successor is refused, naming what it lacks and has."""
    data = transitions(4).exclude(missing)
    with pytest.raises(KeyError, match=f"needs {name}.*it has.*observation"):
        NeighborTransform(NEAR)(data)


def test_one_name_is_a_state_of_one_part():
    """And not a list of its letters."""
    batch = transitions(4)
    one, listed = (
        draw_neighbors(batch, NEAR, keys, generator=generator())
        for keys in ("observation", ["observation"])
    )
    assert one["observation"].equal(listed["observation"])


def test_integer_states_have_no_neighbors():
    """Integer observations are refused."""
    data = transitions(4).apply(lambda x: x.long())
    with pytest.raises(TypeError, match=r"torch\.int64: .* after .* such as ToTensorImage"):
        NeighborTransform(NEAR)(data)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"neighborhood": 1.0}, TypeError, r"must be a Neighborhood, got 1\.0"),
        ({"num_samples": 0}, ValueError, "at least 1, got 0"),
        ({"generator": 3}, TypeError, r"torch\.Generator or None, got 3"),
        ({"in_keys": []}, ValueError, "at least one entry"),
        ({"in_keys": ["distance"]}, ValueError, "none called 'distance'"),
        ({"in_keys": [("distance", "x")]}, ValueError, "none called 'distance'"),
        ({"out_key": 3}, TypeError, "out_key must be a string or a tuple of strings, got 3"),
        *(
            ({"out_key": key}, ValueError, "out_key must be an entry of its own, got .*observa")
            for key in ("observation", ("next", "observation"), ("observation", "near"))
        ),
        ({"out_key": "next"}, ValueError, "an entry of its own, got 'next'"),
    ],
)
def test_wrong_settings_of_neighbors(arguments, error, message):
    """Wrong settings are refused at construction."""
    with pytest.raises(error, match=message):
        NeighborTransform(**{"neighborhood": NEAR, **arguments})


@pytest.mark.parametrize("key", [("next", "neighbor"), ("observation_near", "by")])
def test_other_places_are_free(key):
    """Beside what is read."""
    data = NeighborTransform(NEAR, out_key=key)(transitions(4))
    assert data[key].batch_size == data.batch_size


def test_a_loss_that_draws_by_itself_refuses_a_reserved_name_too():
    """Its neighbors would be written over by the distances."""
    actor = Actor(torch.nn.Linear(3, 1), in_keys=["distance"])
    value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["distance", "action"])
    loss = L2C2Loss(DDPGLoss(actor, value), NEAR)
    entry = torch.zeros(4, 3)
    batch = TensorDict({"distance": entry, "next": {"distance": entry}}, [4])
    with pytest.raises(ValueError, match=r"none called 'distance'.*\(or moved_keys\)"):
        loss.policy_regularizer(batch)


def test_reprs_show_the_settings():
    """What is printed of a pipeline shows what the transforms do."""
    assert repr(NeighborTransform(NEAR, num_samples=4)) == (
        "NeighborTransform(Neighborhood(sigma=2.0, lambda_min=0.1, lambda_max=1.0, "
        "neighbors='box', max_step=None), keys=['observation'], out_key='neighbor', num_samples=4)"
    )
    assert repr(ObservationNoise(0.5)) == "ObservationNoise(scale=0.5, keys=['observation'])"


# ObservationNoise

SWINGUP = pytest.param(
    "pybullet_envs_gymnasium:InvertedPendulumSwingupBulletEnv-v0",
    marks=pytest.mark.skipif(
        find_spec("pybullet_envs_gymnasium") is None, reason="needs the extra experiment"
    ),
)


def noisy(name="Pendulum-v1", scale=0.1, seed=0, steps=None):
    transforms = [StepCounter(max_steps=steps)] if steps else []
    noise = ObservationNoise(scale, generator=generator(seed))
    return TransformedEnv(GymEnv(name), Compose(*transforms, noise))


def still(env):
    """A policy whose actions are all 0."""
    return TensorDictModule(lambda _: env.action_spec.zero(), ["observation"], ["action"])


def test_noise_is_white_gaussian_of_the_scale():
    """What is added to the simulator's observations is white noise of the given deviation."""
    env, clean = noisy(scale=0.1), GymEnv("Pendulum-v1")
    observations = []
    for each in (env, clean):
        each.set_seed(0)
        rollout = each.rollout(200, still(each))
        observations.append(torch.cat([rollout["observation"][:1], rollout["next", "observation"]]))
    noise = (observations[0] - observations[1]).double() / 0.1
    assert (noise[0] != 0).all()  # the observation of the reset is noisy too
    assert stats.kstest(noise.flatten(), stats.norm.cdf).pvalue > 1e-3
    assert stats.pearsonr(noise[:-1].flatten(), noise[1:].flatten()).pvalue > 1e-3


@pytest.mark.parametrize("name", ["Pendulum-v1", SWINGUP])
def test_successors_and_next_states_share_their_noise(name):
    """In rollouts and collected batches an observation is drawn once, across resets too."""
    env = noisy(name, steps=7)
    collector = Collector(
        env,
        still(env),
        frames_per_batch=20,
        total_frames=40,
        auto_register_policy_transforms=False,
    )
    batches = [env.rollout(20, break_when_any_done=False), *(batch.clone() for batch in collector)]
    collector.shutdown()
    for batch in batches:
        going_on = ~batch["next", "done"][:-1, 0]
        followers, successors = batch["observation"][1:], batch["next", "observation"][:-1]
        assert going_on.sum() >= 16
        torch.testing.assert_close(followers[going_on], successors[going_on], rtol=0, atol=0)
        assert (followers[~going_on] != successors[~going_on]).any(-1).all()
    earlier, later = batches[1:]
    assert not earlier["next", "done"][-1]
    assert (later["observation"][0] == earlier["next", "observation"][-1]).all()


def test_scale_per_coordinate():
    """A tensor of scales leaves coordinates of scale 0 exact."""
    env = noisy(scale=torch.tensor([0.0, 0.5, 0.0]))
    rollout = env.rollout(10)["next", "observation"]
    clean = GymEnv("Pendulum-v1").observation_spec["observation"].space
    assert (rollout[:, 0].abs() <= clean.high[0]).all()
    radius = rollout[:, 0].square() + rollout[:, 1].square()  # cos^2 + sin^2
    assert (radius - 1).abs().median() > 1e-2  # One of them may be there by chance.
    silent = noisy(scale=0.0).rollout(10)["next", "observation"]
    torch.testing.assert_close(silent[:, :2].square().sum(-1), torch.ones(10))


def check_partial_reset(env):
    data = env.rand_step(env.reset())["next"].exclude("reward")
    before = data["observation"].clone()
    data["_reset"] = torch.tensor([[True], [False]])
    data = env.reset(data)
    torch.testing.assert_close(data["observation"][1], before[1], rtol=0, atol=0)
    assert (data["observation"][0] != before[0]).all()
    first = data["observation"].clone()
    rollout = env.rollout(3, tensordict=data, auto_reset=False)
    observation, successor = rollout["observation"], rollout["next", "observation"]
    assert (observation[:, 0] == first).all()
    assert (observation[:, 1:] == successor[:, :-1]).all()


def test_partial_resets_keep_the_others():
    """Environments of a batch that are not reset keep their noisy observation."""
    check_partial_reset(SerialEnv(2, noisy))
    batched = SerialEnv(2, functools.partial(GymEnv, "Pendulum-v1"))
    check_partial_reset(TransformedEnv(batched, ObservationNoise(0.1, generator=generator())))


def make_very_noisy():
    return TransformedEnv(GymEnv("Pendulum-v1"), ObservationNoise(100.0))


def test_worker_processes():
    """In workers the noise follows set_seed, differs between them and survives partial resets."""
    # Forked, not spawned: ten seconds less, and the environments need no fresh interpreter.
    env = ParallelEnv(2, make_very_noisy, mp_start_method="fork")
    try:
        draws = []
        for _ in range(2):
            env.set_seed(3)
            draws.append(env.reset()["observation"].clone())
        torch.testing.assert_close(draws[0], draws[1], rtol=0, atol=0)
        # The states differ by 2 at most, the velocities by 16.
        assert (draws[0][0] - draws[0][1]).abs().max() > 20
        check_partial_reset(env)
    finally:
        env.close()


def test_generator_decides_the_noise():
    """The same generator gives the same noise; restoring the environment's state resumes it."""
    draws = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        env = noisy(seed=5)
        env.set_seed(0)
        draws.append(env.rollout(5, still(env))["observation"])
    torch.testing.assert_close(*draws, rtol=0, atol=0)
    resumed = noisy(seed=6)
    resumed.load_state_dict(copy.deepcopy(env.state_dict()))
    for each in (env, resumed):
        each.set_seed(1)
    torch.testing.assert_close(*(e.reset()["observation"] for e in (env, resumed)), rtol=0, atol=0)


def test_scale_is_a_setting_and_no_state():
    """Loading a checkpoint restores no scale over the one that was configured."""
    quiet, loud = ObservationNoise(0.1), ObservationNoise(0.2)
    loud.load_state_dict(quiet.state_dict())
    assert loud.scale.item() == pytest.approx(0.2)


def test_spec_is_unbounded_and_right():
    """The noise leaves the bounds of the observation, and the spec says so."""
    env = noisy(scale=10.0)
    assert isinstance(env.base_env.observation_spec["observation"], Bounded)
    spec = env.observation_spec["observation"]
    assert spec == Unbounded(3)
    rollout = env.rollout(20)
    assert not env.base_env.observation_spec["observation"].is_in(rollout["observation"])
    check_env_specs(env)


def test_dtype_is_kept():
    """Observations of any precision keep it."""
    for dtype in (torch.float64, torch.float16):
        data = TensorDict({"observation": torch.zeros(4, dtype=dtype)})
        for scale in (0.1, torch.full((4,), 0.1)):
            observation = ObservationNoise(scale)(data)["observation"]
            assert observation.dtype == dtype
            assert (observation != 0).all()


def test_only_named_observations_are_noisy():
    """Other floating-point observations, such as the sum of rewards, stay exact."""
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(RewardSum(), ObservationNoise(100.0)))
    rollout = env.rollout(5)
    total = rollout["next", "reward"].cumsum(0)
    torch.testing.assert_close(rollout["next", "episode_reward"], total)
    assert rollout["next", "observation"].abs().max() > 10


def test_nested_observations():
    """An entry of a nested observation is perturbed in its place."""
    noise = ObservationNoise(1.0, in_keys=[("agents", "position")])
    data = TensorDict({"agents": {"position": torch.zeros(4, 2), "id": torch.zeros(4)}}, [4])
    noisy_data = noise._call(data)
    assert (noisy_data["agents", "position"] != 0).all()
    assert (noisy_data["agents", "id"] == 0).all()
    spec = Composite(agents=Composite(position=Bounded(-1, 1, (2,)), id=Bounded(-1, 1, (1,))))
    spec = noise.transform_observation_spec(spec)
    assert spec["agents", "position"] == Unbounded(2)
    assert spec["agents", "id"] == Bounded(-1, 1, (1,))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"scale": -0.1}, ValueError, "finite and at least 0"),
        ({"scale": math.nan}, ValueError, "got nan"),
        ({"scale": torch.tensor([0.1, math.inf])}, ValueError, "got .*inf"),
        ({"scale": 0.1, "generator": 0}, TypeError, r"torch\.Generator or None, got 0"),
    ],
)
def test_wrong_settings_of_noise(arguments, error, message):
    """Wrong settings are refused at construction."""
    with pytest.raises(error, match=message):
        ObservationNoise(**arguments)


@pytest.mark.parametrize(
    ("transforms", "error", "message"),
    [
        (
            [ObservationNoise(0.1, ["pixels"])],
            KeyError,
            "no observation 'pixels'.* has observation",
        ),
        (
            [StepCounter(), ObservationNoise(0.1, ["step_count"])],
            TypeError,
            r"'step_count' has dtype torch\.int64",
        ),
        ([ObservationNoise(torch.ones(2))], ValueError, r"\(2,\) .*'observation' of shape \(3,\)"),
        ([ObservationNoise(torch.ones(1, 3))], ValueError, r"shape \(1, 3\)"),
    ],
)
def test_wrong_environments_are_refused(transforms, error, message):
    """An environment whose observation cannot be perturbed refuses the transform."""
    with pytest.raises(error, match=message):
        TransformedEnv(GymEnv("Pendulum-v1"), Compose(*transforms))
    env = TransformedEnv(GymEnv("Pendulum-v1"))
    with pytest.raises(error, match=message):
        for transform in transforms:
            env.append_transform(transform.clone())
    other = Compose(StepCounter(), refused := transforms[-1].clone())
    with pytest.raises(error, match=message):
        TransformedEnv(GymEnv("Pendulum-v1"), other)
    assert refused.parent is None


def test_drawing_and_placing_is_what_forward_does():
    """For several keys, from the transform's own generator."""
    batch = TensorDict(
        {"a": torch.randn(4, 3), "b": torch.randn(4, 2, 2), "next": {}}, batch_size=[4]
    )
    batch["next", "a"], batch["next", "b"] = torch.randn(4, 3), torch.randn(4, 2, 2)
    make = functools.partial(NeighborTransform, NEAR, ["a", "b"], num_samples=2)
    expected = make(generator=generator(0))(batch.clone())["neighbor"]
    transform = make(generator=generator(0))
    uniform = transform.draw(batch)
    assert uniform["b"].shape == (4, 2, 2, 2)
    found = transform.place(batch.clone(), uniform)["neighbor"]
    assert all(torch.equal(found[key], expected[key]) for key in ("a", "b", "distance"))


@pytest.mark.parametrize(
    "make",
    [lambda g: NeighborTransform(NEAR, generator=g), lambda g: ObservationNoise(0.1, generator=g)],
)
def test_a_state_that_was_loaded_to_an_accelerator_is_restored(make, monkeypatch):
    """Where ``map_location`` has put it; generators take it from the CPU alone."""
    saved = make(generator(3)).get_extra_state()
    loaded = torch.empty_like(saved, device="meta")
    monkeypatch.setattr(torch.Tensor, "cpu", lambda self: saved if self is loaded else self)
    transform = make(generator(4))
    transform.set_extra_state(loaded)
    assert transform.generator.get_state().equal(saved)


def test_noise_is_refused_in_a_replay_buffer():
    """Where the state would have some and its successor none."""
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(8), batch_size=4)
    buffer.append_transform(ObservationNoise(0.1))
    state = {"observation": torch.zeros(8, 3)}
    buffer.extend(TensorDict({**state, "next": state}, [8]))
    with pytest.raises(ValueError, match="belongs to an environment, not to a replay buffer"):
        buffer.sample()


def test_generators_are_sent_to_a_new_process():
    """torch sends none by itself; the other process has generators in the same state."""
    generator = torch.Generator().manual_seed(3)
    transforms = [
        NeighborTransform(NEAR, generator=generator),
        ObservationNoise(0.1, generator=copy.deepcopy(generator)),
    ]
    expected = torch.rand(3, generator=torch.Generator().manual_seed(3))
    context = torch.multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_draw, args=(transforms, queue))
    process.start()
    drawn = queue.get(timeout=100)
    process.join()
    assert drawn == [expected.tolist()] * 2
    for transform in transforms:
        for twin in (copy.deepcopy(transform), pickle.loads(pickle.dumps(transform)), transform):
            assert torch.equal(torch.rand(3, generator=twin.generator), expected)


def _draw(transforms, queue):
    queue.put([torch.rand(3, generator=each.generator).tolist() for each in transforms])
