"""The two terms of L2C2 against hand-computed numbers and a slow loop over transitions."""

from __future__ import annotations

import copy
import math
import warnings
from dataclasses import replace

import pytest
import torch
from losses import (
    ACTION,
    AGENTS,
    BOUNDS,
    OBSERVATION,
    action_values,
    agents_batch,
    critic,
    deterministic_actor,
    gaussian_actor,
    heads_critic,
    make_distributional_dqn,
    make_mappo,
    mlp,
    on_policy,
    one_hot_batch,
    qvalue,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import Actor, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import (
    ClipPPOLoss,
    DDPGLoss,
    DiscreteSACLoss,
    DQNLoss,
    IQLLoss,
    PPOLoss,
    SACLoss,
    TD3Loss,
)

from torchrl_l2c2 import L2C2Loss, Neighborhood, NeighborTransform, PPORPELoss
from torchrl_l2c2.objectives._batch import draw_rows
from torchrl_l2c2.objectives.l2c2 import l2c2_penalty

# epsilon = 1/4, lambda_pi = 1/4: the gain is 1 at distance 1/4 and 1/5 at distance 5/4.
NEAR = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0)

pytestmark = pytest.mark.filterwarnings(
    "ignore::UserWarning:torchrl", "ignore:.*leaves out the policy term"
)


class LinearGaussian(nn.Module):
    """Mean w.s and standard deviation 1/2 of a policy over one action."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, -2.0]))

    def forward(self, observation):
        loc = (observation * self.weight).sum(-1, keepdim=True)
        return loc, torch.full_like(loc, 0.5)


class LinearValue(nn.Module):
    """V(s) = v.s."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([3.0, 1.0]))

    def forward(self, observation):
        return (observation * self.weight).sum(-1, keepdim=True)


def linear_loss(**kwargs) -> L2C2Loss:
    actor = ProbabilisticActor(
        TensorDictModule(LinearGaussian(), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = ValueOperator(LinearValue(), in_keys=["observation"])
    return L2C2Loss(PPOLoss(actor, value), NEAR, **kwargs)


def linear_batch() -> TensorDict:
    """Two states at 0 and (1, 1); u = (1/2, 1/4) and (0, -1): distances 3/4 and 5/4.

    The mean moves by 1/2 - 2/4 = 0 and by 2, the value by 3/2 + 1/4 = 7/4 and by -1.
    """
    neighbor = {
        "observation": torch.tensor([[[0.5, 0.25]], [[1.0, 0.0]]]),
        "distance": torch.tensor([[0.75], [1.25]]),
    }
    return TensorDict(
        {
            "observation": torch.tensor([[0.0, 0.0], [1.0, 1.0]]),
            "neighbor": TensorDict(neighbor, batch_size=[2]),
        },
        batch_size=[2],
    )


# H^2 of two normals of equal scale s whose means lie m apart is 1 - exp(-m^2 / (8 s^2)).
HELLINGER = 1.0 - math.exp(-(2.0**2) / (8 * 0.5**2))


class TestHandComputedNumbers:
    def test_the_policy_term(self):
        """lambda_pi times the mean of the Hellinger distance over the distance of the states."""
        terms = linear_loss().policy_regularizer(linear_batch())
        expected = (0.25 / 0.75 * 0.0 + 0.25 / 1.25 * HELLINGER) / 2
        assert terms["loss_l2c2_actor"].item() == pytest.approx(expected, rel=1e-6)
        assert terms["l2c2_hellinger"].item() == pytest.approx(HELLINGER / 2, rel=1e-6)

    def test_the_value_term(self):
        """beta lambda_pi times the mean of half the squared difference over the distance."""
        terms = linear_loss(beta=0.4).value_regularizer(linear_batch())
        differences = 0.5 * 1.75**2, 0.5 * 1.0**2
        expected = 0.4 * (0.25 / 0.75 * differences[0] + 0.25 / 1.25 * differences[1]) / 2
        assert terms["loss_l2c2_critic"].item() == pytest.approx(expected, rel=1e-6)
        assert terms["l2c2_value_distance"].item() == pytest.approx(sum(differences) / 2, rel=1e-6)

    def test_the_diagnostics_of_the_neighborhood(self):
        """The mean distance 1 and the mean gain (1/3 + 1/5) / 2."""
        terms = linear_loss().policy_regularizer(linear_batch())
        assert terms["l2c2_distance"].item() == pytest.approx(1.0)
        assert terms["l2c2_gain"].item() == pytest.approx((1 / 3 + 1 / 5) / 2)

    def test_the_gain_that_is_told_is_the_one_that_is_applied(self):
        """With the coefficient that multiplies all terms, as it is now."""
        loss = linear_loss()
        loss.l2c2_coeff = 0.5
        terms = loss.policy_regularizer(linear_batch())
        assert terms["l2c2_gain"].item() == pytest.approx((1 / 3 + 1 / 5) / 4)

    def test_the_gain_that_is_told_has_the_strength(self):
        loss = linear_loss()
        loss.strength = 0.5
        terms = loss.policy_regularizer(linear_batch())
        assert terms["l2c2_gain"].item() == pytest.approx((1 / 3 + 1 / 5) / 4)

    def test_gains_without_effect_are_told(self):
        """The paper's gains, up to 1, had none with PPO, SAC and TD3."""
        with pytest.warns(UserWarning, match="no measurable effect"):
            L2C2Loss(PPOLoss(gaussian_actor(), None), beta=0.0)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            L2C2Loss(PPOLoss(gaussian_actor(), None), Neighborhood(lambda_max=2.0), beta=0.0)

    def test_the_value_distance_is_summed_over_the_networks(self):
        """With a gain that hardly depends on the distance, as the terms are."""
        torch.manual_seed(0)
        base = IQLLoss(gaussian_actor(), qvalue(), value_network=critic())
        loss = L2C2Loss(base, Neighborhood(lambda_min=1.0, lambda_max=1.00001), beta=1.0)
        terms = loss.value_regularizer(transitions(16))
        added = sum(terms[key] for key in loss.added_terms - loss.policy_terms)
        assert len(loss.added_terms - loss.policy_terms) == 2
        torch.testing.assert_close(terms["l2c2_value_distance"], added, rtol=1e-3, atol=0.0)

    def test_gradients_flow_through_both_states(self):
        """d/dv of (v.x)^2 is 2 (v.x) x with x the difference of the states, not one of them."""
        loss = linear_loss(beta=1.0)
        term = loss.value_regularizer(linear_batch())["loss_l2c2_critic"]
        (found,) = torch.autograd.grad(term, loss.critic_network.module.weight)
        moves = torch.tensor([[0.5, 0.25], [0.0, -1.0]])
        gains = torch.tensor([[0.25 / 0.75], [0.25 / 1.25]])
        expected = (gains * torch.tensor([[1.75], [-1.0]]) * moves).mean(0)
        torch.testing.assert_close(found, expected)

    def test_several_neighbors_are_averaged(self):
        """The mean over K = 2 neighbors is that of two batches with one each."""
        loss, batch = linear_loss(), linear_batch()
        other = linear_batch()
        other["neighbor", "observation"] = -other["neighbor", "observation"]
        other["neighbor", "distance"] = other["neighbor", "distance"] + 0.1
        both = batch.clone()
        both["neighbor"] = TensorDict(
            {
                key: torch.cat((batch["neighbor", key], other["neighbor", key]), 1)
                for key in ("observation", "distance")
            },
            batch_size=[2],
        )
        for method in (loss.policy_regularizer, loss.value_regularizer):
            singles, found = (method(batch), method(other)), method(both)
            for key, value in found.items():
                torch.testing.assert_close(value, 0.5 * (singles[0][key] + singles[1][key]))

    @pytest.mark.parametrize(("u", "gain"), [(0.0, 1.0), (1.0, 0.2)])
    def test_the_gain_is_lambda_max_at_the_state_and_lambda_min_at_the_edge(self, u, gain):
        """At u = 0 and |u| = radius, where the distance is epsilon and radius + epsilon."""
        batch = linear_batch()
        batch["neighbor", "distance"] = torch.full((2, 1), u + NEAR.epsilon)
        terms = linear_loss().policy_regularizer(batch)
        assert terms["l2c2_gain"].item() == pytest.approx(gain)
        assert terms["loss_l2c2_actor"].item() == pytest.approx(gain * HELLINGER / 2, rel=1e-6)

    def test_priority_weights_make_a_weighted_mean(self):
        """With weights 1 and 3 the second transition counts three quarters."""
        batch = transitions(2)
        batch.update(linear_batch())
        batch["action"] = torch.zeros(2, 1)
        batch["priority_weight"] = torch.tensor([1.0, 3.0])
        weight = torch.tensor([[1.0, -2.0]])
        actor = Actor(nn.Linear(2, 1, bias=False))
        value = ValueOperator(LinearValue(), in_keys=["observation"])
        value.out_keys = ["state_action_value"]
        actor.module.weight.data = weight
        loss = L2C2Loss(DDPGLoss(actor, value), NEAR)
        found = loss.policy_regularizer(batch)["loss_l2c2_actor"]
        # Actions move by 0 and 2: half the squared distance is 0 and 2.
        assert found.item() == pytest.approx(0.75 * 0.25 / 1.25 * 2.0)

    def test_papers_values_are_the_defaults(self):
        """sigma = 1, gains .01 and 1, beta = .1: lambda_pi = .010101."""
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()))
        assert loss.l2c2_neighborhood == Neighborhood(1.0, 0.01, 1.0)
        assert loss.l2c2_neighborhood.scale == pytest.approx(0.010101, rel=1e-4)
        assert loss.l2c2_beta.item() == pytest.approx(0.1)
        assert loss.l2c2_coeff.item() == 1.0


