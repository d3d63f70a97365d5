from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution
from torch import distributions as d
from torchrl import modules as rl

from torchrl_l2c2 import affinities, register_hellinger, squared_error, squared_hellinger
from torchrl_l2c2.divergences import kl_divergence


@pytest.fixture(autouse=True)
def own_registry_and_seed(monkeypatch):
    """What a test registers or draws stays in it."""
    monkeypatch.setattr(affinities, "_LOG_AFFINITIES", dict(affinities._LOG_AFFINITIES))
    torch.manual_seed(0)


def by_quadrature(p, q, low: float, high: float) -> float:
    """The distance of two one-dimensional policies, straight from its definition."""

    def integrand(action: float) -> float:
        action = torch.tensor(action, dtype=torch.float64)
        log_p, log_q = p.log_prob(action).item(), q.log_prob(action).item()
        return 0.5 * (math.exp(0.5 * log_p) - math.exp(0.5 * log_q)) ** 2

    return integrate.quad(integrand, low, high, epsabs=1e-13, limit=400)[0]


def normal(loc, scale):
    return d.Normal(torch.as_tensor(loc).double(), torch.as_tensor(scale).double())


# Closed forms


@pytest.mark.parametrize(
    ("p", "q", "expected"),
    [
        (d.Normal(0.0, 1.0), d.Normal(2.0, 1.0), 1 - math.exp(-0.5)),
        (d.Normal(0.0, 1.0), d.Normal(0.0, 2.0), 1 - math.sqrt(0.8)),
        (
            d.Categorical(probs=torch.tensor([0.5, 0.5])),
            d.Categorical(probs=torch.tensor([0.9, 0.1])),
            1 - math.sqrt(0.45) - math.sqrt(0.05),
        ),
        (
            d.Bernoulli(probs=torch.tensor(0.5)),
            d.Bernoulli(probs=torch.tensor(0.9)),
            1 - math.sqrt(0.45) - math.sqrt(0.05),
        ),
    ],
)
def test_closed_forms_by_hand(p, q, expected):
    """The closed forms give the numbers worked out by hand."""
    assert squared_hellinger(p, q).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("first", "second"),
    [((0.3, 0.5), (-0.4, 1.7)), ((0.0, 0.1), (0.5, 0.1)), ((1.0, 2.0), (1.1, 2.0))],
)
def test_normal_is_the_integral(first, second):
    """The normal closed form is the integral of the definition."""
    p, q = normal(*first), normal(*second)
    expected = by_quadrature(p, q, -20.0, 20.0)
    assert squared_hellinger(p, q).item() == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    "bounds", [{}, {"low": -2.0, "high": 1.0}, {"tanh_loc": True, "upscale": 0.5}]
)
def test_tanh_normal_is_the_integral(bounds):
    """A squashed normal has the distance the definition gives over its bounded actions."""
    first, second = (torch.tensor([[value]]).double() for value in (0.3, -0.4))
    scales = torch.tensor([[0.5]]).double(), torch.tensor([[0.8]]).double()
    p, q = rl.TanhNormal(first, scales[0], **bounds), rl.TanhNormal(second, scales[1], **bounds)
    scalar = [
        rl.TanhNormal(loc[0, 0], scale[0, 0], event_dims=0, **bounds)
        for loc, scale in zip((first, second), scales, strict=True)
    ]
    low, high = bounds.get("low", -1.0), bounds.get("high", 1.0)
    distance = squared_hellinger(p, q)
    assert distance.shape == (1,)
    assert distance.item() == pytest.approx(by_quadrature(*scalar, low, high), rel=1e-5)


def test_tanh_normals_with_other_bounds_are_sampled():
    """Between different bounds no closed form holds, so the distance is estimated."""
    loc, scale = torch.zeros(4000, 1).double(), torch.full((4000, 1), 0.7).double()
    p, q = rl.TanhNormal(loc, scale), rl.TanhNormal(loc, scale, low=-2.0, high=2.0)
    scalar = [
        rl.TanhNormal(loc[0, 0], scale[0, 0], event_dims=0, low=-bound, high=bound)
        for bound in (1.0, 2.0)
    ]
    inside = by_quadrature(*scalar, -1.0, 1.0)
    beyond = 1 - scalar[1].base_dist.cdf(torch.tensor(math.atanh(0.5))).item()
    expected = inside + beyond  # half of q's mass on either side of p's support
    assert squared_hellinger(p, q).mean().item() == pytest.approx(expected, abs=0.01)
    assert expected > 0.05


