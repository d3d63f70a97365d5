"""The private names in use: where they stand, and that each means what it did."""

import ast
import logging
import operator
from pathlib import Path

import gymnasium
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import GymEnv, GymWrapper
from torchrl.modules import (
    MLP,
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss

from torchrl_l2c2 import ObservationNoise, make_actor, make_critic
from torchrl_l2c2.experiment.agents._torchrl_internals import (
    RowWriter,
    TraceableClipPPOLoss,
    add_noise,
    clear_detached_parameters,
    first_observation,
    load_replay_state,
    replay_state,
    simulator_of,
    stored_tensors,
)
from torchrl_l2c2.experiment.learn._torch_internals import marked_as_compiling

logging.getLogger("torchrl").setLevel(logging.ERROR)
CAPACITY = 6
PARTS = ("storage", "writer", "sampler")
PACKAGE = Path(__file__).parents[1] / "torchrl_l2c2"


def uniform():
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(CAPACITY),
        batch_size=4,
        generator=torch.Generator().manual_seed(3),
    )


def prioritized():
    return TensorDictPrioritizedReplayBuffer(
        alpha=0.7,
        beta=0.5,
        priority_key="td_error",
        storage=LazyTensorStorage(CAPACITY),
        batch_size=4,
        generator=torch.Generator().manual_seed(3),
    )


def rows(first, count):
    return [
        {"observation": torch.full((3,), float(number)), ("next", "done"): torch.tensor([True])}
        for number in range(first, first + count)
    ]


def extend(buffer, row):
    batch = TensorDict(batch_size=[1])
    for key, value in row.items():
        batch.set(key, value.unsqueeze(0))
    buffer.extend(batch)


def flat(value, name=""):
    """Numbers, texts and tensors of nested values, by where they are."""
    if isinstance(value, TensorDictBase):
        value = dict(value.items())
    if isinstance(value, dict):
        return {k: v for key, each in value.items() for k, v in flat(each, f"{name}/{key}").items()}
    if isinstance(value, tuple | list):
        return flat(dict(enumerate(value)), name)
    value = getattr(value, "value", value)  # Counters that processes share.
    known = isinstance(value, bool | int | float | str | torch.Tensor | None)
    return {name: value} if known else {}


def same(ours, theirs):
    """States, what else TorchRL keeps about them, and what is drawn."""
    for one, other in (
        (replay_state(ours), replay_state(theirs)),
        # A record that a later TorchRL adds is among these.
        *((vars(getattr(ours, part)), vars(getattr(theirs, part))) for part in PARTS),
    ):
        one, other = flat(one), flat(other)
        assert one.keys() == other.keys()
        for name, value in other.items():
            is_same = torch.equal if isinstance(value, torch.Tensor) else operator.eq
            assert is_same(one[name], value), name
    assert len(ours) == len(theirs) and ours.write_count == theirs.write_count
    # Twice, as what is drawn next depends on the generator.
    for _ in range(2):
        drawn, expected = ours.sample(), theirs.sample()
        assert all(torch.equal(drawn[key], expected[key]) for key in expected.keys(True, True))


@pytest.mark.parametrize("make", [uniform, prioritized])
def test_the_buffer_is_that_of_extend(make):
    """From the first row on, while it fills, when it is full and begins anew; with priorities."""
    ours, theirs = make(), make()
    writer = RowWriter(ours)
    for number, row in enumerate(rows(0, 2 * CAPACITY + 2)):
        writer.write({**row, "not read": torch.zeros(1)} if number else row)
        extend(theirs, row)
        if number == 0:  # What was never written holds anything.
            for buffer in (ours, theirs):
                stored_tensors(buffer.storage)[1:].zero_()
        if make is prioritized and number == 3:
            for buffer in (ours, theirs):
                buffer.update_priority(torch.tensor([0, 2]), torch.tensor([5.0, 0.1]))
        same(ours, theirs)