class TestThePenalty:
    """The equation, as a function of tensors."""

    def test_it_is_the_mean_over_neighbors_of_gain_times_difference(self):
        """K = 2 neighbors of two transitions: (1 * 2 + .5 * 4) / 2 and (.2 * 5 + 0) / 2."""
        difference = torch.tensor([[2.0, 5.0], [4.0, 7.0]])
        gain = torch.tensor([[1.0, 0.2], [0.5, 0.0]])
        torch.testing.assert_close(l2c2_penalty(difference, gain), torch.tensor([2.0, 0.5]))

    def test_the_largest_of_the_neighbors_can_take_the_means_place(self):
        """max(1 * 2, .5 * 6) and max(.2 * 5, 0): of the penalty, not of the difference."""
        difference = torch.tensor([[2.0, 5.0], [6.0, 7.0]])
        gain = torch.tensor([[1.0, 0.2], [0.5, 0.0]])
        found = l2c2_penalty(difference, gain, "max")
        torch.testing.assert_close(found, torch.tensor([3.0, 1.0]))

    def test_the_losss_terms_are_of_the_largest_then(self):
        """Of the two neighbors together what each has alone, per transition."""
        torch.manual_seed(0)
        base = DDPGLoss(deterministic_actor(), qvalue(), reduction="none")
        batch = NeighborTransform(NEAR, num_samples=2)(transitions(6))
        loss = L2C2Loss(base, NEAR, num_samples=2, over_neighbors="max")
        alone = []
        for k in range(2):
            one = batch.copy()
            one["neighbor"] = TensorDict(
                {x: batch["neighbor", x][:, k : k + 1] for x in ("observation", "distance")}, [6]
            )
            alone.append(L2C2Loss(base, NEAR).policy_regularizer(one)["loss_l2c2_actor"])
        found = loss.policy_regularizer(batch)["loss_l2c2_actor"]
        torch.testing.assert_close(found, torch.maximum(*alone))

    @pytest.mark.parametrize("neighbors", ["box", "line"])
    def test_neighbors_of_other_observations_are_told_once(self, neighbors):
        """As of a transform before ObservationNorm: the stored distances look right."""
        torch.manual_seed(0)
        near = Neighborhood(sigma=1.0, neighbors=neighbors)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near)
        batch = loss.neighbor_transform()(transitions(6))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss.policy_regularizer(batch)
        scaled = batch.clone()
        for key in ("observation", ("next", "observation")):
            scaled[key] = 10.0 * batch[key]
        other = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near)
        with pytest.warns(UserWarning, match=r"not near its 'observation'.*after all transforms"):
            other.policy_regularizer(scaled)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            other.policy_regularizer(scaled)

    def test_a_transform_with_another_max_step_is_told(self):
        """All observations are known; only the transform leaves transitions out."""
        torch.manual_seed(0)
        batch = NeighborTransform(replace(NEAR, max_step=1.0))(transitions(6))
        assert batch["neighbor", "distance"].isinf().any()
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), NEAR)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            loss.policy_regularizer(batch)
            loss.policy_regularizer(batch)
        (message,) = (str(each.message) for each in told)
        assert message.startswith("the neighbors in the batch are of another neighborhood")

    @pytest.mark.parametrize("bound", [None, 2.0])
    def test_the_losss_max_step_counts_whatever_the_transforms_is(self, bound):
        """As if the far transitions were not in the batch."""
        torch.manual_seed(0)
        batch = transitions(6)
        batch["next", "observation"][::2] = batch["observation"][::2] + 1.0  # length sqrt(3)
        batch["next", "observation"][1::2] = batch["observation"][1::2] + 0.1
        stored = NeighborTransform(replace(NEAR, max_step=bound), num_samples=2)(batch)
        near = replace(NEAR, max_step=1.0)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near, num_samples=2)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = loss.policy_regularizer(stored)
        expected = loss.policy_regularizer(stored[1::2])
        for key in ("loss_l2c2_actor", "l2c2_gain"):
            torch.testing.assert_close(found[key], expected[key], rtol=1e-5, atol=0.0)
        assert (found["l2c2_counted"], expected["l2c2_counted"]) == (0.5, 1.0)

    def test_a_maximum_over_fewer_neighbors_is_told(self):
        """It would be smaller; a mean over fewer neighbors is as large."""
        torch.manual_seed(0)
        batch = NeighborTransform(NEAR)(transitions(6))
        base = DDPGLoss(deterministic_actor(), qvalue())
        largest = L2C2Loss(base, NEAR, num_samples=8, over_neighbors="max")
        with pytest.warns(
            UserWarning, match=r"num_samples=1, and L2C2.* largest penalty of 8: append"
        ):
            largest.policy_regularizer(batch)
        mean = L2C2Loss(base, NEAR, num_samples=8)
        again = L2C2Loss(base, NEAR, num_samples=8, over_neighbors="max")
        own = again.neighbor_transform()(batch.exclude("neighbor"))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            mean.policy_regularizer(batch)
            again.policy_regularizer(own)

    @pytest.mark.parametrize(
        "other", [Neighborhood(), Neighborhood(lambda_min=0.2, neighbors="line")]
    )
    def test_neighbors_of_another_neighborhood_are_told(self, other):
        """In a box instead of on the line, or at distances of another ratio of gains."""
        torch.manual_seed(0)
        near = Neighborhood(neighbors="line")
        batch, odd = transitions(6), replace(near, lambda_max=near.lambda_min + 1e-7)
        # A successor far away in one coordinate, and one that is the state itself.
        batch["next", "observation"][0, 0] = 1e4
        batch["next", "observation"][1] = batch["observation"][1]
        batch = NeighborTransform(other, num_samples=2)(batch)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near)
        with pytest.warns(UserWarning, match=r"another neighborhood than L2C2Loss\[DDPGLoss\]'s"):
            loss.policy_regularizer(batch)
        for neighborhood in (near, odd):  # At distances of a million, which are nearly the same.
            loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), neighborhood)
            own = loss.neighbor_transform()(batch.exclude("neighbor"))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                loss.policy_regularizer(own)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near)
        assert loss.policy_regularizer(own[:0])["loss_l2c2_actor"].isnan()

    @pytest.mark.parametrize(
        "other",
        [
            {"neighbors": "line"},
            {"lambda_max": 10.0},  # distances that are too small
            {"lambda_max": 0.25},  # and too large
            {"sigma": 0.25, "lambda_max": 0.25},  # the same epsilon, and a smaller box
        ],
    )
    def test_neighbors_of_another_box_are_told(self, other):
        torch.manual_seed(0)
        near = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near, num_samples=4)
        own = loss.neighbor_transform()(transitions(6))
        theirs = NeighborTransform(replace(near, **other), num_samples=4)(transitions(6))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss.policy_regularizer(own)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), near, num_samples=4)
        with pytest.warns(UserWarning, match="another neighborhood than"):
            loss.policy_regularizer(theirs)

    @pytest.mark.parametrize(
        ("change", "named"),
        [
            (torch.Tensor.double, r"\(6, 3\) torch.float32 and the states \(6, 3\) torch.float64"),
            (lambda state: state.unsqueeze(1), r"\(6, 3\) .* and the states \(6, 1, 3\)"),
        ],
    )
    def test_neighbors_before_a_change_of_shape_or_dtype_are_an_error(self, change, named):
        """And not torch's error in the network."""
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), NEAR)
        batch = loss.neighbor_transform()(transitions(6))
        for key in ("observation", ("next", "observation")):
            batch[key] = change(batch[key])
        with pytest.raises(ValueError, match=rf"{named}.*after all transforms"):
            loss.policy_regularizer(batch)

    def test_a_nested_key_without_a_list_is_told_to_be_put_into_one(self):
        """A tuple is a sequence of names elsewhere."""
        keys = [("agents", "observation"), ("agents", "action")]
        actor = TensorDictModule(mlp(OBSERVATION, ACTION), keys[:1], keys[1:])
        value = TensorDictModule(mlp(OBSERVATION + ACTION, 1), keys, ["state_action_value"])
        with pytest.raises(ValueError, match=r"into a list, \[\('agents', 'observation'\)\]\."):
            L2C2Loss(DDPGLoss(actor, value), NEAR, moved_keys=("agents", "observation"))
        with pytest.raises(ValueError, match=r"names \['obs'\], .*: name one or several of"):
            L2C2Loss(DDPGLoss(actor, value), NEAR, moved_keys=["obs"])

    @pytest.mark.parametrize("count", [4, AGENTS])
    def test_priority_weights_of_a_team_weight_each_of_its_agents(self, count):
        """Weights [B] for differences [B, agents], also in a batch of as many rows as agents."""
        keys = [("agents", "observation"), ("agents", "action")]
        net = nn.Sequential(mlp(OBSERVATION, ACTION), nn.Tanh())
        actor = TensorDictModule(net, keys[:1], keys[1:])
        value = TensorDictModule(mlp(OBSERVATION + ACTION, 1), keys, ["state_action_value"])
        batch = NeighborTransform(NEAR, keys[:1])(agents_batch(count))
        weights = torch.rand(count)
        found = {}
        for reduction in ("mean", "sum", "none"):
            loss = L2C2Loss(DDPGLoss(actor, value, reduction=reduction), NEAR, beta=0.0)
            plain = loss.policy_regularizer(batch.exclude("priority_weight"))["loss_l2c2_actor"]
            batch["priority_weight"] = weights
            found[reduction] = loss.policy_regularizer(batch)["loss_l2c2_actor"]
        weighted = weights[:, None] * plain
        torch.testing.assert_close(found["none"], weighted)
        torch.testing.assert_close(found["sum"], weighted.sum())
        torch.testing.assert_close(found["mean"], weighted.sum() / (AGENTS * weights.sum()))

    @pytest.mark.parametrize("last", [(), (1,)], ids=["[B, agents]", "[B, agents, 1]"])
    def test_a_mask_of_agents_leaves_agents_out(self, last):
        """Of terms and of what is logged: the team's distance counts for each that is left."""
        base, batch = make_mappo(), agents_batch(4)
        mask = torch.rand(4, AGENTS) > 0.4
        batch["agents", "mask"] = mask.reshape(4, AGENTS, *last)
        near = NeighborTransform(NEAR, [("agents", "observation")])(batch)["neighbor"]
        values = L2C2Loss(make_mappo(reduction="none"), NEAR)
        values.load_state_dict(base.state_dict())
        found, expected = L2C2Loss(base, NEAR), values.policy_regularizer(batch)
        found.loss_mask_key = ("agents", "mask")
        found = found.policy_regularizer(batch)
        term = expected["loss_l2c2_actor"]
        torch.testing.assert_close(found["loss_l2c2_actor"], term[mask].mean())
        distance = near["distance"].expand(4, AGENTS)[mask].mean()
        torch.testing.assert_close(found["l2c2_distance"], distance)

    def test_agents_share_the_gain_of_their_team(self):
        """Differences [K, B, agents] for gains [K, B]."""
        found = l2c2_penalty(torch.tensor([[[1.0, 3.0]]]), torch.tensor([[0.5]]))
        torch.testing.assert_close(found, torch.tensor([[0.5, 1.5]]))


