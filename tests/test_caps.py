"""The two terms of CAPS against hand-computed numbers and the moments of its noise."""

from __future__ import annotations

import math

import pytest
import torch
from losses import (
    BOUNDS,
    composite_actor,
    critic,
    deterministic_actor,
    gaussian_actor,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import nn
from torchrl.modules import (
    Actor,
    IndependentNormal,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
)
from torchrl.objectives import DDPGLoss, DQNLoss, PPOLoss, SACLoss

from torchrl_l2c2 import CAPSLoss
from torchrl_l2c2.objectives.caps import caps_terms

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torchrl")

WEIGHT = torch.tensor([[1.0, -2.0, 0.5], [0.0, 1.0, 1.0]])


def linear_loss(**kwargs) -> CAPSLoss:
    """A deterministic policy W s on a state of three coordinates."""
    net = nn.Linear(3, 2, bias=False)
    net.weight.data = WEIGHT.clone()
    return CAPSLoss(DDPGLoss(Actor(net), qvalue()), **kwargs)


def linear_batch() -> TensorDict:
    """Two transitions whose actions move by (1, 0) and (-1.5, 2)."""
    batch = transitions(2)
    batch["observation"] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    batch["next", "observation"] = torch.tensor([[1.0, 0.0, 0.0], [1.0, 2.0, 2.0]])
    return batch


def test_both_terms_are_half_squared_distances_of_means():
    """Of two means at 0 and (1, 1): to the next ones, then to the noisy ones."""
    mean = torch.tensor([[[0.0, 0.0], [1.0, 1.0]]])
    later = torch.tensor([[3.0, 4.0], [1.0, 1.0]])
    noisy = torch.tensor([[0.0, 1.0], [-1.0, 2.0]])
    temporal, spatial = caps_terms(mean, torch.stack((later, noisy)))
    assert temporal.tolist() == [12.5, 0.0]
    assert spatial.tolist() == [0.5, 2.5]


class TestTemporalTerm:
    def test_it_is_half_the_squared_distance_of_successive_means(self):
        """lambda_T times the mean of 1/2 and 1/2 (1.5^2 + 2^2)."""
        terms = linear_loss(lambda_temporal=0.3).policy_regularizer(linear_batch())
        expected = 0.3 * (0.5 + 0.5 * (1.5**2 + 2.0**2)) / 2
        assert terms["loss_caps_temporal"].item() == pytest.approx(expected, rel=1e-6)

    def test_gradients_flow_through_both_states(self):
        """d/dW of 1/2 |W x|^2 is (W x) x^T with x the difference of the states."""
        loss = linear_loss(lambda_temporal=1.0)
        term = loss.policy_regularizer(linear_batch())["loss_caps_temporal"]
        (found,) = torch.autograd.grad(term, loss.actor_network.module.weight)
        moves = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
        actions = moves @ WEIGHT.T
        torch.testing.assert_close(found, (actions.T @ moves) / 2)

    def test_next_observations_that_are_not_finite_do_no_harm(self):
        """A coordinate that is NaN or infinite counts as not having moved."""
        batch = linear_batch()
        batch["next", "observation"][1, 1:] = torch.tensor([math.nan, math.inf])
        loss = linear_loss(lambda_temporal=1.0)
        term = loss.policy_regularizer(batch)["loss_caps_temporal"]
        assert term.item() == pytest.approx(0.5 / 2)
        gradients = torch.autograd.grad(term, list(loss.actor_network_params.values(True, True)))
        assert all(gradient.isfinite().all() for gradient in gradients)


class TestSpatialTerm:
    def test_its_noise_is_normal_with_sigma_on_every_coordinate(self):
        """For a linear policy the mean of the term is lambda_S sigma^2 |W|^2 / 2."""
        torch.manual_seed(0)
        batch = transitions(40000)
        for sigma in (0.2, 1.0):
            term = linear_loss(sigma=sigma, lambda_spatial=1.0).policy_regularizer(batch)
            expected = 0.5 * sigma**2 * WEIGHT.square().sum().item()
            assert term["loss_caps_spatial"].item() == pytest.approx(expected, rel=0.03)

    def test_it_vanishes_for_a_policy_that_ignores_the_state(self):
        """A constant policy cannot be smoother."""
        loss = linear_loss()
        loss.actor_network.module.weight.data.zero_()
        terms = loss.policy_regularizer(linear_batch())
        assert terms["loss_caps_spatial"] == terms["loss_caps_temporal"] == 0


class TestMeans:
    @pytest.mark.parametrize("mean", ["loc", "action"])
    def test_means_of_a_squashed_policy_are_compared_on_the_side_asked_for(self, mean):
        """Before the squashing, or after it: tanh of the normal's mean."""
        torch.manual_seed(0)
        actor = gaussian_actor()
        base = SACLoss(actor, qvalue(), action_spec=BOUNDS)
        loss = CAPSLoss(base, lambda_temporal=1.0, mean=mean)
        batch = transitions(4)
        with torch.no_grad():
            here = actor.module[0](batch.clone())["loc"]
            there = actor.module[0](batch["next"].clone())["loc"]
        if mean == "action":
            here, there = here.tanh(), there.tanh()
        expected = 0.5 * (here - there).square().sum(-1).mean()
        found = loss.policy_regularizer(batch)["loss_caps_temporal"]
        torch.testing.assert_close(found.detach(), expected)

    def test_the_scale_of_the_policy_does_not_count(self):
        """CAPS sees means alone, where L2C2 compares distributions."""

        class Growing(nn.Module):
            def __init__(self):
                super().__init__()
                self.loc = nn.Parameter(torch.zeros(1))

            def forward(self, observation):
                scale = 1.0 + observation.square().sum(-1, keepdim=True)
                return self.loc.expand_as(scale), scale

        actor = ProbabilisticActor(
            TensorDictModule(Growing(), ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
            return_log_prob=True,
        )
        terms = CAPSLoss(PPOLoss(actor, critic())).policy_regularizer(transitions(4))
        assert terms["loss_caps_spatial"] == terms["loss_caps_temporal"] == 0

    def test_the_heads_of_a_composite_policy_add_up(self):
        """The squared distances of all continuous heads are summed."""
        torch.manual_seed(0)
        module = TensorDictModule(
            lambda observation: (observation, torch.ones_like(observation)) * 2,
            ["observation"],
            [("params", head, name) for head in ("left", "right") for name in ("loc", "scale")],
        )
        actor = ProbabilisticActor(
            module,
            in_keys=["params"],
            out_keys=["left", "right"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={"distribution_map": {"left": TanhNormal, "right": TanhNormal}},
            return_log_prob=True,
        )
        batch = transitions(4)
        loss = CAPSLoss(PPOLoss(actor, critic()), lambda_temporal=1.0, mean="action")
        found = loss.policy_regularizer(batch)["loss_caps_temporal"]
        moves = batch["observation"].tanh() - batch["next", "observation"].tanh()
        torch.testing.assert_close(found, 2 * 0.5 * moves.square().sum(-1).mean())

    @pytest.mark.parametrize("kind", [torch.distributions.Categorical, OneHotCategorical])
    def test_of_a_discrete_policy_the_probabilities_are_compared(self, kind):
        """Half the squared distance of two softmaxes."""
        net = nn.Linear(3, 2, bias=False)
        net.weight.data = WEIGHT.clone()
        actor = ProbabilisticActor(
            TensorDictModule(net, ["observation"], ["logits"]),
            in_keys=["logits"],
            distribution_class=kind,
            return_log_prob=True,
        )
        batch = linear_batch()
        loss = CAPSLoss(PPOLoss(actor, critic()), lambda_temporal=1.0)
        found = loss.policy_regularizer(batch)["loss_caps_temporal"]
        here, there = (s @ WEIGHT.T for s in (batch["observation"], batch["next", "observation"]))
        moves = here.softmax(-1) - there.softmax(-1)
        torch.testing.assert_close(found, 0.5 * moves.square().sum(-1).mean())

    def test_discrete_and_continuous_heads_add_up(self):
        """A composite policy of both kinds has one finite term that trains it."""
        loss = CAPSLoss(PPOLoss(composite_actor(), critic()))
        term = loss.policy_regularizer(transitions(4))["loss_caps_temporal"]
        assert term > 0 and term.shape == ()


class TestGains:
    def test_papers_values_are_the_defaults(self):
        """sigma = .2, lambda_T = .01, lambda_S = .05, on means before the squashing."""
        loss = linear_loss()
        assert loss.caps_sigma == 0.2
        assert loss.caps_mean == "loc"
        assert loss.caps_lambda_temporal.item() == pytest.approx(0.01)
        assert loss.caps_lambda_spatial.item() == pytest.approx(0.05)

    def test_they_can_be_scheduled_one_by_one(self):
        """Each gain scales its own term."""
        loss = linear_loss()
        torch.manual_seed(0)
        before = loss.policy_regularizer(linear_batch())
        loss.caps_lambda_temporal = 0.02
        loss.caps_lambda_spatial = 0.2
        torch.manual_seed(0)
        after = loss.policy_regularizer(linear_batch())
        for key, factor in (("loss_caps_temporal", 2), ("loss_caps_spatial", 4)):
            torch.testing.assert_close(after[key], factor * before[key])

    def test_only_the_policy_is_trained(self):
        """No gradient reaches the value function, and there is no value term."""
        torch.manual_seed(0)
        loss = CAPSLoss(DDPGLoss(deterministic_actor(), qvalue()))
        batch = transitions(4)
        terms = loss(batch)
        total = terms["loss_caps_temporal"] + terms["loss_caps_spatial"]
        for name, parameter in loss.named_parameters():
            (gradient,) = torch.autograd.grad(
                total, parameter, retain_graph=True, allow_unused=True
            )
            assert (gradient is not None) == name.startswith("actor_network_params")
        assert loss.value_regularizer(batch).is_empty()


class TestConstruction:
    @pytest.mark.parametrize(
        ("settings", "error", "message"),
        [
            ({"sigma": 0.0}, ValueError, "sigma must be finite and greater than 0, got 0.0"),
            ({"sigma": math.inf}, ValueError, "sigma must be finite and greater than 0"),
            ({"sigma": "0.2"}, TypeError, "sigma must be a real number"),
            ({"mean": "mode"}, ValueError, "mean must be 'loc' or 'action', got 'mode'"),
            ({"lambda_temporal": -1}, ValueError, "caps_lambda_temporal must be finite"),
            ({"lambda_spatial": None}, TypeError, "caps_lambda_spatial must be a real number"),
        ],
    )
    def test_wrong_settings_are_refused(self, settings, error, message):
        """At construction, with what was given and what is allowed."""
        with pytest.raises(error, match=message):
            linear_loss(**settings)

    def test_a_loss_without_a_policy_is_refused(self):
        """Q-learning has no mean action to smooth."""
        loss = DQNLoss(
            TensorDictModule(nn.Linear(3, 4), ["observation"], ["action_value"]),
            action_space="one-hot",
        )
        with pytest.raises(TypeError, match="CAPSLoss needs a policy: DQNLoss has none"):
            CAPSLoss(loss)
