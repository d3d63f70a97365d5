"""The activation and the networks: what they compute, and that TorchRL can use them."""

import copy
import math

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.distributions import (
    AffineTransform,
    Normal,
    SigmoidTransform,
    TransformedDistribution,
)
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from torchrl_l2c2 import Squish, make_actor, make_critic
from torchrl_l2c2.modules import SigmoidNormal


def observations(*batch, size=3):
    torch.manual_seed(1)
    return TensorDict({"observation": torch.randn(*batch, size)}, batch_size=batch)


@pytest.mark.parametrize("b", [0.5, 4.0, 9.0])
def test_squish_is_the_input_times_the_derivative_of_squareplus(b):
    """Against automatic differentiation of squareplus itself."""
    x = torch.linspace(-20.0, 20.0, 81, dtype=torch.float64, requires_grad=True)
    squareplus = 0.5 * (x + (x.square() + b).sqrt())
    (derivative,) = torch.autograd.grad(squareplus.sum(), x)
    torch.testing.assert_close(Squish(b)(x), x * derivative)


def test_squish_by_hand():
    """sqrt(1.5^2 + 4) = 2.5, so 1.5 gives 1.5 * (1 + .6) / 2 and -1.5 gives -1.5 * (1 - .6) / 2."""
    x = torch.tensor([-1.5, 0.0, 1.5])
    torch.testing.assert_close(Squish()(x), torch.tensor([-0.3, 0.0, 1.2]))