def test_independent_sums_its_event():
    """The affinities of independent coordinates multiply, over one or two event dimensions."""
    p, q = d.Normal(torch.zeros(5, 2, 3), 1.0), d.Normal(torch.full((5, 2, 3), 0.5), 1.5)
    affinity = 1 - squared_hellinger(p, q)
    one = squared_hellinger(d.Independent(p, 1), d.Independent(q, 1))
    two = squared_hellinger(d.Independent(p, 2), d.Independent(q, 2))
    torch.testing.assert_close(one, 1 - affinity.prod(-1))
    torch.testing.assert_close(two, 1 - affinity.flatten(1).prod(-1))
    policy = [rl.IndependentNormal(x.loc, x.scale) for x in (p, q)]
    torch.testing.assert_close(squared_hellinger(*policy), one)


def test_batches_broadcast():
    """One policy can be compared with several neighbors at once."""
    p = d.Independent(d.Normal(torch.zeros(5, 1, 2), 1.0), 1)
    q = d.Independent(d.Normal(torch.randn(5, 3, 2), 1.0), 1)
    distance = squared_hellinger(p, q)
    assert distance.shape == (5, 3)
    shift = q.base_dist.loc.square().sum(-1)
    torch.testing.assert_close(distance, 1 - torch.exp(-shift / 8))
    assert squared_hellinger(p, q, num_samples=4).shape == (5, 3)


@pytest.mark.parametrize("samples", [None, 20_000])
def test_batches_of_fewer_dimensions_broadcast(samples):
    """As tensors do, from the right, whichever policy has the fewer; composite ones as well."""
    few = torch.randn(4, 2), torch.ones(4, 2), torch.randn(4, 3)
    many = torch.randn(3, 4, 2), torch.ones(3, 4, 2), torch.randn(3, 4, 3)
    rows = [composite(*row) for row in zip(*many, strict=True)]
    few, many = composite(*few), composite(*many)
    expected = torch.stack([squared_hellinger(few, row) for row in rows])
    for pair in ((few, many), (many, few)):
        found = squared_hellinger(*pair, num_samples=samples)
        torch.testing.assert_close(found, expected, atol=0.03 if samples else 1e-5, rtol=0)


@pytest.mark.parametrize(
    "transforms",
    [
        [d.ExpTransform()],
        [d.AffineTransform(torch.tensor([1.0, 2.0]), -2.0), d.SigmoidTransform()],
        [d.StickBreakingTransform()],
    ],
)
def test_bijections_change_nothing(transforms):
    """A bijection keeps the distance; one over several coordinates makes them one event."""
    bases = d.Normal(torch.zeros(4, 2), 1.0), d.Normal(torch.randn(4, 2), 0.5)
    plain = squared_hellinger(*bases)
    p, q = (d.TransformedDistribution(base, transforms) for base in bases)
    coupled = isinstance(transforms[0], d.StickBreakingTransform)
    expected = 1 - (1 - plain).prod(-1) if coupled else plain
    torch.testing.assert_close(squared_hellinger(p, q), expected)


def test_log_normal_is_the_integral():
    """A transformed distribution of torch itself agrees with its integral."""
    p, q = (
        d.LogNormal(*torch.tensor([0.1, 0.5]).double()),
        d.LogNormal(*torch.tensor([0.4, 0.3]).double()),
    )
    expected = by_quadrature(p, q, 1e-9, 30.0)
    assert squared_hellinger(p, q).item() == pytest.approx(expected, rel=1e-6)


