from __future__ import annotations

import math

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import stats

from torchrl_l2c2 import Neighborhood


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(
    ("sigma", "lambda_min", "lambda_max", "epsilon", "radius", "scale"),
    [
        (1.0, 0.01, 1.0, 1 / 99, 1.0, 1 / 99),
        (0.5, 0.2, 1.0, 1 / 9, 4 / 9, 1 / 9),
        (2.0, 0.1, 1.0, 0.25, 2.25, 0.25),
        (2.0, 0.5, 3.0, 0.5, 2.5, 1.5),
    ],
)
def test_constants_by_hand(sigma, lambda_min, lambda_max, epsilon, radius, scale):
    """Epsilon, radius and gain are those worked out by hand from the paper's equations."""
    near = Neighborhood(sigma, lambda_min, lambda_max)
    assert near.epsilon == pytest.approx(epsilon, rel=1e-12)
    assert near.radius == pytest.approx(radius, rel=1e-12)
    assert near.scale == pytest.approx(scale, rel=1e-12)


@settings(max_examples=100, deadline=None)
@given(
    sigma=st.floats(0.05, 20.0), lambda_min=st.floats(1e-4, 10.0), lambda_max=st.floats(1e-3, 1e3)
)
def test_gain_spans_its_bounds(sigma, lambda_min, lambda_max):
    """The gain is lambda_max at the center and lambda_min at the edge, whatever sigma."""
    assume(lambda_max > 1.01 * lambda_min and lambda_max > 1.01 * sigma * lambda_min)
    near = Neighborhood(sigma, lambda_min, lambda_max)
    ends = torch.tensor([0.0, near.radius], dtype=torch.float64) + near.epsilon
    torch.testing.assert_close(
        near.gain(ends),
        torch.tensor([lambda_max, lambda_min], dtype=torch.float64),
        rtol=1e-9,
        atol=0,
    )


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"sigma": 0.0}, ValueError, "sigma must be finite and greater than 0, got 0.0"),
        ({"sigma": math.inf}, ValueError, "sigma must be finite"),
        ({"lambda_min": 0.0}, ValueError, "lambda_min must be finite and greater than 0"),
        ({"lambda_min": -0.1}, ValueError, "got -0.1"),
        ({"lambda_max": math.nan}, ValueError, "lambda_max must be finite"),
        ({"lambda_max": "1e0"}, TypeError, r"lambda_max must be a real number, got '1e0' \(str\)"),
        ({"sigma": True}, TypeError, "sigma must be a real number"),
        ({"sigma": 2.0, "lambda_min": 0.5}, ValueError, "greater than sigma"),
        ({"sigma": 3.0, "lambda_min": 0.5}, ValueError, "raise lambda_max, or lower sigma"),
        ({"sigma": 0.5, "lambda_min": 1.0}, ValueError, "greater than lambda_min"),
        ({"sigma": 0.5, "lambda_min": 1.5}, ValueError, "radius would be -1.0"),
    ],
)
def test_wrong_settings_fail_at_construction(arguments, error, message):
    """A setting out of its range is refused with what was given and what to do."""
    with pytest.raises(error, match=message):
        Neighborhood(**arguments)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_distance_is_that_of_the_definition(sigma):
    """The distance is the largest relative displacement plus epsilon, within the box."""
    near = Neighborhood(sigma, 0.1, 1.0)
    state = torch.randn(500, 4, dtype=torch.float64, generator=generator(1))
    next_state = state + torch.randn(500, 4, dtype=torch.float64, generator=generator(2))
    neighbor, distance = near.sample(state, next_state, 3, generator())
    quotient = (neighbor - state[:, None]) / (next_state - state)[:, None]
    torch.testing.assert_close(distance, quotient.abs().amax(-1) + near.epsilon)
    assert quotient.abs().max() <= near.radius
    assert quotient.abs().max() > 0.99 * near.radius


def test_displacement_is_uniform_and_independent():
    """Each coordinate's relative displacement is uniform over the box, independent of others."""
    near = Neighborhood(2.0, 0.1, 1.0)
    state = torch.zeros(20_000, 2, dtype=torch.float64)
    neighbor, _ = near.sample(state, state + 1.0, generator=generator())
    u = neighbor[:, 0].numpy()
    for coordinate in u.T:
        uniform = stats.uniform(-near.radius, 2 * near.radius)
        assert stats.kstest(coordinate, uniform.cdf).pvalue > 1e-3
    assert stats.spearmanr(*u.T).pvalue > 1e-3


@pytest.mark.parametrize(("dimensions", "gain"), [(1, 0.0468), (5, 0.0125), (28, 0.0104)])
def test_gain_is_near_its_minimum_in_high_dimension(dimensions, gain):
    """The mean gain falls to lambda_min as dimensions grow, as the documentation says."""
    near = Neighborhood()
    state = torch.zeros(100_000, dimensions)
    _, distance = near.sample(state, state + 1.0, generator=generator())
    assert near.gain(distance).mean().item() == pytest.approx(gain, rel=0.02)