def test_squish_has_swishs_bend_at_zero_and_becomes_a_relu():
    """With the default b to second order; with a b towards 0."""
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    for activation in (Squish(), nn.SiLU()):
        (first,) = torch.autograd.grad(activation(x).sum(), x, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), x)
        assert (first.item(), second.item()) == pytest.approx((0.5, 0.5))
    y = torch.linspace(-2.0, 2.0, 9)
    torch.testing.assert_close(Squish(1e-10)(y), y.relu(), rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_squish_of_large_inputs_in_half_precision(dtype):
    """Those of single precision, rounded; the slopes are 0 and 1 there."""
    x = torch.tensor([-1000.0, -256.0, 3.0, 256.0, 60000.0], dtype=dtype, requires_grad=True)
    found, single = Squish()(x), Squish()(x.float())
    torch.testing.assert_close(found, single.to(dtype))
    (slope,) = torch.autograd.grad(found.sum(), x)
    torch.testing.assert_close(slope[[0, -1]], torch.tensor([0.0, 1.0], dtype=dtype))


@pytest.mark.parametrize("b", [0.0, -1.0, math.inf, math.nan])
def test_squish_refuses_a_bend_out_of_range(b):
    """Naming what is allowed."""
    with pytest.raises(ValueError, match="b must be finite and greater than 0"):
        Squish(b)


@pytest.mark.parametrize("make", [lambda: make_actor(3, 2), lambda: make_critic(3)])
def test_the_hidden_layers_are_the_papers(make):
    """Twice 100 neurons, each layer Linear, LayerNorm, Squish, and a linear output."""
    layers = [m for m in make().modules() if isinstance(m, nn.Linear | nn.LayerNorm | Squish)]
    kinds = [nn.Linear, nn.LayerNorm, Squish]
    assert [type(layer) for layer in layers] == [*kinds, *kinds, nn.Linear]
    assert [layer.in_features for layer in layers[::3]] == [3, 100, 100]
    assert [layer.normalized_shape for layer in layers[1::3]] == [(100,), (100,)]
    assert [layer.b for layer in layers[2::3]] == [4.0, 4.0]


def test_sizes_and_bends_can_be_chosen():
    """Other hidden layers, none at all, and another bend."""
    actor = make_actor(3, 1, hidden=(8, 4, 2), squish_b=1.0)
    assert [m.out_features for m in actor.modules() if isinstance(m, nn.Linear)] == [8, 4, 2, 2]
    assert {m.b for m in actor.modules() if isinstance(m, Squish)} == {1.0}
    critic = make_critic(3, num_heads=2, hidden=())
    assert [m.out_features for m in critic.modules() if isinstance(m, nn.Linear)] == [2]


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_shapes_for_any_leading_batch(batch):
    """What actor and critic write, and nothing else."""
    td = make_critic(3)(make_actor(3, 2)(observations(*batch)))
    assert {key: tuple(value.shape) for key, value in td.items()} == {
        "observation": (*batch, 3),
        "loc": (*batch, 2),
        "scale": (*batch, 2),
        "action": (*batch, 2),
        "action_log_prob": batch,
        "state_value": (*batch, 1),
        "state_value_heads": (*batch, 5),
    }


def test_the_value_is_the_mean_of_different_heads():
    """And all heads read the same hidden layers."""
    critic = make_critic(3)
    td = critic(observations(6))
    torch.testing.assert_close(td["state_value"].squeeze(-1), td["state_value_heads"].mean(-1))
    assert (td["state_value_heads"].std(-1) > 0.0).all()
    # Two hidden layers with their norms, and an output of 5 x 100 weights and 5 biases.
    expected = (300 + 100 + 200) + (10_000 + 100 + 200) + 505
    assert sum(p.numel() for p in critic.parameters()) == expected


def test_the_log_likelihood_is_that_of_a_squashed_normal():
    """In the bounds [-2, 4]: a = 1 + 3 tanh(x), so log p(a) = log N(x) - log(3 (1 - tanh(x)^2))."""
    torch.manual_seed(0)
    actor = make_actor(3, Bounded(low=-2.0, high=4.0, shape=(2,)))
    td = actor(observations(50))
    y = ((td["action"] - 1.0) / 3.0).double()
    normal = Normal(td["loc"].double(), td["scale"].double())
    expected = (normal.log_prob(y.atanh()) - (3.0 * (1.0 - y.square())).log()).sum(-1)
    torch.testing.assert_close(td["action_log_prob"].double(), expected, rtol=1e-3, atol=1e-3)
    assert (td["action"].abs().amax() > 2.0) and (td["action"] >= -2.0).all()


def test_a_sigmoid_squashes_a_normal_of_the_given_location_and_scale():
    """By torch's own transforms; the actor's other keys are those of the normal."""
    torch.manual_seed(0)
    td = make_actor(3, Bounded(low=-2.0, high=4.0, shape=(2,)), squash="sigmoid")(observations(50))
    normal = Normal(td["loc"].double(), td["scale"].double())
    squashed = TransformedDistribution(normal, [SigmoidTransform(), AffineTransform(-2.0, 6.0)])
    expected = squashed.log_prob(td["action"].double()).sum(-1)
    torch.testing.assert_close(td["action_log_prob"].double(), expected, rtol=1e-3, atol=1e-3)


def test_the_mode_behind_a_sigmoid_is_where_its_density_is_largest():
    """On a grid; the estimate ends where Adam's steps are small."""
    torch.manual_seed(0)
    policy = SigmoidNormal(torch.tensor([2.0]), torch.tensor([0.5]), low=0.0, high=10.0)
    grid = torch.linspace(0.01, 9.99, 2000).unsqueeze(-1)
    largest = grid[policy.log_prob(grid).argmax()]
    torch.testing.assert_close(policy.get_mode(), largest, rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("squash", "action", "expected"),
    [
        ("tanh", 2, torch.tanh),
        ("tanh", Bounded(-2.0, 4.0, shape=(2,)), lambda loc: 1.0 + 3.0 * loc.tanh()),
        ("sigmoid", Bounded(-2.0, 4.0, shape=(2,)), lambda loc: 6.0 * loc.sigmoid() - 2.0),
        ("none", 2, lambda loc: loc),
        ("none", Unbounded(shape=(2,)), lambda loc: loc),
    ],
)
def test_the_deterministic_action_is_the_squashed_location(squash, action, expected):
    """Without an exploration type it is a sample."""
    torch.manual_seed(0)
    actor = make_actor(3, action, squash=squash)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = actor(observations(4))
    torch.testing.assert_close(td["action"], expected(td["loc"]))
    assert not torch.isclose(actor(observations(4))["action"], td["action"]).any()


def test_actions_have_their_own_bounds():
    """Samples of a wide policy fill each dimension's interval and stay in it."""
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 10.0])
    torch.manual_seed(0)
    actor = make_actor(3, Bounded(low, high, shape=(2,)), scale_mapping="biased_softplus_5.0")
    action = actor(observations(500))["action"]
    assert ((action >= low) & (action <= high)).all()
    torch.testing.assert_close(action.amin(0), low, rtol=0.0, atol=0.01)
    torch.testing.assert_close(action.amax(0), high, rtol=0.0, atol=0.01)
    assert actor.spec["action"].is_in(action)


def test_the_scale_mapping_can_be_chosen():
    """With a zero output, biased softplus gives its bias and exp gives 1."""
    for mapping, expected in (("biased_softplus_0.5", 0.5), ("exp", 1.0)):
        actor = make_actor(3, 2, scale_mapping=mapping)
        last = [m for m in actor.modules() if isinstance(m, nn.Linear)][-1]
        nn.init.zeros_(last.weight), nn.init.zeros_(last.bias)
        td = actor(observations(2))
        torch.testing.assert_close(td["scale"], torch.full((2, 2), expected))


@pytest.mark.parametrize("number", ["0", "-1", "0.005", "nan", "inf"])
def test_an_initial_scale_below_the_smallest_is_refused(number):
    """It would stay at 0.01 with hardly a gradient, or be NaN."""
    with pytest.raises(ValueError, match=r"any number above 0\.01 as the initial scale, got"):
        make_actor(3, 2, scale_mapping=f"biased_softplus_{number}")


