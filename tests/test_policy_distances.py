"""The distance of means and the KL divergence, against hand-computed numbers and integrals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from losses import composite_actor, transitions
from scipy import integrate
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution
from torch import distributions as d
from torchrl import modules as rl

from torchrl_l2c2 import make_actor, squared_hellinger
from torchrl_l2c2.divergences import kl_divergence
from torchrl_l2c2.policy_distances import (
    choose_policy_distance,
    mean_distance,
    mean_squared_error,
    policy_mean,
)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def test_numpys_number_of_samples_compiles():
    """As Python's does."""
    distance = choose_policy_distance("hellinger", np.int64(3))
    compiled = torch.compile(distance, fullgraph=True, backend="eager")
    policy = d.Normal(torch.zeros(4), 1.0)
    assert compiled(policy, policy).equal(torch.zeros(4))


LOC = torch.tensor([[0.5, -3.0], [1.0, 2.0]])
KINDS = {
    "independent": lambda loc: d.Independent(d.Normal(loc, 0.7), 1),
    "independent_normal": lambda loc: rl.IndependentNormal(loc, torch.full_like(loc, 0.7)),
    "tanh_normal": lambda loc: rl.TanhNormal(loc, torch.full_like(loc, 0.7), low=-2.0, high=4.0),
    "truncated_normal": lambda loc: rl.TruncatedNormal(loc, torch.full_like(loc, 0.7)),
    "transformed": lambda loc: d.TransformedDistribution(
        d.Independent(d.Normal(loc, 0.7), 1), [d.TanhTransform(), d.AffineTransform(1.0, 2.0)]
    ),
}