def test_other_bijections_are_sampled():
    """Different bijections of the same base are different policies."""
    loc = torch.zeros(4000).double()
    p, q = (
        d.TransformedDistribution(d.Normal(loc, 1.0), [d.ExpTransform(), d.AffineTransform(0.0, k)])
        for k in (1.0, 3.0)
    )
    expected = squared_hellinger(normal(0.0, 1.0), normal(math.log(3.0), 1.0)).item()
    assert squared_hellinger(p, q).mean().item() == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("kind", [d.Categorical, d.OneHotCategorical, rl.OneHotCategorical])
def test_categorical_kinds_agree(kind):
    """One-hot policies of either library have the distance of their probabilities."""
    logits = torch.randn(2, 6, 4)
    p, q = logits.softmax(-1)
    expected = 1 - (p * q).sqrt().sum(-1)
    torch.testing.assert_close(
        squared_hellinger(kind(logits=logits[0]), kind(logits=logits[1])), expected
    )
    torch.testing.assert_close(squared_hellinger(kind(probs=p), kind(probs=q)), expected)


def test_masked_actions_take_no_part():
    """A masked policy, by mask or by list, is the policy over the actions it allows."""
    logits = torch.randn(2, 6, 4)
    allowed = logits[..., [2, 0]]
    expected = squared_hellinger(*(d.Categorical(logits=x) for x in allowed))
    mask = torch.tensor([True, False, True, False]).expand(6, 4)
    listed = torch.tensor([2, 0, -1]).expand(6, 3)
    for options in ({"mask": mask}, {"indices": listed, "padding_value": -1}):
        p, q = (rl.MaskedCategorical(logits=x, **options) for x in logits)
        torch.testing.assert_close(squared_hellinger(p, q), expected)
    p, q = (rl.MaskedOneHotCategorical(logits=x, mask=mask) for x in logits)
    torch.testing.assert_close(squared_hellinger(p, q), expected)


def test_different_lists_of_actions_are_told_apart():
    """Policies over listed actions are compared by action and not by position in the list."""
    logits = torch.zeros(2)
    p = rl.MaskedCategorical(logits=torch.zeros(4), indices=torch.tensor([0, 1]))
    q = rl.MaskedCategorical(logits=torch.zeros(4), indices=torch.tensor([1, 2]))
    assert logits.shape == p.logits.shape == q.logits.shape
    assert squared_hellinger(p, q).item() == pytest.approx(0.5, abs=1e-6)


def composite(loc, scale, logits):
    params = TensorDict(
        {"move": {"loc": loc, "scale": scale}, "hand": {"grip": {"logits": logits}}}, loc.shape[:-1]
    )
    return CompositeDistribution(params, {"move": d.Normal, ("hand", "grip"): d.Categorical})


def test_composite_multiplies_its_entries():
    """The affinity of a composite policy is the product over its entries and their dimensions."""
    locs, scales, logits = torch.randn(2, 5, 3), torch.rand(2, 5, 3) + 0.5, torch.randn(2, 5, 4)
    p, q = (composite(*args) for args in zip(locs, scales, logits, strict=True))
    moves = squared_hellinger(*(d.Normal(*args) for args in zip(locs, scales, strict=True)))
    grips = squared_hellinger(*(d.Categorical(logits=x) for x in logits))
    expected = 1 - (1 - moves).prod(-1) * (1 - grips)
    torch.testing.assert_close(squared_hellinger(p, q), expected)
    sampled = squared_hellinger(p, q, num_samples=20_000)
    torch.testing.assert_close(sampled, expected, atol=0.02, rtol=0)


def test_composites_of_other_entries_are_refused():
    """Policies composed of different actions cannot be compared."""
    params = TensorDict({"a": {"loc": torch.zeros(2), "scale": torch.ones(2)}}, [2])
    p = CompositeDistribution(params, {"a": d.Normal})
    q = CompositeDistribution(params, {"a": d.Normal}, name_map={"a": "b"})
    with pytest.raises(ValueError, match=r"\['a'\] and \['b'\]"):
        squared_hellinger(p, q)


# Precision, gradients, bounds


