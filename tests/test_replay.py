"""Updates from the replay buffer: the same as sampling, updating and setting priorities by hand."""

import copy
import json
import logging
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
import torch._inductor.compile_fx
from tensordict import TensorDict

from torchrl_l2c2 import NeighborTransform
from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.agents._torchrl_internals import load_replay_state, replay_state
from torchrl_l2c2.experiment.learn.compilation import compiler_available
from torchrl_l2c2.experiment.learn.replay import make_buffer
from torchrl_l2c2.experiment.learn.update import ReplayUpdate, make_update
from torchrl_l2c2.experiment.settings.fields import SettingError

logging.getLogger("torchrl").setLevel(logging.ERROR)

TASK = TaskConfig("pendulum", "Pendulum-v1", episodes=1, max_steps=60)
PAPER = ExperimentConfig(
    task=TASK,
    algorithm=PPORPEConfig(hidden=(8,), num_heads=2, replay_ratio=5.0),
    replay=PrioritizedReplayConfig(capacity=50, batch_size=8),
    compile=False,
)
CASES = {
    "prioritized": PAPER,
    "without neighbors": replace(PAPER, regularizer=NoRegularizerConfig()),
    "several neighbors": replace(PAPER, regularizer=L2C2Config(num_samples=3)),
    "largest of several": replace(
        PAPER, regularizer=L2C2Config(num_samples=3, over_neighbors="max", fraction=0.5)
    ),
    "uniform": replace(PAPER, replay=UniformReplayConfig(capacity=50, batch_size=8)),
    "rollout": replace(
        PAPER,
        algorithm=PPOConfig(hidden=(8,), frames=1000),
        replay=RolloutReplayConfig(batch_size=21),
    ),
    "sac": replace(
        PAPER,
        algorithm=SACConfig(hidden=(8,), random_frames=0),
        replay=PrioritizedReplayConfig(capacity=50, batch_size=8),
    ),
}


@cache
def state_of(config: ExperimentConfig) -> dict[str, object]:
    """Of a run that was trained, once for all tests that go on from there."""
    experiment = Experiment(config)
    experiment.train()
    return experiment.state_dict()


def trained(config: ExperimentConfig) -> Experiment:
    """A run of its own in that state."""
    experiment = Experiment(config)
    experiment.load_state_dict(copy.deepcopy(state_of(config)))
    return experiment


def by_hand(experiment: Experiment) -> None:
    """An update with what the buffer gives."""
    batch = experiment.learner.replay.sample()
    _, priority = make_update(experiment.agent, compile=False)(True, batch)
    assert all(parameter.grad is None for parameter in experiment.agent.loss.parameters())
    if priority is not None:
        experiment.learner.replay.update_tensordict_priority(batch.set("td_error", priority))


def learned(experiment: Experiment) -> dict[str, torch.Tensor]:
    """Parameters and priorities."""
    found = {k: v.clone() for k, v in experiment.agent.loss.state_dict().items()}
    sampler = replay_state(experiment.learner.replay)["_sampler"]
    return {**found, **({"priorities": sampler["_sum_tree"]} if "_sum_tree" in sampler else {})}


def same(found, expected, **tolerance):
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        torch.testing.assert_close(
            found[key], value, msg=lambda m, key=key: f"{key}: {m}", **tolerance
        )


def test_priorities_are_on_the_cpu_wherever_the_batches_are():
    """TorchRL would put its trees where the storage is."""
    sampler = make_buffer(PrioritizedReplayConfig(capacity=50, batch_size=8), 0, 1).sampler
    assert sampler._tree_device_from_storage(SimpleNamespace(device="cuda:0")).type == "cpu"


def test_errors_of_0_are_drawn_with_every_exponent():
    """(1e-8) ** 4 is 1e-32; to the sixth power it would be 0 in single precision."""
    replay = make_buffer(PrioritizedReplayConfig(capacity=8, batch_size=8, alpha=4.0), 0, 1)
    replay.extend(TensorDict({"row": torch.arange(4)}, [4]))
    replay.update_priority(torch.arange(4), torch.zeros(4))
    assert set(replay.sample()["row"].tolist()) == {0, 1, 2, 3}
    with pytest.raises(SettingError, match=r"alpha must be less than or equal to 4, got 6\.0"):
        PrioritizedReplayConfig(alpha=6.0)


@pytest.mark.parametrize("name", CASES)
def test_an_update_is_what_sampling_updating_and_prioritizing_by_hand_gives(name):
    """To the bit: rows, weights, neighbors, and the priorities that decide the next rows."""
    results = []
    for step in (lambda experiment: experiment.learner.update(True), by_hand):
        experiment = trained(CASES[name])
        before = learned(experiment)
        torch.manual_seed(0)  # SAC draws actions.
        for _ in range(5):
            step(experiment)
        results.append(learned(experiment))
        assert any(not torch.equal(v, before[k]) for k, v in results[-1].items())
    same(*results, rtol=0, atol=0)