class TestMeanDistance:
    @pytest.mark.parametrize("kind", KINDS)
    def test_it_is_that_of_the_normals_before_they_are_squashed_or_truncated(self, kind):
        """1/2 (1^2 + 0^2) and 1/2 (0^2 + 2^2), wherever the squashing saturates."""
        moved = LOC + torch.tensor([[1.0, 0.0], [0.0, -2.0]])
        found = mean_distance(KINDS[kind](LOC), KINDS[kind](moved))
        torch.testing.assert_close(found, torch.tensor([0.5, 2.0]))

    def test_the_papers_own_policy_is_compared_before_its_squashing(self):
        """That of make_actor, whose body is of Squish."""
        actor, batch = make_actor(3, 2, hidden=(8,)), transitions(4)
        p, q = (actor.get_dist(td) for td in (batch.clone(), batch["next"].clone()))
        here, there = (actor.get_dist_params(td)["loc"] for td in (batch, batch["next"]))
        torch.testing.assert_close(mean_distance(p, q), 0.5 * (here - there).square().sum(-1))

    def test_a_normal_without_a_dimension_of_its_own_is_one_number(self):
        """As torch counts it, and by every distance alike."""
        p, q = d.Normal(torch.zeros(2, 3), 1.0), d.Normal(torch.ones(2, 3), 1.0)
        torch.testing.assert_close(mean_distance(p, q), torch.full((2, 3), 0.5))
        assert squared_hellinger(p, q).shape == kl_divergence(p, q).shape == (2, 3)

    def test_actions_that_a_mask_lists_are_compared_by_their_numbers(self):
        """In whatever order each lists them."""
        listed, logits = torch.tensor([[0, 2, 3]]), torch.tensor([[1.0, 0.0, -1.0, 2.0]])
        p = rl.MaskedCategorical(logits=logits, indices=listed)
        q = rl.MaskedCategorical(logits=logits, indices=listed.flip(1))
        moved = rl.MaskedCategorical(logits=2 * logits, indices=listed.flip(1))
        dense = [
            rl.MaskedCategorical(logits=k * logits, mask=torch.tensor([[True, False, True, True]]))
            for k in (1, 2)
        ]
        for distance in (mean_distance, kl_divergence, squared_hellinger):
            assert distance(p, q).item() == pytest.approx(0.0, abs=1e-6)
            torch.testing.assert_close(distance(p, moved), distance(*dense))

    def test_of_discrete_policies_the_probabilities_are_compared(self):
        """(.5, .5) and (.9, .1): 1/2 (.16 + .16)."""
        for kind in (d.Categorical, d.OneHotCategorical, rl.OneHotCategorical):
            p, q = (kind(probs=torch.tensor([[x, 1 - x]])) for x in (0.5, 0.9))
            torch.testing.assert_close(mean_distance(p, q), torch.tensor([0.16]))

    def test_several_discrete_actions_are_one_vector(self):
        """Two choices of two: (.5, .5) and (.9, .1) twice."""
        p, q = (
            d.Independent(d.Categorical(probs=torch.tensor([[[x, 1 - x]] * 2])), 1)
            for x in (0.5, 0.9)
        )
        torch.testing.assert_close(mean_distance(p, q), torch.tensor([0.32]))

    @pytest.mark.parametrize(
        "matrix",
        [
            lambda loc: rl.IndependentNormal(loc, torch.ones_like(loc), event_dim=2),
            lambda loc: rl.TanhNormal(loc, torch.ones_like(loc), event_dims=2),
            lambda loc: d.Independent(d.Normal(loc, 1.0), 2),
        ],
    )
    def test_a_matrix_of_actions_is_one_vector(self, matrix):
        """Such as a chunk of three actions of two numbers, however it is told: 1/2 * 6."""
        p, q = (matrix(torch.full((4, 3, 2), x)) for x in (0.0, 1.0))
        torch.testing.assert_close(mean_distance(p, q), torch.full((4,), 3.0))

    def test_torchs_own_squashed_normals_are_compared_before_it(self):
        """Wrapped as a whole, where torch has no mean: 1/2 (1^2 + 1^2); and 0 of the actions'."""
        p, q = (
            d.Independent(d.TransformedDistribution(d.Normal(LOC + x, 1.0), [d.TanhTransform()]), 1)
            for x in (0.0, 1.0)
        )
        torch.testing.assert_close(mean_distance(p, q), torch.tensor([1.0, 1.0]))
        with pytest.raises(NotImplementedError, match="has no mean: choose another"):
            policy_mean(p, squashed=True)

    def test_the_heads_of_a_composite_policy_are_one_vector(self):
        """Their squared distances add up, also those of heads without a dimension of their own."""
        params = TensorDict(
            {
                "wide": {"loc": torch.zeros(4, 2), "scale": torch.ones(4, 2)},
                "thin": {"loc": torch.zeros(4), "scale": torch.ones(4)},
            },
            [4],
        )
        kinds = {"wide": rl.TanhNormal, "thin": d.Normal}
        p, q = (CompositeDistribution(params + x, kinds) for x in (0.0, 1.0))
        torch.testing.assert_close(mean_distance(p, q), torch.full((4,), 1.5))

    def test_labels_are_no_mean(self):
        """Of a class of one's own for several discrete actions: they would have no gradient."""

        class Labels(d.Independent):
            @property
            def deterministic_sample(self):
                return self.base_dist.logits.argmax(-1)

        class Pair(d.Distribution):
            deterministic_sample = torch.zeros(2, dtype=torch.long)

        choices = d.Categorical(logits=torch.randn(4, 2, 3))
        torch.testing.assert_close(policy_mean(Labels(choices, 1)), choices.probs.flatten(1))
        with pytest.raises(NotImplementedError, match=r"Pair has no mean: .* in a Composite"):
            policy_mean(Pair(event_shape=torch.Size([2]), validate_args=False))

    def test_actions_are_their_own_mean(self):
        """A deterministic policy."""
        assert policy_mean(LOC) is LOC

    def test_the_scale_does_not_count(self):
        """A wide policy is as far away as a narrow one."""
        p, q = (rl.TanhNormal(LOC, torch.full_like(LOC, scale)) for scale in (0.1, 5.0))
        assert mean_distance(p, q).tolist() == [0.0, 0.0]


class TestMeanSquaredError:
    @pytest.mark.parametrize("kind", KINDS)
    def test_it_is_a_mean_over_the_actions_dimensions(self, kind):
        """(1^2 + 0^2) / 2 and (0^2 + 2^2) / 2."""
        moved = LOC + torch.tensor([[1.0, 0.0], [0.0, -2.0]])
        found = mean_squared_error(KINDS[kind](LOC), KINDS[kind](moved))
        torch.testing.assert_close(found, torch.tensor([0.5, 2.0]))

    @pytest.mark.parametrize("dims", [1, 2, 7])
    def test_more_joints_that_move_alike_do_not_make_it_larger(self, dims):
        """As torch's own counts it, of policies and of actions."""
        here, there = torch.zeros(3, dims), torch.full((3, dims), 0.5)
        expected = torch.nn.functional.mse_loss(here, there).expand(3)
        p, q = (rl.TanhNormal(loc, torch.ones_like(loc)) for loc in (here, there))
        torch.testing.assert_close(mean_squared_error(p, q), expected)
        torch.testing.assert_close(mean_squared_error(here, there), expected)