@pytest.mark.parametrize("shift", [2.828e-4, 1e-3, 0.1])
@pytest.mark.parametrize("what", ["loc", "scale"])
def test_float32_is_precise_near_zero(shift, what):
    """Distances of about 1e-8 and more are right in float32, where 1 - exp would give 0."""
    loc, scale = torch.tensor([0.7, -1.3]), torch.tensor([0.9, 1.4])
    moved = (loc + shift, scale) if what == "loc" else (loc, scale * (1 + shift))
    distance = squared_hellinger(d.Normal(loc, scale), d.Normal(*moved))
    exact = [x.double() for x in (loc, scale, *moved)]
    # The definition of the affinity itself, in quadruple the digits that are needed.
    m1, s1, m2, s2 = (np.longdouble(x.numpy()) for x in exact)
    spread = s1**2 + s2**2
    affinity = np.sqrt(2 * s1 * s2 / spread) * np.exp(-((m1 - m2) ** 2) / (4 * spread))
    np.testing.assert_allclose(distance.numpy(), (1 - affinity).astype(float), rtol=1e-4)


@pytest.mark.parametrize("shift", [2.828e-4, 1e-2])
def test_discrete_float32_is_precise_near_zero(shift):
    """The discrete closed forms keep their digits near zero, also for policies that are sure."""
    logits = torch.tensor([[0.5, -0.3, 1.1], [8.0, 0.0, 0.0]])
    moved = logits + shift * torch.tensor([1.0, -1.0, 0.5])
    p, q = logits.double().softmax(-1).numpy(), moved.double().softmax(-1).numpy()
    expected = 0.5 * ((np.sqrt(p) - np.sqrt(q)) ** 2).sum(-1)
    distance = squared_hellinger(d.Categorical(logits=logits), d.Categorical(logits=moved))
    np.testing.assert_allclose(distance[:1].numpy(), expected[:1], rtol=2e-3)
    np.testing.assert_allclose(distance.numpy(), expected, rtol=2e-3, atol=1e-11)
    sure = torch.tensor([9.0, -9.0])
    p, q = (torch.sigmoid(x.double()).numpy() for x in (sure, sure + 0.1))
    complement = [torch.sigmoid(-x.double()).numpy() for x in (sure, sure + 0.1)]
    expected = 0.5 * (
        (np.sqrt(p) - np.sqrt(q)) ** 2 + (np.sqrt(complement[0]) - np.sqrt(complement[1])) ** 2
    )
    distance = squared_hellinger(d.Bernoulli(logits=sure), d.Bernoulli(logits=sure + 0.1))
    np.testing.assert_allclose(distance.numpy(), expected, rtol=1e-3)


PARAMETRIC = {
    "normal": lambda x: d.Normal(x, x.exp()),
    "independent": lambda x: d.Independent(d.Normal(x, x.exp()), 1),
    "tanh_normal": lambda x: rl.TanhNormal(x, x.exp()),
    "categorical": lambda x: d.Categorical(logits=x),
    "categorical_probs": lambda x: d.Categorical(probs=x.softmax(-1)),
    "bernoulli": lambda x: d.Bernoulli(logits=x),
}


@pytest.mark.parametrize("policy", PARAMETRIC.values(), ids=PARAMETRIC)
def test_zero_with_zero_gradient_at_equality(policy):
    """Equal policies have distance 0, and the smallest distance has a zero gradient."""
    x = torch.tensor([[0.2, -0.7, 1.1]], requires_grad=True)
    y = x.detach().clone().requires_grad_()
    distance = squared_hellinger(policy(x), policy(y))
    assert (distance == 0).all()
    for gradient in torch.autograd.grad(distance.sum(), (x, y)):
        assert (gradient == 0).all()


@pytest.mark.parametrize("policy", PARAMETRIC.values(), ids=PARAMETRIC)
def test_gradient_is_that_of_the_function(policy):
    """The gradient towards both policies agrees with finite differences."""
    x, y = torch.randn(2, 1, 3, dtype=torch.float64).unbind(0)
    torch.autograd.gradcheck(
        lambda x, y: squared_hellinger(policy(x), policy(y)),
        (x.requires_grad_(), y.requires_grad_()),
    )