class TestAgainstALoop:
    """Terms computed transition by transition, with the networks' own parameters."""

    @pytest.fixture(autouse=True)
    def seed(self):
        torch.manual_seed(0)

    def neighbors(self, batch: TensorDict, num_samples: int = 2) -> TensorDict:
        return NeighborTransform(NEAR, num_samples=num_samples)(batch)

    def mean_over_pairs(self, batch: TensorDict, difference) -> float:
        """Mean of difference(transition, neighbor) / distance over transitions and neighbors."""
        total, count = 0.0, 0
        for row in batch.unbind(0):
            for k in range(row["neighbor", "distance"].shape[0]):
                moved = row.clone()
                moved["observation"] = row["neighbor", "observation"][k]
                gain = NEAR.scale / row["neighbor", "distance"][k].item()
                total, count = total + gain * difference(row, moved), count + 1
        return total / count

    def call(self, loss, network: str, row: TensorDict, key: str, member: int | None = None):
        params = getattr(loss, f"{network}_params")
        params = params if member is None else params[member]
        with torch.no_grad(), params.to_module(getattr(loss, network)):
            return getattr(loss, network)(row.exclude("next", "neighbor"))[key]

    def test_members_of_a_q_ensemble_are_one_vector(self):
        """The squared errors of all members are summed, at the batch's action."""
        loss = L2C2Loss(
            TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS, num_qvalue_nets=3), NEAR
        )
        batch = self.neighbors(transitions(4))

        def difference(row, moved):
            values = [
                [
                    self.call(loss, "qvalue_network", state, "state_action_value", member).item()
                    for member in range(3)
                ]
                for state in (row, moved)
            ]
            return 0.5 * sum((a - b) ** 2 for a, b in zip(*values, strict=True))

        found = loss.value_regularizer(batch)["loss_l2c2_qvalue"].item()
        assert found == pytest.approx(0.1 * self.mean_over_pairs(batch, difference), rel=1e-4)

    def test_heads_of_an_ensemble_are_one_vector(self):
        """PPORPELoss's critic is compared over its heads, not over their mean."""
        loss = L2C2Loss(PPORPELoss(gaussian_actor(), heads_critic()), NEAR)
        batch = self.neighbors(on_policy(4))

        def difference(row, moved):
            here, there = (
                self.call(loss, "critic_network", state, "state_value_heads")
                for state in (row, moved)
            )
            assert here.shape == (3,)
            return 0.5 * (here - there).square().sum().item()

        found = loss.value_regularizer(batch)["loss_l2c2_critic"].item()
        assert found == pytest.approx(0.1 * self.mean_over_pairs(batch, difference), rel=1e-4)

    @pytest.mark.parametrize("ensemble", [False, True])
    def test_values_of_all_discrete_actions_are_one_vector(self, ensemble):
        """Whatever action the batch holds."""
        if ensemble:
            base = DiscreteSACLoss(
                ProbabilisticActor(
                    TensorDictModule(nn.Linear(3, 4), ["observation"], ["logits"]),
                    in_keys=["logits"],
                    distribution_class=torch.distributions.OneHotCategorical,
                    return_log_prob=True,
                ),
                action_values(),
                action_space="one-hot",
                num_actions=4,
            )
            network, members = "qvalue_network", (0, 1)
        else:
            base = DQNLoss(action_values(), action_space="one-hot")
            network, members = "value_network", (None,)
        loss = L2C2Loss(base, NEAR)
        batch = self.neighbors(one_hot_batch(4))

        def difference(row, moved):
            return sum(
                0.5
                * sum(
                    (a - b) ** 2
                    for a, b in zip(
                        self.call(loss, network, row, "action_value", member).tolist(),
                        self.call(loss, network, moved, "action_value", member).tolist(),
                        strict=True,
                    )
                )
                for member in members
            )

        found = loss.value_regularizer(batch)
        found = found["loss_l2c2_" + network.removesuffix("_network")].item()
        assert found == pytest.approx(0.1 * self.mean_over_pairs(batch, difference), rel=1e-4)

    def test_value_distributions_are_compared_by_hellinger(self):
        """Half the squared difference of the roots of the atoms' probabilities, all actions."""
        loss = L2C2Loss(make_distributional_dqn(), NEAR)
        batch = self.neighbors(one_hot_batch(4))

        def difference(row, moved):
            here, there = (
                self.call(loss, "value_network", state.unsqueeze(0), "action_value")[0].exp()
                for state in (row, moved)
            )
            torch.testing.assert_close(here.sum(0), torch.ones(4))
            return 0.5 * (here.sqrt() - there.sqrt()).square().sum().item()

        found = loss.value_regularizer(batch)["loss_l2c2_value"].item()
        assert found == pytest.approx(0.1 * self.mean_over_pairs(batch, difference), rel=1e-4)

    def test_policies_are_compared_by_hellinger(self):
        """A squashed policy has the distance of the normal distributions it squashes."""
        loss = L2C2Loss(SACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS), NEAR)
        batch = self.neighbors(transitions(4))

        def difference(row, moved):
            (m, s), (n, t) = (
                [self.call(loss, "actor_network", state, key).tolist() for key in ("loc", "scale")]
                for state in (row, moved)
            )
            affinity = 1.0
            for i in range(2):
                variance = s[i] ** 2 + t[i] ** 2
                affinity *= math.sqrt(2 * s[i] * t[i] / variance)
                affinity *= math.exp(-((m[i] - n[i]) ** 2) / (4 * variance))
            return 1.0 - affinity

        found = loss.policy_regularizer(batch)["loss_l2c2_actor"].item()
        assert found == pytest.approx(self.mean_over_pairs(batch, difference), rel=1e-3)

    def test_deterministic_policies_are_compared_by_their_actions(self):
        """Half the squared distance of the actions, not of their coordinates' mean."""
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), NEAR)
        batch = self.neighbors(transitions(4))

        def difference(row, moved):
            here, there = (
                self.call(loss, "actor_network", state.exclude("action"), "action").tolist()
                for state in (row, moved)
            )
            return 0.5 * sum((a - b) ** 2 for a, b in zip(here, there, strict=True))

        terms = loss.policy_regularizer(batch)
        expected = self.mean_over_pairs(batch, difference)
        assert terms["loss_l2c2_actor"].item() == pytest.approx(expected, rel=1e-4)