def test_what_was_loaded_is_written_to():
    """A loaded state has tensors of its own; the writer of before goes on in them."""
    ours, theirs, saved = uniform(), uniform(), uniform()
    writer = RowWriter(ours)
    for row in rows(0, 3):
        writer.write(row)
        extend(theirs, row)
        extend(saved, row)
    state = replay_state(saved)
    load_replay_state(ours, state)
    load_replay_state(theirs, state)
    for row in rows(10, 5):
        writer.write(row)
        extend(theirs, row)
    same(ours, theirs)


def test_the_stored_tensors_are_the_storages_own():
    """What is written into them is what the buffer gives."""
    buffer = uniform()
    assert stored_tensors(buffer.storage) is None
    for row in rows(0, 3):
        extend(buffer, row)
    stored_tensors(buffer.storage)["observation"][1] = 7.0
    assert buffer[1]["observation"].tolist() == [7.0] * 3


def test_the_simulator_is_the_one_that_was_wrapped():
    """With Gymnasium's wrappers, which ``unwrapped`` leaves out."""
    env = gymnasium.make("Pendulum-v1")
    assert simulator_of(GymWrapper(env)) is env is not env.unwrapped


def test_a_collector_begins_with_its_first_observation():
    """As TorchRL's own loop does."""
    env = GymEnv("Pendulum-v1")
    collector = Collector(
        env,
        make_actor(3, env.action_spec),
        frames_per_batch=2,
        total_frames=2,
        auto_register_policy_transforms=False,
    )
    first = first_observation(collector)
    assert torch.equal(first, next(iter(collector))["observation"][0])


def test_noise_is_that_of_the_transform():
    """At the same random numbers."""
    seen = torch.arange(3.0)
    one, other = (ObservationNoise(0.5, generator=torch.Generator().manual_seed(2)) for _ in "ab")
    expected = one(TensorDict({"observation": seen}))["observation"]
    assert torch.equal(add_noise(other, seen), expected) and not torch.equal(expected, seen)