@pytest.mark.parametrize(
    ("locs", "scales"),
    [
        ((0.0, 1e4), (1e-3, 1e-3)),
        ((0.0, 1e25), (1.0, 1.0)),
        ((0.0, 0.0), (1e-10, 1e5)),
        ((0.0, 1.0), (1e-15, 1e-15)),
    ],
)
def test_far_policies_have_distance_one(locs, scales):
    """Where the affinity underflows the distance is 1 and its gradient finite."""
    parameters = [torch.tensor(x, requires_grad=True) for x in (*locs, *scales)]
    p, q = d.Normal(parameters[0], parameters[2]), d.Normal(parameters[1], parameters[3])
    distance = squared_hellinger(p, q)
    assert distance.item() == pytest.approx(1.0, abs=1e-6)
    for gradient in torch.autograd.grad(distance, parameters):
        assert gradient.isfinite()


@pytest.mark.parametrize("excluded", [-math.inf, -1e9])
def test_excluded_actions_have_finite_gradients(excluded):
    """Actions of probability zero, shared or not, leave the gradient finite and useful."""
    logits = torch.zeros(2, 3, 3)
    logits[:, :, 0] = excluded  # excluded for both
    logits[0, 1, 1] = excluded  # excluded for one
    logits[0, 2, 1] = logits[1, 2, 2] = excluded  # disjoint
    logits[1, 0, 1] = 1.0
    x = logits.requires_grad_()
    distance = squared_hellinger(d.Categorical(logits=x[0]), d.Categorical(logits=x[1]))
    p, q = x.detach().double().softmax(-1)
    torch.testing.assert_close(
        distance.detach().double(), 1 - (p * q).sqrt().sum(-1), atol=1e-6, rtol=0
    )
    (gradient,) = torch.autograd.grad(distance.sum(), x)
    assert gradient.isfinite().all()
    assert gradient[:, 0, 1:].abs().min() > 1e-3


@settings(max_examples=60, deadline=None)
@given(values=st.lists(st.floats(-8, 8, width=32), min_size=6, max_size=6))
@pytest.mark.parametrize("policy", PARAMETRIC.values(), ids=PARAMETRIC)
def test_symmetric_and_bounded(policy, values):
    """Whatever the policies, the distance lies in [0, 1] and does not depend on their order."""
    x, y = torch.tensor(values).reshape(2, 1, 3)
    forth, back = squared_hellinger(policy(x), policy(y)), squared_hellinger(policy(y), policy(x))
    torch.testing.assert_close(forth, back, rtol=1e-5, atol=1e-7)
    assert ((forth >= 0) & (forth <= 1)).all()


# The registry


def test_registered_function_serves_subclasses_and_both_orders():
    """A registered closed form is found for subclasses and for either order of the pair."""

    class Noisy(d.Laplace):
        pass

    @register_hellinger(d.Laplace, d.Normal)
    def laplace_normal(p, q):
        return p.loc - q.loc

    p, q = Noisy(torch.tensor(-1.0), 1.0), d.Normal(torch.tensor(1.0), 1.0)
    for pair in ((p, q), (q, p)):
        assert squared_hellinger(*pair).item() == pytest.approx(1 - math.exp(-2), rel=1e-6)
    assert laplace_normal(p, q).item() == -2.0


def test_most_specific_registration_wins():
    """A subclass's own closed form comes before its parent's."""

    class Sharp(d.Normal):
        pass

    register_hellinger(Sharp)(lambda p, q: torch.tensor(math.log(0.25)))
    p = Sharp(torch.tensor(0.0), 1.0)
    assert squared_hellinger(p, p).item() == pytest.approx(0.75)
    assert squared_hellinger(p, d.Normal(torch.tensor(0.0), 1.0)).item() == 0.0


def test_a_closed_form_has_one_number_for_each_pair():
    """Not one for each dimension of the action, of which the mean would be taken."""
    register_hellinger(d.Gumbel)(lambda p, q: (p.loc - q.loc).square().sum(-1).neg())
    p = d.Gumbel(torch.zeros(4), 1.0)
    with pytest.raises(ValueError, match=r"shape \(4,\), got \(\): sum over the action's"):
        squared_hellinger(p, p)


def test_only_distributions_can_be_registered():
    """Registering something else says what it takes."""
    with pytest.raises(TypeError, match=r"subclasses of .*Distribution, got 3"):
        register_hellinger(3)