def kl_by_quadrature(p: d.Distribution, q: d.Distribution, low: float, high: float) -> float:
    def integrand(action: float) -> float:
        log_p, log_q = (x.log_prob(torch.tensor([[action]])).item() for x in (p, q))
        return math.exp(log_p) * (log_p - log_q)

    return integrate.quad(integrand, low, high, epsabs=1e-6, limit=400)[0]


class TestKLDivergence:
    def test_of_two_normals(self):
        """ln(t/s) + (s^2 + m^2) / (2 t^2) - 1/2, from the one at s to the one at s~."""
        p, q = d.Normal(torch.tensor([0.0]), 1.0), d.Normal(torch.tensor([3.0]), 2.0)
        near = kl_divergence(d.Normal(torch.tensor(1e-4), 1.0), d.Normal(torch.tensor(0.0), 1.0))
        assert near.item() == pytest.approx(5e-9)
        expected = math.log(2.0) + (1 + 9) / 8 - 0.5
        assert kl_divergence(p, q).item() == pytest.approx(expected)
        backward = math.log(0.5) + (4 + 9) / 2 - 0.5
        assert kl_divergence(q, p).item() == pytest.approx(backward)

    def test_what_one_never_does_and_the_other_does_is_infinitely_far(self):
        """As torch has it, also of probabilities that were given as 0."""
        often, never = d.Categorical(probs=torch.full((2,), 0.5)), torch.tensor([1.0, 0.0])
        assert kl_divergence(often, d.Categorical(probs=never)) == math.inf
        assert kl_divergence(d.Categorical(probs=never), often).item() == pytest.approx(math.log(2))

    def test_squashing_changes_nothing(self):
        """Two TanhNormals of the same bounds have the divergence of their normals, compiled too."""
        scales = torch.tensor([[0.5, 1.0], [2.0, 1.0]])

        def divergence(loc, scale):
            return kl_divergence(
                rl.TanhNormal(loc, scale, low=-3.0, high=1.0),
                rl.TanhNormal(loc + 1.0, 2 * scale, low=-3.0, high=1.0),
            )

        normals = d.Normal(LOC, scales), d.Normal(LOC + 1.0, 2 * scales)
        expected = d.kl_divergence(*normals).sum(-1)
        torch.testing.assert_close(divergence(LOC, scales), expected)
        compiled = torch.compile(divergence, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(LOC, scales), expected)

    def test_heads_add_up(self):
        """Of a squashed normal and a categorical one."""
        actor, batch = composite_actor(), transitions(4)
        p, q = (actor.get_dist(td) for td in (batch.clone(), batch["next"].clone()))
        parts = [
            d.kl_divergence(p.dists["move"].base_dist, q.dists["move"].base_dist),
            d.kl_divergence(p.dists["pick"], q.dists["pick"]),
        ]
        torch.testing.assert_close(kl_divergence(p, q), sum(parts))

    @pytest.mark.parametrize("kind", ["masked", "masked one-hot", "logits", "independent"])
    def test_impossible_actions_have_no_part_in_the_value_or_the_gradient(self, kind):
        """That of the two that are possible: .5 ln(.5/.25) + .5 ln(.5/.75), by hand."""
        mask = torch.tensor([[True, True, False]])

        def policy(logits):
            if kind.startswith("masked"):
                kinds = {
                    "masked": rl.MaskedCategorical,
                    "masked one-hot": rl.MaskedOneHotCategorical,
                }
                return kinds[kind](logits=logits, mask=mask)
            discrete = d.Categorical(logits=logits.masked_fill(~mask, -math.inf))
            return discrete if kind == "logits" else d.Independent(discrete, 1)

        even = torch.zeros(1, 3, requires_grad=True)
        skewed = torch.tensor([[0.0, math.log(3.0), 5.0]], requires_grad=True)
        found = kl_divergence(policy(even), policy(skewed)).sum()
        assert found.item() == pytest.approx(0.5 * math.log(2.0) + 0.5 * math.log(2 / 3))
        found.backward()
        # Of q's logits, its probabilities minus p's.
        torch.testing.assert_close(skewed.grad, torch.tensor([[0.25 - 0.5, 0.75 - 0.5, 0.0]]))
        assert even.grad.isfinite().all() and even.grad[0, 2] == 0

    def test_composites_of_other_batch_shapes_broadcast(self):
        """One policy of a batch beside three; the closed form and the estimate."""
        p, q = (
            CompositeDistribution(
                TensorDict({"a": {"loc": loc, "scale": torch.ones_like(loc)}}, loc.shape[:-1]),
                {"a": rl.IndependentNormal},
            )
            for loc in (torch.randn(4, 2), torch.randn(3, 4, 2))
        )
        expected = kl_divergence(p.dists["a"], q.dists["a"])
        assert expected.shape == (3, 4)
        torch.testing.assert_close(kl_divergence(p, q), expected)
        torch.testing.assert_close(kl_divergence(q, p), expected)

    @pytest.fixture
    def truncated(self):
        """Two policies without a closed form, as many times as there are to be estimates."""

        def make(count: int, shift: torch.Tensor | float = 0.4):
            loc = torch.zeros(count, 1)
            return (
                rl.TruncatedNormal(loc, torch.full_like(loc, 0.5)),
                rl.TruncatedNormal(loc + shift, torch.full_like(loc, 0.6)),
            )

        return make

    def test_without_a_closed_form_it_is_estimated_without_a_bias(self, truncated):
        """No estimate is negative, and their mean is the integral."""
        found = kl_divergence(*truncated(20_000))
        assert found.min() >= 0 and found.std() > 0.01
        expected = kl_by_quadrature(*truncated(1), -1.0, 1.0)
        assert found.mean().item() == pytest.approx(expected, rel=0.02)

    @pytest.mark.parametrize("which", [0, 1])
    def test_the_gradient_of_the_estimate_is_unbiased(self, which):
        """Into the policy that is sampled, and into the other."""
        loc = [torch.tensor(0.0, requires_grad=True), torch.tensor(0.5, requires_grad=True)]
        batch = torch.ones(200_000)
        p, q = (rl.TruncatedNormal((x * batch)[:, None], 0.5 * batch[:, None]) for x in loc)
        kl_divergence(p, q, num_samples=4).mean().backward()

        def at(shift: float) -> float:
            values = [0.0, 0.5]
            values[which] += shift
            pair = (rl.TruncatedNormal(torch.tensor([[x]]), torch.tensor([[0.5]])) for x in values)
            return kl_by_quadrature(*pair, -1.0, 1.0)

        slope = (at(0.02) - at(-0.02)) / 0.04
        assert loc[which].grad.item() == pytest.approx(slope, rel=0.05)

    def test_deterministic_policies_are_refused(self):
        """The error says what to use."""
        p = rl.Delta(torch.zeros(3, 2))
        with pytest.raises(TypeError, match=r"no density.*squared_error"):
            kl_divergence(p, p)

    def test_what_cannot_be_sampled_is_refused(self):
        """With the way out."""

        class Silent(d.Distribution):
            arg_constraints = {}  # noqa: RUF012

        p = Silent(torch.Size([2]), validate_args=False)
        with pytest.raises(TypeError, match="a function of your own"):
            kl_divergence(p, p)