class TestNeighbors:
    def test_the_distance_of_several_observations_is_the_largest(self):
        """Drawn in the loss, all parts of a state move and the farthest counts."""
        keys = ["position", "velocity"]
        actor = Actor(mlp(3, 2), in_keys=keys)
        value = ValueOperator(mlp(5, 1), in_keys=[*keys, "action"])
        loss = L2C2Loss(DDPGLoss(actor, value), NEAR)
        batch = TensorDict(
            {
                "position": torch.zeros(500, 1),
                "velocity": torch.zeros(500, 2),
                "action": torch.zeros(500, 2),
                "next": {"position": torch.ones(500, 1), "velocity": torch.ones(500, 2)},
            },
            batch_size=[500],
        )
        torch.manual_seed(0)
        # The largest of three independent draws has the mean 3/4, of one 1/2, of two 2/3.
        for terms in (loss.policy_regularizer(batch), loss.value_regularizer(batch)):
            mean = terms["l2c2_distance"].item() - NEAR.epsilon
            assert mean == pytest.approx(0.75, abs=0.03)

    @pytest.mark.parametrize("written", [False, True], ids=["drawn here", "in the batch"])
    def test_a_single_transition_is_taken(self, written):
        """Its terms are those of a batch of it alone."""
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), NEAR)
        batch, terms = transitions(1), []
        if written:
            NeighborTransform(NEAR)(batch)
        for each in (batch, batch[0]):
            torch.manual_seed(0)
            terms.append(loss(each))
        for name in loss.added_terms:
            torch.testing.assert_close(terms[1][name], terms[0][name])

    @pytest.mark.parametrize("written", [False, True])
    def test_neighbors_train_no_encoder(self, written):
        """Drawn here or by a transform: no gradient reaches what made the observations."""
        loss, batch = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue())), transitions(8)
        seen = [batch["observation"], batch["next", "observation"]]
        for each in seen:
            each.requires_grad_()
        if written:
            NeighborTransform(Neighborhood())(batch)
            assert batch["neighbor", "observation"].requires_grad
        for regularizer in (loss.policy_regularizer, loss.value_regularizer):
            total = sum(t for k, t in regularizer(batch).items() if k.startswith("loss_"))
            assert torch.autograd.grad(total, seen, allow_unused=True) == (None, None)

    def test_around_a_loss_whose_evaluations_it_shares_it_trains_no_encoder_either(self):
        """PPO-RPE itself does; its evaluations are then not the regularizer's."""
        torch.manual_seed(0)
        loss, batch = L2C2Loss(PPORPELoss(gaussian_actor(), critic())), on_policy(8)
        batch["observation"].requires_grad_()
        terms = loss(batch)
        for key in terms.keys():
            if key.startswith("loss_"):
                (found,) = torch.autograd.grad(
                    terms[key], [batch["observation"]], retain_graph=True, allow_unused=True
                )
                assert (found is None) == ("l2c2" in key)

    def test_neighbors_are_drawn_as_often_as_asked(self):
        """More samples leave the mean as it is and make it less noisy."""
        torch.manual_seed(0)
        batch = transitions(4)
        actor = deterministic_actor()
        spread = {}
        for count in (1, 64):
            loss = L2C2Loss(DDPGLoss(actor, qvalue()), NEAR, num_samples=count)
            draws = torch.stack(
                [loss.policy_regularizer(batch)["loss_l2c2_actor"].detach() for _ in range(50)]
            )
            spread[count] = draws.std()
        assert spread[64] < spread[1] / 4

    def test_both_terms_of_a_forward_pass_share_their_neighbors(self, monkeypatch):
        """One draw serves the policy and the value function; alone, each draws its own."""
        draws = []

        def draw(self, *args, original=Neighborhood.draw, **kwargs):
            draws.append(args)
            return original(self, *args, **kwargs)

        monkeypatch.setattr(Neighborhood, "draw", draw)
        loss = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()))
        loss(transitions(4))
        assert len(draws) == 1
        loss.policy_regularizer(transitions(4))
        loss.value_regularizer(transitions(4))
        assert len(draws) == 3

    def test_another_entry_can_be_read(self):
        """neighbor_key names the entry that the transform wrote."""
        loss = linear_loss(neighbor_key="near")
        batch = linear_batch().rename_key_("neighbor", "near")
        assert loss.policy_regularizer(batch)["l2c2_distance"].item() == pytest.approx(1.0)
        with pytest.raises(KeyError, match=r"'near' is a tensor .* another neighbor_key"):
            loss.policy_regularizer(linear_batch().set("near", torch.zeros(2, 3)))