# Monte Carlo


@pytest.mark.parametrize("policy", PARAMETRIC.values(), ids=PARAMETRIC)
def test_estimate_and_its_gradient_are_unbiased(policy):
    """The mean of many estimates is the closed form's value, and that of their gradients its."""
    values = torch.tensor([[0.4, -0.3, 0.6], [-0.2, 0.5, 0.1]], dtype=torch.float64)
    values = values[:, None]
    repeats = 4000
    x = values.expand(2, repeats, 3).clone().requires_grad_()
    estimates = squared_hellinger(policy(x[0]), policy(x[1]), num_samples=3)
    estimates = estimates.reshape(repeats, -1)
    (gradients,) = torch.autograd.grad(estimates.sum(), x)
    y = values.clone().requires_grad_()
    exact = squared_hellinger(policy(y[0]), policy(y[1]))
    (exact_gradient,) = torch.autograd.grad(exact.sum(), y)
    for sampled, expected in (
        (estimates, exact.flatten()),
        (gradients.transpose(0, 1).reshape(repeats, -1), exact_gradient.flatten()),
    ):
        error = sampled.std(0) / repeats**0.5
        assert ((sampled.mean(0) - expected).abs() < 4.5 * error + 1e-9).all()
        assert (error < 0.02).all()


def test_estimate_is_bounded():
    """No estimate leaves [0, 1] but by rounding, however far the policies are from each other."""
    for shift, scale in ((0.1, 1.0), (3.0, 0.1), (50.0, 1e-3)):
        p = d.Normal(torch.zeros(2000), 1.0)
        q = d.Normal(torch.full((2000,), shift), scale)
        estimate = squared_hellinger(p, q, num_samples=1)
        assert ((estimate >= 0) & (estimate <= 1 + 1e-6)).all()
    assert estimate.mean() > 0.99


def test_more_samples_give_less_noise():
    """The estimate's standard deviation falls with the square root of the samples."""
    p, q = d.Normal(torch.zeros(4000), 1.0), d.Normal(torch.ones(4000), 1.0)
    few, many = (squared_hellinger(p, q, num_samples=n).std() for n in (2, 32))
    assert (few / many).item() == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize(
    ("kind", "parameters", "low", "high"),
    [
        (d.Laplace, ((0.0, 1.0), (1.5, 0.5)), -30.0, 30.0),
        (d.Beta, ((2.0, 3.0), (4.0, 1.5)), 0.0, 1.0),
        (d.HalfNormal, ((1.0,), (3.0,)), 0.0, 30.0),
    ],
)
def test_unregistered_policies_are_sampled(kind, parameters, low, high):
    """Without a closed form, or with a transform that is not bijective, the distance is sampled."""
    p, q = (kind(*torch.tensor(x).double()[:, None].expand(-1, 4000)) for x in parameters)
    expected = by_quadrature(*(kind(*torch.tensor(x).double()) for x in parameters), low, high)
    estimate = squared_hellinger(p, q)
    assert estimate.std() > 1e-3
    assert estimate.mean().item() == pytest.approx(expected, abs=0.005)


def test_truncated_normal_is_sampled():
    """TorchRL's truncated normal has no closed form here and agrees with its integral."""
    p, q = (
        rl.TruncatedNormal(torch.full((4000, 1), loc), torch.full((4000, 1), 0.5))
        for loc in (-0.5, 0.5)
    )

    def density(x, loc):
        return np.exp(-((x - loc) ** 2) / 0.5)

    def integral(function):
        return integrate.quad(function, -1, 1)[0]

    mass = integral(lambda x: density(x, 0.5))
    affinity = integral(lambda x: math.sqrt(density(x, 0.5) * density(x, -0.5))) / mass
    assert squared_hellinger(p, q).mean().item() == pytest.approx(1 - affinity, abs=0.005)