def ppo(kind):
    """A loss whose networks are those of a seed, and a batch of its."""
    torch.manual_seed(0)
    network = TensorDictModule(
        nn.Sequential(nn.Linear(3, 2), NormalParamExtractor()), ["observation"], ["loc", "scale"]
    )
    actor = ProbabilisticActor(
        network, ["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )
    loss = kind(actor, make_critic(3))
    loss.make_value_estimator(gamma=0.9)
    batch = TensorDict({"observation": torch.randn(4, 3), "action": torch.randn(4, 1)}, [4])
    batch["action_log_prob"] = torch.zeros(4)
    batch["next"] = TensorDict({"observation": torch.randn(4, 3)}, [4])
    batch["next", "reward"] = torch.randn(4, 1)
    for end in ("done", "terminated"):
        batch[end] = batch["next", end] = torch.zeros(4, 1, dtype=torch.bool)
    return loss, batch


def test_an_entropy_of_closed_form_is_taken_as_it_is(monkeypatch):
    """TorchRL's loss asks for it by this name, and comes to the same terms."""
    asked = []
    entropy = TraceableClipPPOLoss._get_entropy
    monkeypatch.setattr(
        TraceableClipPPOLoss,
        "_get_entropy",
        lambda self, *args, **named: asked.append(named) or entropy(self, *args, **named),
    )
    (ours, batch), (theirs, _) = ppo(TraceableClipPPOLoss), ppo(ClipPPOLoss)
    found, expected = ours(batch.clone()), theirs(batch.clone())
    assert len(asked) == 1
    for key in ("loss_objective", "loss_entropy", "loss_critic"):
        assert torch.equal(found[key], expected[key])


def test_a_loss_forgets_what_it_detached():
    """TorchRL keeps detached parameters until it is told otherwise."""
    network = MLP(in_features=3, out_features=1, num_cells=[4])
    loss = ClipPPOLoss(make_actor(3, 1), ValueOperator(network, ["observation"]))
    before = loss._cached_critic_network_params_detached
    assert loss._cached_critic_network_params_detached is before
    clear_detached_parameters(loss)
    assert loss._cached_critic_network_params_detached is not before


def test_losses_see_that_they_are_traced():
    """And only meanwhile."""
    with marked_as_compiling():
        assert torch.compiler.is_compiling()
    assert not torch.compiler.is_compiling()


def private(name):
    return name.startswith("_") and not name.startswith("__")


def foreign_names(tree, own):
    """Private names of torch, TorchRL and TensorDict that a module's code has."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and private(node.attr):
            of = node.value.id if isinstance(node.value, ast.Name) else ""
            known = of in ("self", "cls") or of in own
            if of != "os" and not (known and node.attr in own):
                yield node.attr
        elif isinstance(node, ast.ImportFrom | ast.Import):
            module = getattr(node, "module", None)
            names = [f"{module}.{a.name}" if module else a.name for a in node.names]
            parts = [name.split(".") for name in names]
            for first, *others in parts:
                if first in ("torch", "torchrl", "tensordict"):
                    yield from filter(private, others)
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "").endswith("attr"):
            yield from (a.value for a in node.args[1:2] if private(str(getattr(a, "value", ""))))


def defined_names(tree):
    """Names that a module's code defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


def test_foreign_names_are_found():
    """Attributes, imports and texts; a module's own names are not among them."""
    code = """
import torch._guards
from torchrl.envs import _x as y
class Own:
    def __init__(self, buffer):
        self._kept = buffer._storage
        self._kept._len = getattr(buffer, "_y", 0)
        self._inherited()
        Own._kept
    """
    tree = ast.parse(code)
    found = sorted(set(foreign_names(tree, {"Own", "_kept"})))
    assert found == ["_guards", "_inherited", "_len", "_storage", "_x", "_y"]


SUBCLASSES = "for subclasses of a loss, a module or a transform"
ALLOWED = {
    **dict.fromkeys(("_reduce_loss", "_loss_mask_keys", "_maybe_get_priority_weight"), SUBCLASSES),
    **dict.fromkeys(("_clear_weakrefs", "_default_device", "_value_estimator"), SUBCLASSES),
    **dict.fromkeys(("_forward_value_estimator_keys", "_call"), SUBCLASSES),
    **dict.fromkeys(("_buffers", "_modules", "_load_from_state_dict"), SUBCLASSES),
    **dict.fromkeys(
        ("_load_state_dict_pre_hooks", "_forward_hooks", "_OutKeysSelect"),
        "a loss takes over what its base has registered",
    ),
    **dict.fromkeys(("_sources", "_targets"), "what a target network's updater steps between"),
    "_event_dims": "what a TanhNormal's subclass needs of its shape",
    **dict.fromkeys(("_BatchNorm", "_DropoutNd"), "all layers whose rows depend on each other"),
    "_vmap_func": "ensembles as TorchRL's losses evaluate them",
    **dict.fromkeys(("_param", "_mask", "_sparse_mask"), "logits without a second normalization"),
    **dict.fromkeys(("_normalize_hydra_key", "_normalize_hydra_keys"), "keys in configurations"),
}


def names_of_others(files):
    """By the files' names; and the names that the files define."""
    trees = {path.name: ast.parse(path.read_text()) for path in files}
    own = {name for tree in trees.values() for name in defined_names(tree)} - ALLOWED.keys()
    found = {name: set(foreign_names(tree, own)) for name, tree in trees.items()}
    return {name: names for name, names in found.items() if names}, own


def test_the_experiment_has_private_names_of_others_in_two_files():
    """Whoever needs another one puts it there, with its reason and a test."""
    files = (PACKAGE / "experiment").rglob("*.py")
    found, _ = names_of_others(files)
    assert found.keys() == {"_torch_internals.py", "_torchrl_internals.py"}


def test_the_components_have_those_private_names_of_others_that_are_listed():
    """Each with its reason; torch's own optimizers call the functions on lists of tensors."""
    files = [path for path in PACKAGE.rglob("*.py") if "experiment" not in path.parts]
    found, own = names_of_others(files)
    names = set().union(*found.values()) - own
    assert {name for name in names if not name.startswith("_foreach_")} == ALLOWED.keys()