class TestWhichStatesAreMoved:
    def two_part_loss(self, **kwargs) -> tuple[L2C2Loss, TensorDict]:
        """A policy of a position and a velocity, which move by 1 and by 10."""
        keys = ["position", "velocity"]
        actor = Actor(mlp(3, 2), in_keys=keys)
        value = ValueOperator(mlp(5, 1), in_keys=[*keys, "action"])
        batch = {"position": torch.zeros(400, 1), "velocity": torch.zeros(400, 2)}
        later = {"position": torch.ones(400, 1), "velocity": torch.full((400, 2), 10.0)}
        batch = TensorDict({**batch, "action": torch.zeros(400, 2), "next": later}, [400])
        return L2C2Loss(DDPGLoss(actor, value), **{"neighborhood": NEAR, **kwargs}), batch

    @pytest.mark.parametrize("keys", [["position"], "position"], ids=["a list", "one"])
    def test_the_keys_can_be_chosen(self, keys):
        """The largest of one draw has the mean 1/2; of all three 3/4."""
        torch.manual_seed(0)
        loss, batch = self.two_part_loss(moved_keys=keys)
        mean = loss.policy_regularizer(batch)["l2c2_distance"].item() - NEAR.epsilon
        assert mean == pytest.approx(0.5, abs=0.05)

    def test_the_transform_moves_the_same_keys(self):
        loss, batch = self.two_part_loss(moved_keys=["velocity"])
        neighbors = loss.neighbor_transform()(batch)["neighbor"]
        assert set(neighbors.keys()) == {"velocity", "distance"}

    def test_a_key_that_the_batch_lacks_is_named(self):
        """With what there is."""
        loss, batch = self.two_part_loss(moved_keys=["velocity"])
        with pytest.raises(KeyError, match=r"velocity.*position"):
            loss.policy_regularizer(batch.exclude(("next", "velocity"), "velocity"))

    def test_every_network_has_to_be_moved(self):
        """A critic that reads another observation would be compared with itself."""
        critic = ValueOperator(mlp(4, 1), in_keys=["state"])
        base = ClipPPOLoss(gaussian_actor(), critic)
        with pytest.raises(ValueError, match=r"critic_network reads only \['state'\].*beta=0"):
            L2C2Loss(base, NEAR, moved_keys=["observation"])
        assert L2C2Loss(base, NEAR, beta=0.0, moved_keys=["observation"]).policy_terms
        assert L2C2Loss(base, NEAR, moved_keys=["observation", "state"]).added_terms

    @pytest.mark.parametrize(
        ("given", "error", "message"),
        [
            ({"moved_keys": ["speed"]}, ValueError, r"names \['speed'\], and the networks read"),
            ({"moved_keys": ["action"]}, ValueError, r"names \['action'\]"),
            ({"moved_keys": 3}, TypeError, "must be a list of entries, got 3"),
            ({"moved_keys": [3]}, TypeError, "an entry of moved_keys must be a string"),
            ({"neighbor_key": None}, TypeError, "neighbor_key must be a string or a tuple"),
            ({"neighbor_key": ["a", "b"]}, TypeError, "neighbor_key must be a string or a tuple"),
        ],
    )
    def test_names_are_checked_when_the_loss_is_made(self, given, error, message):
        """Not with the first batch."""
        with pytest.raises(error, match=message):
            self.two_part_loss(**given)

    def test_transitions_with_too_long_a_step_count_nothing(self):
        """The step of either part: values, gradients and diagnostics of the others remain."""
        near = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0, max_step=5.0)
        torch.manual_seed(0)
        base, batch = TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS), transitions(4)
        batch["next", "observation"][1:3] += 100.0
        batch = NeighborTransform(near)(batch)
        found = L2C2Loss(base, near).policy_regularizer(batch)
        expected = L2C2Loss(base, near).policy_regularizer(batch[[0, 3]])
        for key in ("loss_l2c2_actor", "l2c2_gain", "l2c2_distance", "l2c2_action_distance"):
            torch.testing.assert_close(found[key], expected[key])
        assert found["l2c2_counted"] == 0.5 and expected["l2c2_counted"] == 1.0
        gradients = torch.autograd.grad(
            found["loss_l2c2_actor"], list(base.actor_network_params.values(True, True))
        )
        assert all(gradient.isfinite().all() for gradient in gradients)

    def test_one_draw_moves_all_dimensions_of_all_keys(self):
        """Where it is shared, in the loss as in the transform."""
        near = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0, neighbors="line")
        loss, batch = self.two_part_loss(neighborhood=near)
        torch.manual_seed(0)
        mean = loss.policy_regularizer(batch)["l2c2_distance"].item() - near.epsilon
        assert mean == pytest.approx(0.5, abs=0.05)
        neighbor = NeighborTransform(near, ["position", "velocity"], num_samples=3)(batch)
        neighbor = neighbor["neighbor"]
        assert neighbor["velocity"].shape == (400, 3, 2)
        torch.testing.assert_close(
            neighbor["velocity"], 10 * neighbor["position"].expand(-1, -1, 2)
        )
        away = neighbor["position"].squeeze(-1).abs()
        torch.testing.assert_close(neighbor["distance"], away + near.epsilon)