def test_composite_with_an_unregistered_entry_is_sampled():
    """One entry without a closed form makes the whole composite an estimate."""
    params = TensorDict(
        {x: {"loc": torch.zeros(4000), "scale": torch.ones(4000)} for x in "ab"}, [4000]
    )
    p = CompositeDistribution(params, {"a": d.Normal, "b": d.Laplace})
    q = CompositeDistribution(params + 1.0, {"a": d.Normal, "b": d.Laplace})
    parts = [
        by_quadrature(
            kind(*torch.tensor([0.0, 1.0]).double()),
            kind(*torch.tensor([1.0, 2.0]).double()),
            -40,
            40,
        )
        for kind in (d.Normal, d.Laplace)
    ]
    expected = 1 - (1 - parts[0]) * (1 - parts[1])
    assert squared_hellinger(p, q).mean().item() == pytest.approx(expected, abs=0.01)


def test_replayed_action_by_hand():
    """With a replayed action the distance is half the squared difference of the root ratios."""
    p, q = normal([0.0], 1.0), normal([1.0], 1.0)
    log_b = torch.tensor([math.log(0.5)]).double().requires_grad_()
    distance = squared_hellinger(p, q, sample=torch.zeros(1), sample_log_prob=log_b)
    phi = [math.exp(-0.5 * x**2) / math.sqrt(2 * math.pi) for x in (0.0, 1.0)]
    expected = 0.5 * (math.sqrt(phi[0] / 0.5) - math.sqrt(phi[1] / 0.5)) ** 2
    assert distance.item() == pytest.approx(expected, rel=1e-6)
    assert not distance.requires_grad


def test_replayed_action_is_unbiased():
    """Averaged over actions of the behavior policy it is the closed form."""
    p, q, b = (rl.TanhNormal(torch.full((100_000, 2), loc), 0.8) for loc in (0.1, 0.3, 0.2))
    action = b.sample()
    distance = squared_hellinger(p, q, sample=action, sample_log_prob=b.log_prob(action))
    expected = squared_hellinger(p, q)[0].item()
    assert distance.mean().item() == pytest.approx(expected, rel=0.05)
    assert distance.std() > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sample": torch.zeros(2)}, "belong together"),
        ({"sample_log_prob": torch.zeros(2)}, "belong together"),
        (
            {"sample": torch.zeros(2), "sample_log_prob": torch.zeros(2), "num_samples": 2},
            "not both",
        ),
        ({"sample": torch.zeros(2), "sample_log_prob": torch.zeros(2, 1)}, r"\(2,\), got \(2, 1\)"),
        ({"num_samples": 0}, "at least 1, got 0"),
    ],
)
def test_contradicting_arguments_are_refused(arguments, message):
    """Arguments that do not fit together are refused with the reason."""
    p = d.Normal(torch.zeros(2), 1.0)
    with pytest.raises(ValueError, match=message):
        squared_hellinger(p, p, **arguments)


@pytest.mark.parametrize("arguments", [{}, {"num_samples": 2}])
@pytest.mark.parametrize("kind", [rl.Delta, rl.TanhDelta])
def test_deterministic_policies_are_sent_to_squared_error(kind, arguments):
    """A deterministic policy has no Hellinger distance, and the error says what to use."""
    p = kind(torch.zeros(3, 2))
    with pytest.raises(TypeError, match="squared_error"):
        squared_hellinger(p, p, **arguments)


def test_deterministic_entries_are_refused():
    """A composite policy with a deterministic entry has no Hellinger distance either."""
    params = TensorDict({"a": {"loc": torch.zeros(2), "scale": torch.ones(2)}}, [2])
    params["b"] = TensorDict({"param": torch.zeros(2, 1)}, [2])
    p = CompositeDistribution(params, {"a": d.Normal, "b": rl.Delta})
    with pytest.raises(TypeError, match="Delta has no density"):
        squared_hellinger(p, p)


def test_what_cannot_be_sampled_is_refused():
    """A distribution with neither closed form nor samples names the way out."""

    class Silent(d.Distribution):
        arg_constraints = {}  # noqa: RUF012

    p = Silent(torch.Size([2]), validate_args=False)
    with pytest.raises(TypeError, match=r"Silent and Silent .* register_hellinger"):
        squared_hellinger(p, p)


def test_other_actions_are_refused():
    """Policies over different actions are not broadcast against each other."""
    p = d.Normal(torch.zeros(4, 3), 1.0)
    with pytest.raises(ValueError, match=r"\(\) and \(3,\)"):
        squared_hellinger(p, d.Independent(p, 1))