def test_coordinates_without_a_displacement_stay():
    """Constant and non-finite coordinates keep the state's value and leave the distance finite."""
    near = Neighborhood()
    state = torch.tensor([[1.0, 2.0, 3.0, 4.0, 5.0]])
    next_state = torch.tensor([[1.0, math.nan, math.inf, -math.inf, 6.0]])
    neighbor, distance = near.sample(state, next_state, 100, generator())
    torch.testing.assert_close(neighbor[0, :, :4], state[:, :4].expand(100, 4), rtol=0, atol=0)
    assert neighbor[0, :, 4].sub(5.0).abs().gt(0.0).all()
    assert distance.isfinite().all()
    # The draws of coordinates that did not move count too: the distance is that of the draw.
    assert (distance[0] >= neighbor[0, :, 4].sub(5.0).abs() + near.epsilon - 1e-6).all()
    assert (distance[0] > neighbor[0, :, 4].sub(5.0).abs() + near.epsilon + 0.1).any()


@pytest.mark.parametrize(
    ("shape", "batch_dims", "neighbor_shape", "distance_shape"),
    [
        ((5,), 0, (3, 5), (3,)),
        ((4,), 1, (4, 3), (4, 3)),
        ((4, 5), 1, (4, 3, 5), (4, 3)),
        ((4, 6, 5), 2, (4, 6, 3, 5), (4, 6, 3)),
        ((4, 2, 8, 8), 1, (4, 3, 2, 8, 8), (4, 3)),
        ((0, 5), 1, (0, 3, 5), (0, 3)),
    ],
)
def test_shapes(shape, batch_dims, neighbor_shape, distance_shape):
    """Samples follow the batch dimensions; any shape of features shares one distance."""
    state = torch.zeros(shape)
    neighbor, distance = Neighborhood().sample(state, state + 1.0, 3, batch_dims=batch_dims)
    assert neighbor.shape == neighbor_shape
    assert distance.shape == distance_shape
    features = tuple(range(batch_dims + 1, neighbor.ndim))
    largest = neighbor.abs().amax(features) if features else neighbor.abs()
    torch.testing.assert_close(distance, largest + Neighborhood().epsilon)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_dtype_is_that_of_the_state(dtype):
    """Also where the successor's is another. Distances have single precision at least."""
    neighbor, distance = Neighborhood().sample(torch.zeros(4, 2, dtype=dtype), torch.ones(4, 2))
    assert neighbor.dtype == dtype
    assert distance.dtype == torch.promote_types(dtype, torch.float32)


def test_half_precision_has_finite_gains_and_right_steps():
    """At the state itself, where the gain is the largest; a step's square may overflow."""
    near = Neighborhood(lambda_min=1.0, lambda_max=1e5, neighbors="line", max_step=1000.0)
    state, uniform = torch.zeros(2, 2).half(), torch.full((2, 1), 0.5).half()
    far = torch.tensor([[300.0, 300.0], [900.0, 900.0]]).half()
    neighbor, distance = near.place(state, far, uniform)
    assert torch.equal(neighbor[:, 0], state)
    torch.testing.assert_close(near.gain(distance), torch.tensor([[1e5], [0.0]]))
    near = Neighborhood(max_step=5e-5)
    assert near.sample(state, state + 1e-4)[1].isinf().all()  # a step of 1.4e-4


def test_generator_decides_the_draw():
    """The same generator state gives the same neighbors; the next draw and sample are others."""
    near, state = Neighborhood(), torch.zeros(8, 2)
    source = generator()
    first, _ = near.sample(state, state + 1.0, 2, source)
    second, _ = near.sample(state, state + 1.0, 2, source)
    torch.manual_seed(1)
    again, _ = near.sample(state, state + 1.0, 2, generator())
    torch.testing.assert_close(first, again, rtol=0, atol=0)
    assert not (first == second).any()
    assert not (first[:, 0] == first[:, 1]).any()