class TestFraction:
    """Neighbors for a random share of the batch."""

    def losses(self, fraction: float, reduction: str = "mean") -> tuple[L2C2Loss, L2C2Loss]:
        """One of all neighbors and one of a share, of the same networks."""
        torch.manual_seed(0)
        base = TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS, reduction=reduction)
        return L2C2Loss(base, NEAR), L2C2Loss(base, NEAR, fraction=fraction)

    def mean_of_draws(self, loss: L2C2Loss, batch: TensorDict, draws: int = 300):
        """The means of both terms and their standard errors."""
        with torch.no_grad():
            found = torch.stack(
                [
                    torch.stack(
                        (
                            loss.policy_regularizer(batch)["loss_l2c2_actor"],
                            loss.value_regularizer(batch)["loss_l2c2_qvalue"],
                        )
                    )
                    for _ in range(draws)
                ]
            )
        return found.mean(0), found.std(0) / draws**0.5

    @pytest.mark.parametrize("extra", ["mask", "trajectories"])
    def test_the_expectation_is_that_of_all_neighbors(self, extra):
        """With masked positions, and of batches [B, T]."""
        whole, share = self.losses(0.25)
        batch = transitions(*((4, 2) if extra == "trajectories" else (8,)))
        if extra == "mask":
            batch["collector"] = TensorDict({"mask": torch.arange(8)[:, None] < 5}, [8])
        batch = NeighborTransform(NEAR)(batch)
        expected = torch.stack(
            (
                whole.policy_regularizer(batch)["loss_l2c2_actor"],
                whole.value_regularizer(batch)["loss_l2c2_qvalue"],
            )
        )
        mean, error = self.mean_of_draws(share, batch)
        assert (error > 0).all()
        assert ((mean - expected).abs() < 4 * error).all()

    def test_unreduced_a_drawn_transition_stands_for_the_others(self):
        """1 / fraction times what it has among all neighbors, the others nothing."""
        whole, share = self.losses(0.25, reduction="none")
        batch = NeighborTransform(NEAR)(transitions(8))
        for method, key in (("policy", "loss_l2c2_actor"), ("value", "loss_l2c2_qvalue")):
            full, found = (getattr(x, f"{method}_regularizer")(batch)[key] for x in (whole, share))
            drawn = found != 0
            assert drawn.sum() == 2
            torch.testing.assert_close(found[drawn], 4 * full[drawn])

    def test_neighbors_in_the_batch_are_those_that_count(self):
        """The share's distances are among those that the transform has written."""
        _, share = self.losses(0.5, reduction="none")
        batch = NeighborTransform(NEAR)(transitions(8))
        found = share.policy_regularizer(batch)["l2c2_distance"]
        written = batch["neighbor", "distance"].squeeze(1)
        assert ((found == 0) | torch.isclose(found, 2 * written)).all()
        assert (found != 0).sum() == 4

    def test_both_terms_share_the_drawn_rows(self):
        """Of one forward pass; the next one draws others."""
        _, share = self.losses(0.5, reduction="none")
        batch = transitions(64)
        first, second = (share(batch.copy()) for _ in range(2))
        for terms in (first, second):
            assert torch.equal(terms["loss_l2c2_actor"] != 0, terms["loss_l2c2_qvalue"] != 0)
        assert not torch.equal(first["loss_l2c2_actor"] != 0, second["loss_l2c2_actor"] != 0)

    def test_what_the_loss_has_evaluated_is_taken_at_the_drawn_rows(self):
        """PPORPELoss shares its evaluation: values and gradients as without sharing."""
        torch.manual_seed(0)
        loss = L2C2Loss(PPORPELoss(gaussian_actor(), heads_critic()), NEAR, fraction=0.5)
        batch = NeighborTransform(NEAR)(on_policy(8))
        torch.manual_seed(1)
        shared = loss(batch.copy())
        torch.manual_seed(1)
        alone = loss.policy_regularizer(batch)
        torch.manual_seed(1)
        alone.update(loss.value_regularizer(batch))
        parameters = list(loss.parameters())
        for key in ("loss_l2c2_actor", "loss_l2c2_critic"):
            torch.testing.assert_close(shared[key], alone[key])
            pairs = zip(
                *(
                    torch.autograd.grad(x[key], parameters, allow_unused=True, retain_graph=True)
                    for x in (shared, alone)
                ),
                strict=True,
            )
            for ours, theirs in pairs:
                assert (ours is None) == (theirs is None)
                if ours is not None:
                    torch.testing.assert_close(ours, theirs)

    @pytest.mark.slow
    def test_it_compiles_into_one_graph(self):
        """With the eager numbers, at the same seed."""
        torch._dynamo.reset()
        _, share = self.losses(0.5)
        batch = transitions(8)
        torch.manual_seed(1)
        expected = share(batch.copy())
        compiled = torch.compile(share, fullgraph=True, backend="eager")
        torch.manual_seed(1)
        found = compiled(batch.copy())
        for key in ("loss_l2c2_actor", "loss_l2c2_qvalue", "l2c2_gain"):
            torch.testing.assert_close(found[key], expected[key])

    def test_the_whole_batch_draws_nothing(self):
        """A seed gives the numbers that it gave; other shares are whole rows, at least one."""
        batch = NeighborTransform(NEAR)(transitions(8))
        state = torch.get_rng_state()
        assert draw_rows(batch, 1.0) is None and torch.equal(torch.get_rng_state(), state)
        assert len(draw_rows(batch, 1e-3)) == 1 and len(draw_rows(batch, 0.3)) == 2