@pytest.mark.parametrize("distance", [squared_hellinger, kl_divergence])
@pytest.mark.parametrize(
    ("p", "q", "error", "message"),
    [
        (
            d.Normal(torch.zeros(3), 1.0),
            d.Normal(torch.zeros(2), 1.0),
            ValueError,
            r"batch shapes that broadcast, got \(3,\) and \(2,\)",
        ),
        (
            d.Normal(torch.zeros(4), 1.0),
            d.Categorical(torch.ones(4, 3)),
            ValueError,
            "got Normal of no labels and Categorical of 3 labels",
        ),
        (
            d.Categorical(torch.ones(3)),
            d.Categorical(torch.ones(2)),
            ValueError,
            "Categorical of 3 labels and Categorical of 2 labels",
        ),
        (torch.zeros(3), torch.zeros(3), TypeError, "must be distributions, got Tensor"),
    ],
    ids=["batches", "kinds", "labels", "actions"],
)
def test_pairs_that_do_not_fit_are_refused(distance, p, q, error, message):
    """With both of them."""
    with pytest.raises(error, match=message):
        distance(p, q)


def test_samples_of_masked_policies_are_refused():
    """They score no batch of draws; the closed form they have."""
    logits, mask = torch.zeros(2, 3), torch.tensor([True, False, True])
    p = rl.MaskedCategorical(logits=logits, mask=mask.expand(2, 3))
    with pytest.raises(TypeError, match="leave num_samples, or hellinger_samples, at None"):
        squared_hellinger(p, p, num_samples=4)
    assert squared_hellinger(p, p).tolist() == [0.0, 0.0]


# Values


def test_squared_error_by_hand():
    """Half the squared error sums over the heads and broadcasts over neighbors."""
    a = torch.tensor([[[1.0, 2.0]], [[0.0, 0.0]]])
    b = torch.tensor([[[0.0, 4.0], [1.0, 2.0]], [[3.0, 4.0], [0.0, 1.0]]])
    torch.testing.assert_close(squared_error(a, b), torch.tensor([[2.5, 0.0], [12.5, 0.5]]))


@pytest.mark.parametrize("shape", [(4,), (4, 2), (1, 4, 1)])
def test_squared_error_refuses_other_shapes(shape):
    """Shapes that would broadcast into wrong pairs are refused with both of them."""
    with pytest.raises(ValueError, match=r"\(4, 1\)"):
        squared_error(torch.zeros(4, 1), torch.zeros(shape))


# Compiled


@pytest.mark.parametrize("distance_of", [squared_hellinger, kl_divergence])
@pytest.mark.parametrize("name", ["normal", "independent", "tanh_normal", "categorical"])
def test_compiles_without_a_break(name, distance_of, monkeypatch):
    """Policies built and compared inside one compiled graph give the eager distance."""
    policy = PARAMETRIC[name]
    # As in a new process, in which torch has not yet looked up the formula of any pair.
    monkeypatch.setattr("torch.distributions.kl._KL_MEMOIZE", {})

    def distance(x, y):
        return distance_of(policy(x), policy(y))

    x, y = torch.randn(2, 4, 3).requires_grad_().unbind(0)
    compiled = torch.compile(distance, fullgraph=True, backend="aot_eager")
    torch.testing.assert_close(compiled(x, y), distance(x, y))
    gradients = [torch.autograd.grad(f(x, y).sum(), (x, y)) for f in (compiled, distance)]
    torch.testing.assert_close(*gradients)


def test_compiled_tanh_normals_with_other_bounds_are_nan():
    """Where bounds cannot be compared ahead, different ones do not pass for equal."""

    def distance(x, high):
        return squared_hellinger(rl.TanhNormal(x, 1.0), rl.TanhNormal(x, 1.0, high=high))

    compiled = torch.compile(distance, fullgraph=True, backend="aot_eager")
    assert (compiled(torch.zeros(4, 3), torch.tensor(1.0)) == 0).all()
    assert compiled(torch.zeros(4, 3), torch.tensor(2.0)).isnan().all()