@pytest.mark.parametrize(
    ("state", "next_state", "arguments", "error", "message"),
    [
        (torch.zeros(4, 2), torch.zeros(4, 3), {}, ValueError, r"\(4, 2\) and \(4, 3\)"),
        (torch.zeros(4, 2), torch.zeros(2), {}, ValueError, r"\(4, 2\) and \(2,\)"),
        (torch.zeros(4, 2).long(), torch.zeros(4, 2), {}, TypeError, "state .*torch.int64"),
        (torch.zeros(4, 2), torch.zeros(4, 2).bool(), {}, TypeError, "next_state .*torch.bool"),
        (torch.zeros(4, 2), torch.zeros(4, 2), {"num_samples": 0}, ValueError, "got 0"),
        (torch.zeros(4, 2), torch.zeros(4, 2), {"num_samples": 1.5}, TypeError, "got 1.5"),
        (torch.zeros(4, 2), torch.zeros(4, 2), {"num_samples": True}, TypeError, "got True"),
        (torch.zeros(4, 2), torch.zeros(4, 2), {"batch_dims": 3}, ValueError, "0 and 2"),
        (torch.zeros(4, 2), torch.zeros(4, 2), {"batch_dims": -1}, ValueError, "got -1"),
    ],
)
def test_wrong_arguments_of_sample(state, next_state, arguments, error, message):
    """Sampling refuses what would broadcast or round silently, naming what it got."""
    with pytest.raises(error, match=message):
        Neighborhood().sample(state, next_state, **arguments)


@pytest.mark.parametrize("dynamic", [None, True])
def test_sample_compiles_without_a_break(dynamic):
    """Sampling traces into one graph and keeps its meaning there, for batches of any size."""
    near = Neighborhood(2.0, 0.1, 1.0)
    sample = torch.compile(near.sample, fullgraph=True, backend="aot_eager", dynamic=dynamic)
    for size in (16, 8, 12):
        state = torch.zeros(size, 3)
        neighbor, distance = sample(state, state + 1.0, 2)
        assert neighbor.shape == (size, 2, 3)
        torch.testing.assert_close(distance, neighbor.abs().amax(-1) + near.epsilon)


@pytest.mark.parametrize("batch_dims", [0, 1, 2])
def test_drawing_and_placing_is_sampling(batch_dims):
    """In two steps, the same neighbors; the edges of the numbers are the edges of the box."""
    near = Neighborhood(sigma=0.5)
    state, next_state = torch.randn(4, 3, 2), torch.randn(4, 3, 2)
    seeds = [torch.Generator().manual_seed(0) for _ in range(2)]
    expected = near.sample(state, next_state, 5, seeds[0], batch_dims=batch_dims)
    uniform = near.draw(state, 5, seeds[1], batch_dims=batch_dims)
    found = near.place(state, next_state, uniform, batch_dims=batch_dims)
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    edge, distance = near.place(state, next_state, torch.ones(4, 1, 3, 2))
    torch.testing.assert_close(edge[:, 0], state + near.radius * (next_state - state))
    torch.testing.assert_close(distance, torch.full((4, 1), near.radius + near.epsilon))


def test_numbers_of_another_shape_are_refused():
    """The message has the shapes."""
    with pytest.raises(ValueError, match=r"uniform must have the shape \[\*B, K, \*F\].*\(4, 3\)"):
        Neighborhood().place(torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4, 3))
    with pytest.raises(TypeError, match="must be a floating-point tensor"):
        Neighborhood().draw(torch.zeros(4, 3, dtype=torch.long))


def test_a_shared_draw_leads_along_the_line_to_the_successor():
    """u = 1/2 halfway to it, at the distance 1/2 + epsilon, for features of any shape."""
    near = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0, neighbors="line")
    state, later = torch.zeros(2, 3, 2), torch.arange(12.0).reshape(2, 3, 2)
    neighbor, distance = near.place(state, later, torch.tensor([[0.75], [0.0]]))
    torch.testing.assert_close(neighbor, torch.stack((0.5 * later[:1], -later[1:]))[:, 0][:, None])
    torch.testing.assert_close(distance, torch.tensor([[0.75], [1.25]]))
    assert near.draw(state, 5).shape == (2, 5)
    with pytest.raises(ValueError, match=r"\[\*B, K\] of states"):
        near.place(state, later, torch.zeros(2, 1, 3, 2))


def test_steps_beyond_the_bound_are_infinitely_far():
    """Their neighbor is the state, their gain 0; a step of exactly the bound counts."""
    near = Neighborhood(max_step=5.0)
    later = torch.tensor([[3.0, 4.0], [3.0, 4.1], [math.nan, 6.0]])
    neighbor, distance = near.place(torch.zeros(3, 2), later, torch.ones(3, 1, 2))
    assert distance.isinf().flatten().tolist() == [False, True, True]
    assert neighbor[1:].abs().sum() == 0 and neighbor[0].tolist() == [[3.0, 4.0]]
    assert near.gain(distance)[1:].tolist() == [[0.0], [0.0]]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"neighbors": "ball"}, ValueError, "Expected neighbors='box' or 'line', got 'ball'"),
        (
            {"max_step": 0.0},
            ValueError,
            "max_step must be finite and greater than 0, got",
        ),
        ({"max_step": math.inf}, ValueError, "None is no bound"),
    ],
)
def test_other_boxes_are_refused(arguments, error, message):
    """With what is allowed."""
    with pytest.raises(error, match=message):
        Neighborhood(**arguments)