class TestMonteCarlo:
    def test_sampled_actions_estimate_the_closed_form(self):
        """The paper's estimator has the closed form as its mean."""
        torch.manual_seed(0)
        expected = linear_loss().policy_regularizer(linear_batch())["l2c2_hellinger"]
        loss = linear_loss(hellinger_samples=4000)
        found = loss.policy_regularizer(linear_batch())["l2c2_hellinger"]
        assert found != expected
        assert found.item() == pytest.approx(expected.item(), rel=0.03)


def test_every_diagnostic_is_worked_out_once(monkeypatch):
    """Also what is of both terms, in a forward pass."""
    loss, worked_out = L2C2Loss(DDPGLoss(deterministic_actor(), qvalue())), []
    diagnostic = type(loss).reduce_diagnostic

    def counted(self, value, tensordict, **kwargs):
        worked_out.append(value)
        return diagnostic(self, value, tensordict, **kwargs)

    monkeypatch.setattr(type(loss), "reduce_diagnostic", counted)
    terms = loss(transitions(4))
    assert len(worked_out) == len([key for key in terms.keys() if key.startswith("l2c2_")])


class TestPolicyDistances:
    """Means move by 0 and 2, of normals with the standard deviation 1/2."""

    @pytest.mark.parametrize(
        ("distance", "diagnostic", "difference"),
        [
            ("hellinger", "l2c2_hellinger", HELLINGER),
            ("mean", "l2c2_mean_distance", 0.5 * 2.0**2),
            ("mse", "l2c2_mse", 2.0**2),
            ("kl", "l2c2_kl", 2.0**2 / (2 * 0.5**2)),
            (lambda p, q: (p.mean - q.mean).abs().sum(-1), "l2c2_policy_distance", 2.0),
        ],
        ids=["hellinger", "mean", "mse", "kl", "function"],
    )
    def test_the_one_that_was_chosen_is_trained_and_logged(self, distance, diagnostic, difference):
        """The term has its gain, the diagnostic its name."""
        loss = linear_loss(policy_distance=distance)
        terms = loss.policy_regularizer(linear_batch())
        expected = 0.25 / 1.25 * difference / 2
        assert terms["loss_l2c2_actor"].item() == pytest.approx(expected, rel=1e-6)
        assert terms[diagnostic].item() == pytest.approx(difference / 2, rel=1e-6)
        assert diagnostic in loss.out_keys
        (gradient,) = torch.autograd.grad(
            terms["loss_l2c2_actor"], loss.actor_network.module[0].module.weight
        )
        assert gradient.abs().sum() > 0

    def test_a_module_as_distance_stays_the_callers(self):
        """The loss has the parameters and the state of the plain one; its term is the module's."""

        class Scaled(nn.Module):
            def __init__(self):
                super().__init__()
                self.scale = nn.Parameter(torch.tensor(3.0))

            def forward(self, p, q):
                return self.scale * (p.mean - q.mean).square().sum(-1)

        plain, loss = linear_loss(), linear_loss(policy_distance=Scaled())
        assert loss.state_dict().keys() == plain.state_dict().keys()
        assert len(list(loss.parameters())) == len(list(plain.parameters()))
        term = copy.deepcopy(loss).policy_regularizer(linear_batch())["l2c2_policy_distance"]
        assert term.item() == pytest.approx(3.0 * 2.0**2 / 2)

    @pytest.mark.parametrize("distance", ["hellinger", "mean"])
    def test_deterministic_policies_have_their_actions_compared(self, distance):
        """By the same number, under its own name."""
        torch.manual_seed(0)
        base, batch = DDPGLoss(deterministic_actor(), qvalue()), transitions(4)
        batch = NeighborTransform(NEAR)(batch)
        expected = L2C2Loss(base, NEAR).policy_regularizer(batch)
        found = L2C2Loss(base, NEAR, policy_distance=distance).policy_regularizer(batch)
        assert found["l2c2_action_distance"] == expected["l2c2_action_distance"]

    def test_the_mean_squared_error_of_deterministic_policies_is_that_of_their_actions(self):
        """Of four joints a half of half the squared distance."""
        torch.manual_seed(0)
        base = DDPGLoss(Actor(mlp(OBSERVATION, 4)), qvalue())
        batch = NeighborTransform(NEAR)(transitions(4))
        summed = L2C2Loss(base, NEAR).policy_regularizer(batch)
        mean = L2C2Loss(base, NEAR, policy_distance="mse").policy_regularizer(batch)
        torch.testing.assert_close(mean["l2c2_mse"], summed["l2c2_action_distance"] / 2)
        torch.testing.assert_close(mean["loss_l2c2_actor"], summed["loss_l2c2_actor"] / 2)

    @pytest.mark.parametrize("distance", ["kl", lambda p, q: p.mean])
    def test_deterministic_policies_have_no_other(self, distance):
        """The error says what to do."""
        base = DDPGLoss(deterministic_actor(), qvalue())
        with pytest.raises(TypeError, match=r"a deterministic policy.*its default"):
            L2C2Loss(base, policy_distance=distance)

    @pytest.mark.parametrize("given", [{"policy_distance": "mean"}, {"hellinger_samples": 2}])
    def test_a_loss_without_a_policy_compares_none(self, given):
        """What would be read nowhere is refused."""
        base = DQNLoss(action_values(), action_space="one-hot")
        with pytest.raises(TypeError, match="DQNLoss has no policy to compare: leave policy_dist"):
            L2C2Loss(base, **given)

    def test_of_deterministic_policies_nothing_is_drawn(self):
        """Samples would change nothing, and are refused."""
        base = DDPGLoss(deterministic_actor(), qvalue())
        with pytest.raises(TypeError, match=r"nothing is drawn, got hellinger_samples=8"):
            L2C2Loss(base, hellinger_samples=8)

    @pytest.mark.parametrize(
        "distance", [pytest.param(d, marks=pytest.mark.slow) for d in ("mse", "mean", "kl")]
    )
    def test_they_compile_into_one_graph(self, distance):
        """With the eager numbers, squashed policies included."""
        torch.manual_seed(0)
        base = SACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS)
        loss, batch = L2C2Loss(base, NEAR, policy_distance=distance), transitions(4)
        batch = NeighborTransform(NEAR)(batch)
        expected = loss.policy_regularizer(batch)["loss_l2c2_actor"]
        compiled = torch.compile(loss.policy_regularizer, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(batch)["loss_l2c2_actor"], expected)

    @pytest.mark.parametrize("fraction", [pytest.param(1.0, marks=pytest.mark.slow), 0.5])
    def test_with_its_own_neighbors_it_compiles_for_batches_of_any_size(self, fraction):
        """Of a dynamic size; before a release also with one from the second batch on."""
        torch._dynamo.reset()
        base = SACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS)
        loss = L2C2Loss(base, NEAR, policy_distance="mean", fraction=fraction)
        dynamic = True if fraction == 0.5 else None
        compiled = torch.compile(
            loss.policy_regularizer, fullgraph=True, backend="eager", dynamic=dynamic
        )
        for size in (4, 8, 12):
            assert compiled(transitions(size))["loss_l2c2_actor"].isfinite()