def test_several_observations_are_concatenated():
    """Also nested ones, in the order of the keys."""
    torch.manual_seed(0)
    single, double = make_critic(5), make_critic(5, in_keys=["x", ("sensors", "y")])
    double.load_state_dict(single.state_dict())
    x, y = torch.randn(4, 2), torch.randn(4, 3)
    whole = TensorDict({"observation": torch.cat([x, y], -1)}, batch_size=[4])
    parts = TensorDict({"x": x, "sensors": {"y": y}}, batch_size=[4])
    torch.testing.assert_close(double(parts)["state_value"], single(whole)["state_value"])
    actor = make_actor(5, 1, in_keys=["x", ("sensors", "y")])
    assert actor(parts)["action"].shape == (4, 1)


def test_a_string_is_one_observation():
    """And not its letters."""
    assert make_actor(3, 1, in_keys="observation").in_keys == ["observation"]
    assert make_critic(3, in_keys="observation").in_keys == ["observation"]


def test_torchrls_ppo_trains_them_as_they_are():
    """Its default keys fit, and every parameter of both networks gets a gradient."""
    actor, critic = make_actor(3, 2), make_critic(3)
    loss = ClipPPOLoss(actor, critic)
    td = actor(observations(8)).detach()
    td["advantage"], td["value_target"] = torch.randn(2, 8, 1)
    terms = loss(td)
    (terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]).backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0.0 for p in loss.parameters())


def test_copies_are_independent():
    """A deep copy computes the same and shares no parameter."""
    for module, key in ((make_actor(3, 2), "loc"), (make_critic(3), "state_value")):
        twin = copy.deepcopy(module)
        td = observations(4)
        assert torch.equal(module(td.clone())[key], twin(td.clone())[key])
        for p in twin.parameters():
            p.data.zero_()
        assert module(td)[key].abs().sum() > 0.0


def test_compiled_they_give_the_same_numbers():
    """Without a graph break, in deterministic and in sampling mode."""
    torch._dynamo.reset()
    actor, critic = make_actor(3, Bounded(-2.0, 2.0, shape=(2,))), make_critic(3)

    def act(observation):
        td = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        td = critic(actor(td))
        return td["action"], td["action_log_prob"], td["state_value"]

    compiled = torch.compile(act, backend="aot_eager", fullgraph=True)
    x = observations(4)["observation"]
    for mode in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(mode), torch.no_grad():
            torch.manual_seed(0)
            expected = act(x)
            torch.manual_seed(0)
            for ours, theirs in zip(compiled(x), expected, strict=True):
                torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: make_actor(0, 1), ValueError, "observation_size must be "),
        (lambda: make_actor(3, 0), ValueError, "number of actions must be at least 1"),
        (
            lambda: make_actor(3, 1, hidden=(10, 0)),
            ValueError,
            "every entry of hidden must be at least 1",
        ),
        (
            lambda: make_actor(3, 1, squash="clip"),
            ValueError,
            "squash must be 'tanh' or 'sigmoid' or 'none'",
        ),
        (lambda: make_actor(3, 1, squish_b=0.0), ValueError, "b must be finite"),
        (lambda: make_actor(3, Unbounded(shape=(2,))), ValueError, "needs finite bounds"),
        (lambda: make_actor(3, Bounded(-1.0, math.inf, (2,))), ValueError, "needs finite bounds"),
        (lambda: make_actor(3, Bounded(1.0, 1.0, (2,))), ValueError, r"got \[1.0, 1.0\] and \[1.0"),
        (lambda: make_actor(3, 1, in_keys=()), ValueError, "in_keys must name at least one"),
        (lambda: make_actor(3, 1, in_keys=None), ValueError, "in_keys must name at least one"),
        (
            lambda: make_actor(3, gymnasium.spaces.Box(-1.0, 1.0, (1,))),
            TypeError,
            r"such as env.action_spec_unbatched, .* got Box",
        ),
        (lambda: make_actor(3, 1, scale_mapping=3), TypeError, "must be a name, .* got 3"),
        (lambda: make_actor(3, Bounded(-1.0, 1.0, (4, 2))), ValueError, "action_spec_unbatched"),
        (lambda: make_actor(3, Categorical(4)), TypeError, "must be continuous"),
        (lambda: make_actor(3, Composite(a=Unbounded((2,)))), TypeError, "single tensor"),
        (lambda: make_critic(3, num_heads=0), ValueError, "num_heads must be at least 1, got 0"),
        (lambda: make_actor(3, 1, hidden=32), TypeError, "sizes of the layers, .* got 32"),
        (
            lambda: make_actor(3, 1, scale_mapping="square"),
            ValueError,
            "as the initial scale, got 'square'",
        ),
        (lambda: make_critic(2.5), TypeError, "observation_size must be "),
    ],
)
def test_wrong_settings_are_refused(make, error, message):
    """At construction, naming the setting and what is allowed."""
    with pytest.raises(error, match=message):
        make()