@pytest.mark.parametrize("name", ["prioritized", "sac"])
def test_a_batch_of_one_transition_has_a_weight_and_gets_a_priority(name):
    """Of the same shapes as larger batches."""
    replay = PrioritizedReplayConfig(capacity=50, batch_size=1)
    experiment = trained(replace(CASES[name], replay=replay))
    draw = experiment.learner.update.draw()
    assert draw.weight.shape == draw.rows.shape == (1,)
    before = learned(experiment)["priorities"]
    assert experiment.learner.update(True).isfinite().all()
    assert (learned(experiment)["priorities"] != before).sum() == 1


def test_the_stored_entries_are_sorted_by_name():
    """Their order in the storage differs between processes, and the compiler's cache missed."""
    update = trained(PAPER).learner.update
    draw = update.draw()
    names = list(map(str, update._names))
    assert names == sorted(names) and len(names) == len(draw.stored) > 3


def test_the_batch_has_the_entries_and_neighbors_that_the_buffer_gives():
    """Whatever the buffer's transform writes, at its own random numbers."""
    experiment = trained(PAPER)
    update, state = experiment.learner.update, experiment.state_dict()
    expected = experiment.learner.replay.sample()
    experiment.load_state_dict(state)
    draw = experiment.learner.update.draw()
    assert experiment.learner.update is not update
    batch = experiment.learner.update.read(*draw)
    assert set(batch.keys(True, True)) == set(expected.keys(True, True))
    assert all(torch.equal(batch[key], expected[key]) for key in expected.keys(True, True))
    (transform,) = experiment.learner.replay.transform.transforms
    assert isinstance(transform, NeighborTransform)


@pytest.mark.parametrize("name", ["prioritized", "sac"])
def test_where_a_transition_lies_says_nothing_of_its_neighbor(name):
    """Neither of one number for a neighbor, as many as the sampler draws."""
    regularizer = L2C2Config(neighbors="line")
    replay = PrioritizedReplayConfig(capacity=50, batch_size=8)
    chosen = replace(CASES[name], regularizer=regularizer, replay=replay)
    experiment = Experiment(chosen)
    experiment.train()
    draws = [experiment.learner.update.draw() for _ in range(40)]
    rows = torch.cat([draw.rows for draw in draws]).double()
    uniform = torch.cat([draw.uniform.flatten() for draw in draws]).double()
    assert uniform.std() > 0.25  # of a uniform number: .29, or .58 from -1 to 1
    assert torch.corrcoef(torch.stack([rows, uniform]))[0, 1].abs() < 0.2


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
# The others with Adam take as long.
@pytest.mark.parametrize(
    "name",
    [
        "prioritized",
        # Of its graph inductor made no program.
        pytest.param("largest of several", marks=pytest.mark.slow),
        pytest.param("sac", marks=pytest.mark.slow),
    ],
)
def test_compiled_it_learns_the_same_and_follows_what_may_change(name):
    """Gain, learning rate, a policy left out, and an older state, loaded over its tensors."""
    seen = []
    state = copy.deepcopy(state_of(CASES[name]))
    for compile in (True, False):
        experiment, values = Experiment(replace(CASES[name], compile=compile)), []
        # With a learning rate that is a number, as it was in earlier checkpoints.
        state["config"] = json.dumps(experiment.config.to_dict())
        begin(experiment, state)
        values.append(experiment.learner.update(True))
        experiment.agent.loss.l2c2_coeff = 100.0
        values.append(experiment.learner.update(True))
        scale_rates(experiment.agent.optimizer, 10.0)
        # Without the policy it is another graph, which takes its time.
        turns = (False, True) if name == "sac" else (True,)
        values += [experiment.learner.update(with_policy) for with_policy in turns]
        # Loading replaces the optimizer's tensors: a step that kept the old ones would go wrong.
        begin(experiment, state)
        experiment.agent.loss.l2c2_coeff = 1.0
        values += [experiment.learner.update(True) for _ in range(3)]
        seen.append((torch.stack(values), learned(experiment)))
    (compiled, ours), (eager, plain) = seen
    torch.testing.assert_close(compiled, eager, rtol=1e-3, atol=1e-4)
    same(ours, plain, rtol=1e-3, atol=1e-4)
    actor = experiment.agent.loss.out_keys.index("loss_l2c2_actor")
    assert compiled[1, actor] > 30.0 * compiled[0, actor]


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.slow  # two graphs each
@pytest.mark.parametrize("name", ["td3", "sac"])
def test_a_loss_that_was_compiled_still_has_its_contents(name):
    """With and without the policy, two graphs, and then as it is: TorchRL's losses keep tensors."""
    algorithm = {"td3": TD3Config, "sac": SACConfig}[name](hidden=(8,), random_frames=0)
    case = replace(CASES["sac"], algorithm=algorithm, regularizer=NoRegularizerConfig())
    played = Experiment(case)
    played.train()
    state, seen = played.state_dict(), []
    for compile in (True, False):
        experiment = Experiment(replace(case, compile=compile))
        state["config"] = json.dumps(experiment.config.to_dict())
        begin(experiment, state)
        for with_policy in (False, True):
            experiment.learner.update(with_policy)
        loss = experiment.agent.loss
        seen.append(torch.stack([loss(experiment.learner.example())[k] for k in loss.out_keys[:2]]))
    torch.testing.assert_close(*seen, rtol=1e-3, atol=1e-4)
    assert all(type(value) is torch.Tensor for value in seen)