class TestConstruction:
    @pytest.mark.parametrize(
        ("settings", "error", "message"),
        [
            ({"neighborhood": 1.0}, TypeError, r"neighborhood must be a Neighborhood, got 1\.0"),
            ({"num_samples": 0}, ValueError, "num_samples must be at least 1"),
            ({"num_samples": 1.5}, TypeError, "num_samples must be an integer"),
            ({"moved_keys": []}, ValueError, "moved_keys must name at least one observation"),
            ({"hellinger_samples": 0}, ValueError, "hellinger_samples must be at least 1"),
            ({"hellinger_samples": "8"}, TypeError, "hellinger_samples must be an integer"),
            (
                {"policy_distance": "w2"},
                ValueError,
                "policy_distance must be 'hellinger' or 'mean'",
            ),
            ({"beta": -0.1}, ValueError, "l2c2_beta must be finite and at least 0, got -0.1"),
            ({"beta": "0.1"}, TypeError, "l2c2_beta must be a real number"),
        ],
    )
    def test_wrong_settings_are_refused(self, settings, error, message):
        """At construction, with what was given and what is allowed."""
        with pytest.raises(error, match=message):
            L2C2Loss(DDPGLoss(deterministic_actor(), qvalue()), **settings)

    def test_a_loss_without_a_trained_value_function_is_pointed_out(self):
        """The dropped term is named, unless beta=0 says that it is not wanted."""
        for base in (
            PPOLoss(gaussian_actor()),
            PPOLoss(gaussian_actor(), critic(), critic_coeff=0),
        ):
            with pytest.warns(UserWarning, match="PPOLoss trains no value function.*Pass beta=0"):
                loss = L2C2Loss(base)
            assert "loss_l2c2_critic" not in loss.out_keys
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                L2C2Loss(base, Neighborhood(lambda_max=2.0), beta=0)
        terms = loss.value_regularizer(on_policy(4))
        assert terms.is_empty()