class TestChoice:
    @pytest.mark.parametrize(
        ("chosen", "samples", "error", "message"),
        [
            (
                "wasserstein",
                None,
                ValueError,
                "'hellinger' or 'mean' or 'mse' or 'kl', got 'wasserstein'. Or",
            ),
            (2.0, None, TypeError, "policy_distance must be .* Or give a function"),
            ("kl", 4, ValueError, "hellinger_samples is only for policy_distance='hellinger'"),
            ("hellinger", 0, ValueError, "hellinger_samples must be at least 1"),
        ],
    )
    def test_others_are_refused(self, chosen, samples, error, message):
        """With what there is."""
        with pytest.raises(error, match=message):
            choose_policy_distance(chosen, samples)

    def test_a_function_must_return_one_number_a_pair(self):
        """One number for each coordinate of the action would be averaged in silence."""
        p = d.Independent(d.Normal(torch.zeros(4, 2), 1.0), 1)
        distance = choose_policy_distance(lambda p, q: (p.mean - q.mean).abs())
        with pytest.raises(ValueError, match=r"shape \(4,\), got \(4, 2\)"):
            distance(p, p)
        with pytest.raises(TypeError, match=r"must return a tensor, got 1.0\."):
            choose_policy_distance(lambda p, q: 1.0)(p, p)