def test_advantages_are_those_of_the_whole_episode():
    """By hand, from the last frame to the first; the shuffled rows of a minibatch keep them."""
    experiment = trained(CASES["rollout"])
    algorithm, episode = experiment.config.algorithm, experiment.learner.replay[:]
    critic = experiment.agent.advantage.value_network
    with torch.no_grad():
        value = critic(episode.select("observation"))["state_value"]
        following = critic(episode["next"].select("observation"))["state_value"]
    expected, later = torch.empty(60, 1), torch.zeros(1)
    for frame in reversed(range(60)):
        target = episode["next", "reward"][frame] + algorithm.gamma * following[frame]
        later = target - value[frame] + algorithm.gamma * algorithm.gae_lambda * later
        expected[frame] = later
    torch.testing.assert_close(episode["advantage"], expected)
    torch.testing.assert_close(episode["value_target"], expected + value)
    draw = experiment.learner.update.draw()
    batch = experiment.learner.update.read(*draw)
    assert torch.equal(batch["advantage"], episode["advantage"][draw.rows])


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.parametrize("graph", ["as it is", pytest.param("compiled", marks=pytest.mark.slow)])
def test_a_rollout_s_smaller_last_batch_is_learned_from_without_a_graph(monkeypatch, graph):
    """Compiled, two passes with batches of 21, 21 and 18 do as they do uncompiled."""
    if graph == "as it is":
        monkeypatch.setattr(torch._inductor.compile_fx, "compile_fx", lambda module, _: module)
    read, runs = ReplayUpdate.read, []
    monkeypatch.setattr(ReplayUpdate, "read", lambda *args: runs.append(args) or read(*args))
    played = trained(CASES["rollout"])
    seen = []
    for compile in (True, False):
        experiment = Experiment(replace(CASES["rollout"], compile=compile))
        experiment.agent.loss.load_state_dict(played.agent.loss.state_dict())
        load_replay_state(experiment.learner.replay, replay_state(played.learner.replay))
        runs.clear()
        experiment.learner.learn_rollout(2)
        assert experiment.learner.updates == 6
        # A graph's Python runs once, a smaller batch's every time; one more is kept as an example.
        assert len(runs) == (1 + 2 if compile else 6) + 1
        seen.append(learned(experiment))
    same(*seen, rtol=1e-3, atol=1e-4)


def test_a_rollout_that_is_shorter_than_a_batch_is_learned_from_whole():
    """One batch of it in each pass; the example that is kept has each of its rows once."""
    case = replace(
        CASES["rollout"],
        algorithm=PPOConfig(hidden=(8,), frames=60, epochs=2),
        regularizer=L2C2Config(policy_distance="mean"),
        replay=RolloutReplayConfig(batch_size=4096),
    )
    experiment = Experiment(case)
    experiment.train()
    example = experiment.learner.example()
    assert experiment.learner.updates == 2 and len(example) == 60
    assert len(example["observation"].unique(dim=0)) == 60


@pytest.mark.parametrize(("num_envs", "rows"), [(2, 40), (None, 40 + 60)])
def test_a_buffer_of_rollouts_has_room_for_the_longest(num_envs, rows):
    """Exactly the frames from several simulators; of whole episodes, the last may go beyond."""
    algorithm = PPOConfig(hidden=(8,), frames=40, num_envs=num_envs)
    experiment = Experiment(replace(CASES["rollout"], algorithm=algorithm))
    assert experiment.learner.replay.storage.max_size == rows


def begin(experiment, state):
    """At a state, with the random numbers that SAC's actions are drawn with."""
    experiment.load_state_dict(copy.deepcopy(state))
    torch.manual_seed(0)


def scale_rates(optimizer, factor):
    """As torch's schedulers do, into a learning rate that is a tensor."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):
            group["lr"].mul_(factor)
        else:
            group["lr"] *= factor


def test_priorities_need_a_torch_with_which_torchrls_trees_load(monkeypatch):
    """The error names the versions and the setting that works without them."""
    monkeypatch.setattr("torchrl_l2c2.experiment.learn.replay.SumSegmentTreeFp32", None)
    needed = r"'prioritized' needs .* torch 2\.14 or newer, got torch \S+\. Set replay=uniform"
    with pytest.raises(SettingError, match=needed):
        make_buffer(PAPER.replay, 0, 0)
    assert len(make_buffer(UniformReplayConfig(), 0, 0)) == 0
