"""Properties that hold for every setting, shape and state: found out with Hypothesis."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Categorical, Normal
from torchrl.modules import IndependentNormal, TanhNormal

from torchrl_l2c2 import Neighborhood, squared_error, squared_hellinger

settings.register_profile("suite", max_examples=60, deadline=None, derandomize=True)
settings.load_profile("suite")


@st.composite
def neighborhoods(draw):
    """Any valid sigma and gain bounds, over many orders of magnitude."""
    sigma = 10.0 ** draw(st.floats(-2, 2))
    lambda_min = 10.0 ** draw(st.floats(-6, 2))
    factor = 1.0 + 10.0 ** draw(st.floats(-2, 4))
    return Neighborhood(sigma, lambda_min, max(1.0, sigma) * lambda_min * factor)


shapes = st.tuples(
    st.lists(st.integers(1, 4), min_size=1, max_size=2),
    st.lists(st.integers(1, 5), min_size=1, max_size=3),
    st.integers(1, 3),
)
dtypes = st.sampled_from([torch.float32, torch.float64])
# Identical, as near as floats can be, usual, and very far states.
displacements = st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e6, 1e18])


@given(neighborhoods(), shapes, dtypes, displacements, st.integers(0, 2**31))
def test_neighbors_stay_in_the_box_and_gains_within_their_bounds(near, shape, dtype, far, seed):
    """|s~ - s| <= radius |s' - s| in every coordinate; lambda_min <= gain <= lambda_max."""
    batch, features, num = shape
    generator = torch.Generator().manual_seed(seed)
    state = torch.randn(*batch, *features, generator=generator, dtype=dtype)
    step = far * torch.randn(*batch, *features, generator=generator, dtype=dtype)
    successor = state + step
    neighbor, distance = near.sample(
        state, successor, num, generator=generator, batch_dims=len(batch)
    )
    assert neighbor.shape == (*batch, num, *features) and distance.shape == (*batch, num)
    assert neighbor.dtype == dtype and neighbor.isfinite().all()
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    here = state.unsqueeze(len(batch))
    moved = (neighbor - here).abs()
    room = near.radius * (successor - state).abs().unsqueeze(len(batch))
    assert (moved <= room * (1 + tolerance) + tolerance * (here.abs() + room)).all()
    gain = near.gain(distance)
    assert (gain >= near.lambda_min * (1 - 20 * tolerance)).all()
    assert (gain <= near.lambda_max * (1 + 20 * tolerance)).all()


@given(neighborhoods())
def test_the_gain_meets_its_bounds_at_both_ends(near):
    """lambda_max at the center, lambda_min at the edge."""
    ends = torch.tensor([near.epsilon, near.radius + near.epsilon], dtype=torch.float64)
    expected = torch.tensor([near.lambda_max, near.lambda_min], dtype=torch.float64)
    torch.testing.assert_close(near.gain(ends), expected, rtol=1e-6, atol=0.0)


numbers = st.floats(-1e4, 1e4)
scales = st.floats(1e-3, 1e3)


def make(kind, loc, scale):
    loc, scale = torch.tensor([loc]), torch.tensor([scale])
    if kind == "categorical":
        return Categorical(logits=torch.stack((loc, scale, -loc), -1).clamp(-50, 50))
    return {"normal": Normal, "independent": IndependentNormal, "tanh": TanhNormal}[kind](
        loc, scale
    )


@given(
    st.sampled_from(["normal", "independent", "tanh", "categorical"]),
    st.tuples(numbers, scales, numbers, scales),
)
def test_hellinger_lies_between_zero_and_one_and_is_symmetric(kind, parameters):
    """And is zero between a policy and itself."""
    p, q = make(kind, *parameters[:2]), make(kind, *parameters[2:])
    there, back, same = squared_hellinger(p, q), squared_hellinger(q, p), squared_hellinger(p, p)
    assert (there >= 0).all() and (there <= 1).all()
    torch.testing.assert_close(there, back, rtol=1e-4, atol=1e-7)
    assert (same.abs() <= 1e-6).all()


@given(st.tuples(numbers, scales), st.sampled_from([0.0, 1e-30, 1e-8, 1e-3, 1.0, 1e3, 1e8]))
def test_gradients_are_finite_at_identical_near_and_far_policies(parameters, shift):
    """With respect to location and scale, on both sides."""
    leaves = [torch.tensor([value], requires_grad=True) for value in (*parameters, *parameters)]
    distance = squared_hellinger(Normal(leaves[0], leaves[1]), Normal(leaves[2] + shift, leaves[3]))
    gradients = torch.autograd.grad(distance.sum(), leaves)
    assert distance.isfinite().all() and all(g.isfinite().all() for g in gradients)


@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=6))
def test_squared_error_is_a_distance(pairs):
    """Not negative, symmetric, zero on equal values, with finite gradients."""
    a, b = torch.tensor(pairs, requires_grad=True).unbind(-1)
    there = squared_error(a, b)
    assert there >= 0 and squared_error(b, a) == there and squared_error(a, a) == 0
    assert torch.autograd.grad(there, [a])[0].isfinite().all()
