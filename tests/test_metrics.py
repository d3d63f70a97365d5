"""The measures of smoothness against hand-computed numbers."""

import math

import numpy as np
import pytest
import torch
from torchrl.data import Bounded

from torchrl_l2c2 import Neighborhood, action_variation, local_lipschitz
from torchrl_l2c2.metrics import (
    action_fluctuation_ratio,
    action_jerk,
    action_rate,
    amplitude_spectrum,
    change_with_held_input,
    noise_sensitivity,
    previous_action_gain,
    roughness,
    saturation,
    spectral_smoothness,
)


def test_action_variation_by_hand():
    """Changes of length 5 and 1 have the mean 3; constant actions do not vary."""
    moving = torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 3.0]])
    batch = torch.stack([moving, torch.ones(3, 2)])
    assert torch.equal(action_variation(moving), torch.tensor(3.0))
    assert torch.equal(action_variation(batch), torch.tensor([3.0, 0.0]))
    assert action_variation(batch.expand(4, 5, 2, 3, 2)).shape == (4, 5, 2)


def test_action_variation_does_not_depend_on_the_length():
    """A steady motion has the same variation over 3 and over 300 steps."""
    for steps in (3, 300):
        actions = 0.25 * torch.arange(steps).unsqueeze(-1)
        assert action_variation(actions).item() == pytest.approx(0.25)


def test_padding_is_left_out_of_the_action_variation():
    """Two padded episodes give what they give alone, whatever the padding holds."""
    torch.manual_seed(0)
    long, short = torch.randn(7, 2), torch.randn(4, 2)
    padded = torch.stack([long, torch.cat([short, torch.full((3, 2), torch.nan)])])
    mask = torch.arange(7) < torch.tensor([[7], [4]])
    expected = torch.stack([action_variation(long), action_variation(short)])
    torch.testing.assert_close(action_variation(padded, mask), expected)


def test_action_variation_refuses_what_has_no_change():
    """A single step, a mask that leaves one, and shapes that do not fit."""
    with pytest.raises(ValueError, match="T of at least 2, got"):
        action_variation(torch.zeros(1, 3))
    with pytest.raises(ValueError, match="T of at least 2, got"):
        action_variation(torch.zeros(5))
    mask = torch.tensor([[True, True, False], [True, False, True]])
    with pytest.raises(ValueError, match="no two successive steps"):
        action_variation(torch.zeros(2, 3, 1), mask)
    with pytest.raises(ValueError, match=r"boolean of shape \(2, 3\)"):
        action_variation(torch.zeros(2, 3, 1), mask[0])
    with pytest.raises(ValueError, match=r"boolean of shape \(2, 3\)"):
        action_variation(torch.zeros(2, 3, 1), mask.float())


def test_local_lipschitz_by_hand():
    """Displacements (1, -2) and (.5, 0) with changes (6, 8) and (0, 1): 10 / 2 and 1 / .5."""
    state, neighbor = torch.tensor([1.0, 1.0]), torch.tensor([[2.0, -1.0], [1.5, 1.0]])
    output, neighbor_output = torch.zeros(2), torch.tensor([[6.0, 8.0], [0.0, 1.0]])
    arguments = (state, neighbor, output, neighbor_output)
    assert torch.equal(local_lipschitz(*arguments), torch.tensor(5.0))
    assert torch.equal(local_lipschitz(*arguments, reduction="mean"), torch.tensor(3.5))


def test_local_lipschitz_of_a_linear_function_is_its_slope():
    """In one dimension every neighbor gives it, so the largest and the mean agree."""
    torch.manual_seed(0)
    state, next_state = torch.randn(2, 16, 1, dtype=torch.float64)
    neighbor, _ = Neighborhood().sample(state, next_state, num_samples=4)
    for reduction in ("max", "mean"):
        slope = local_lipschitz(state, neighbor, -3.0 * state, -3.0 * neighbor, reduction=reduction)
        torch.testing.assert_close(slope, torch.full((16,), 3.0, dtype=torch.float64))


def test_local_lipschitz_bounds_the_true_constant_from_below():
    """Of a linear map under the largest norm of the state: the largest over all corner signs."""
    torch.manual_seed(0)
    matrix = torch.randn(2, 3, dtype=torch.float64)
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    true = (signs @ matrix.T).norm(dim=-1).max()
    state, next_state = torch.randn(2, 8, 3, dtype=torch.float64)
    estimates = []
    for count in (4, 4096):
        neighbor, _ = Neighborhood().sample(state, next_state, num_samples=count)
        estimate = local_lipschitz(state, neighbor, state @ matrix.T, neighbor @ matrix.T)
        assert (estimate <= true + 1e-12).all()
        estimates.append(estimate.mean())
    assert estimates[1] > estimates[0]


def test_neighbors_that_did_not_move_are_left_out():
    """Neither 0 / 0 nor a lower mean; NaN where no neighbor moved."""
    state = torch.zeros(2, 1)
    neighbor = torch.tensor([[[0.0], [2.0]], [[0.0], [0.0]]])
    for reduction in ("max", "mean"):
        result = local_lipschitz(state, neighbor, state, 3.0 * neighbor, reduction=reduction)
        assert result[0].item() == 3.0
        assert result[1].isnan()


def test_a_neighbor_that_is_no_number_shows():
    """Rather than being left out."""
    state, neighbor = torch.zeros(1), torch.tensor([[1.0], [math.nan]])
    assert local_lipschitz(state, neighbor, state, neighbor).isnan()


def test_local_lipschitz_refuses_shapes_that_do_not_fit():
    """Naming the argument and the shapes."""
    state, neighbor = torch.zeros(4, 3), torch.zeros(4, 2, 3)
    output, neighbor_output = torch.zeros(4, 1), torch.zeros(4, 2, 1)
    with pytest.raises(ValueError, match="neighbor must have one dimension of neighbors"):
        local_lipschitz(state, state, output, neighbor_output)
    with pytest.raises(ValueError, match="neighbor must have one dimension of neighbors"):
        local_lipschitz(state, neighbor[:, :0], output, neighbor_output)
    with pytest.raises(ValueError, match="neighbor_output must have one dimension"):
        local_lipschitz(state, neighbor, output, torch.zeros(4, 2, 2))
    with pytest.raises(ValueError, match="must agree in all but their last"):
        local_lipschitz(state, neighbor, output, torch.zeros(4, 5, 1))
    with pytest.raises(ValueError, match="reduction must be 'max' or 'mean', got 'sum'"):
        local_lipschitz(state, neighbor, output, neighbor_output, reduction="sum")


def test_gradients_are_finite_where_a_neighbor_or_a_step_does_not_count():
    """A neighbor that is its state, as beyond ``max_step``, and padding that is NaN."""
    weight, state = torch.ones(2, 1, requires_grad=True), torch.zeros(1, 2)
    neighbor = torch.tensor([[[0.0, 0.0], [1.0, 1.0]]])
    local_lipschitz(state, neighbor, state @ weight, neighbor @ weight).sum().backward()
    assert weight.grad.tolist() == [[1.0], [1.0]]
    actions = torch.tensor([[[0.0], [2.0], [5.0], [torch.nan]]], requires_grad=True)
    action_variation(actions, torch.tensor([[True, True, True, False]])).sum().backward()
    assert actions.grad.flatten().tolist() == [-0.5, 0.0, 0.5, 0.0]


def test_policies_in_half_precision_are_measured_in_single_precision():
    """The squares of small changes would be 0."""
    torch.manual_seed(0)
    seen = torch.randn(1000, 3).half()
    later = seen + 0.1 * torch.randn_like(seen)

    def policy(observations):
        return observations @ torch.full((3, 1), 1e-3, dtype=observations.dtype)

    expected = 0.5 * 3 * (1e-3 * 0.05) ** 2
    assert noise_sensitivity(policy, seen, 0.05).item() == pytest.approx(expected, rel=0.2)
    held = change_with_held_input(policy, seen, later)
    assert held.tolist() == pytest.approx([(2 / 3) ** 0.5] * 3, rel=0.1)


def test_bounds_of_another_precision_are_reached():
    double = torch.tensor([[0.1], [-0.1]], dtype=torch.float64)
    assert saturation(double, -0.1, 0.1, margin=0.0) == 1.0
    wide = torch.tensor([0.7], dtype=torch.float64)
    assert saturation(torch.tensor([[0.7], [-0.7]]), -wide, wide, margin=0.0) == 1.0
    with pytest.raises(ValueError, match="low must be at most high, got nan"):
        saturation(double, math.nan, 1.0)


def test_differences_by_hand():
    """Of 0, 1, 4, 10: changes 1, 3, 6; second ones 2, 3; a third one of 1."""
    actions = torch.tensor([[0.0], [1.0], [4.0], [10.0]])
    assert action_rate(actions).item() == pytest.approx((1 + 9 + 36) / 3)
    assert action_fluctuation_ratio(actions).item() == pytest.approx(10 / 4)
    assert action_jerk(actions).item() == pytest.approx(1.0)
    assert action_jerk(actions, sampling_rate=10.0).item() == pytest.approx(1000.0)
    # Around the mean of 3.75: -3.75, -2.75, .25, 6.25.
    products, squares = 3.75 * 2.75 - 2.75 * 0.25 + 0.25 * 6.25, 3.75**2 + 2.75**2 + 0.25**2
    assert previous_action_gain(actions).item() == pytest.approx(products / squares)


def test_the_gain_on_the_action_before_tells_flips_from_drifts():
    """A flip at every step has -1; a slow drift nearly 1; a coin about 0."""
    torch.manual_seed(0)
    flips = torch.tensor([1.0, -1.0]).repeat(50).unsqueeze(-1)
    assert previous_action_gain(flips).item() == pytest.approx(-1.0)
    assert previous_action_gain(torch.linspace(0, 1, 500).unsqueeze(-1)).item() > 0.98
    assert abs(previous_action_gain(torch.randn(20_000, 1)).item()) < 0.03


def test_the_spectrum_of_known_signals():
    """Two sines of known amplitude, frequency and rate; a constant is all at 0."""
    time = torch.arange(200) / 50.0  # 4 s at 50 a second
    actions = 3 + 2 * torch.sin(2 * torch.pi * 5 * time) + 0.5 * torch.cos(2 * torch.pi * 20 * time)
    frequencies, amplitudes = amplitude_spectrum(actions.unsqueeze(-1), sampling_rate=50.0)
    found = {f: a for f, a in zip(frequencies.tolist(), amplitudes[:, 0].tolist(), strict=True)}
    expected = {0.0: 3.0, 5.0: 2.0, 20.0: 0.5}
    for frequency, amplitude in found.items():
        assert amplitude == pytest.approx(expected.get(frequency, 0.0), abs=1e-4)
    assert roughness(actions.unsqueeze(-1)).item() == pytest.approx(
        (2 * 5 + 0.5 * 20) / 2.5 / 50, abs=1e-4
    )


@pytest.mark.parametrize("steps", [50, 51, 1000])
def test_the_two_forms_of_sm_are_the_published_ones_and_convert(steps):
    """Each written out as its authors print it; one is (T - 2) / 4 times the other, T even."""
    torch.manual_seed(0)
    actions = torch.randn(steps, 3, dtype=torch.float64)
    spectrum = np.abs(np.fft.fft(actions.numpy(), axis=0))[: steps // 2]
    caps = np.mean(2 / steps * spectrum * np.linspace(0, 1, steps // 2)[:, None])
    frequencies = np.fft.fftfreq(steps)[: steps // 2]
    asap = np.mean(2 / steps * (frequencies[:, None] * spectrum).sum(0))
    assert spectral_smoothness(actions).item() == pytest.approx(caps)
    assert spectral_smoothness(actions, "asap").item() == pytest.approx(asap)
    if steps % 2 == 0:
        assert asap / caps == pytest.approx((steps - 2) / 4)


def test_the_highest_frequency_is_left_out_of_sm_and_kept_in_roughness():
    """Of six steps, by hand: 3 + cos(pi t / 3) + 2 (-1)^t has 3, 1, 0 and 2 at 0, 1/6, 1/3, 1/2."""
    actions = torch.tensor([[6.0], [1.5], [4.5], [0.0], [4.5], [1.5]])
    frequencies, amplitudes = amplitude_spectrum(actions)
    torch.testing.assert_close(frequencies, torch.tensor([0.0, 1 / 6, 1 / 3, 1 / 2]))
    torch.testing.assert_close(amplitudes[:, 0], torch.tensor([3.0, 1.0, 0.0, 2.0]))
    # Weights 0, 1/2 and 1 in the mean of three; frequencies in the sum.
    assert spectral_smoothness(actions).item() == pytest.approx(1 / 6)
    assert spectral_smoothness(actions, "asap").item() == pytest.approx(1 / 6)
    assert roughness(actions).item() == pytest.approx((1 / 6 + 2 / 2) / 3)


@pytest.mark.parametrize("measure", [roughness, previous_action_gain])
@pytest.mark.parametrize("value", [0.1, 0.3, 0.7, 1.0])
@pytest.mark.parametrize("steps", [100, 150, 1000])
def test_what_never_changes_has_none(measure, value, steps):
    """NaN, and no rounding noise: that of a policy that keeps still."""
    assert measure(torch.full((steps, 1), value)).isnan()


@pytest.mark.parametrize("form", ["caps", "asap"])
@pytest.mark.parametrize("value", [0.3, 0.7, 1.0])
def test_sm_of_what_never_changes_is_zero(form, value):
    """And no rounding noise, which tables would take for a ratio to it."""
    still = torch.full((151, 1), value)
    assert spectral_smoothness(still, form).item() == 0.0
    amplitudes = amplitude_spectrum(still)[1]
    assert amplitudes[0].item() == pytest.approx(value) and not amplitudes[1:].any()


def test_roughness_is_free_of_amplitude_offset_and_length():
    """White noise has .25, whatever its size; a slow sine less the slower it is."""
    torch.manual_seed(0)
    for steps, size in ((500, 1.0), (5000, 30.0)):
        assert roughness(7 + size * torch.randn(steps, 4)).item() == pytest.approx(0.25, abs=0.02)


def test_saturation_counts_what_is_at_the_bounds():
    """Of six numbers in bounds -1, 1 and 0, 4: -1, .99 and 3.97 are at their ends."""
    actions = torch.tensor([[-1.0, 2.0], [0.99, 3.97], [0.9, 0.5]])
    low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])
    assert saturation(actions, low, high).item() == pytest.approx(3 / 6)
    assert saturation(actions, low, high, margin=0.0).item() == pytest.approx(1 / 6)


def test_saturation_of_actions_that_are_nan_is_nan():
    """As for the other measures; of the other episode it is a number, also with infinity."""
    actions = torch.tensor([[[math.nan], [0.0]], [[math.inf], [0.0]]])
    found = saturation(actions, -1.0, 1.0)
    assert found.isnan().tolist() == action_variation(actions).isnan().tolist() == [True, False]
    assert found[1].item() == 0.5


@pytest.mark.parametrize(
    ("low", "high", "error", "told"),
    [
        (1.0, -1.0, ValueError, "low must be at most high, got 1.0 and -1.0"),
        (Bounded(-1.0, 1.0, (1,)), 1.0, TypeError, "pass spec.space.low, spec.space.high"),
    ],
)
def test_saturation_refuses_what_are_no_bounds(low, high, error, told):
    with pytest.raises(error, match=told):
        saturation(torch.zeros(5, 1), low, high)


def test_of_a_range_that_is_open_only_the_bound_counts():
    """It has no width to take a share of; the end that is not there is never met."""
    actions = torch.tensor([[0.0], [0.001], [5.0], [-1.0]])
    assert saturation(actions, 0.0, math.inf).item() == pytest.approx(2 / 4)
    assert saturation(actions, -math.inf, 5.0).item() == pytest.approx(1 / 4)
    assert saturation(actions, -math.inf, math.inf).item() == 0.0


def test_a_held_input_leaves_the_changes_of_the_others():
    """Of a linear policy by hand: moves of 2 and -1 with weights 3 and 1 change it by 6 - 1."""
    seen = torch.randn(7, 2, 1, generator=torch.Generator().manual_seed(0))
    after = seen + torch.tensor([[2.0], [-1.0]])

    def policy(observation):
        return observation.flatten(1) @ torch.tensor([[3.0], [1.0]])

    found = change_with_held_input(policy, seen, after)
    torch.testing.assert_close(found, torch.tensor([[1 / 5], [6 / 5]]))
    assert change_with_held_input(policy, seen, seen).isnan().all()
    with pytest.raises(ValueError, match=r"one shape, \[N, \*F\], got \(7, 2, 1\) and \(6, 2, 1\)"):
        change_with_held_input(policy, seen, after[1:])
    with pytest.raises(ValueError, match=r"got \(2,\) and \(2,\)"):
        change_with_held_input(policy, seen[0, :, 0], seen[0, :, 0])


def test_noise_sensitivity_of_a_linear_policy():
    """Half the squared scale times the squared norm of its weights."""
    weight = torch.tensor([[1.0, -2.0, 0.0], [0.0, 0.5, 3.0]])
    observations = torch.randn(50_000, 3)
    found = noise_sensitivity(lambda s: s @ weight.T, observations, 0.2)
    assert found.item() == pytest.approx(0.5 * 0.04 * weight.square().sum().item(), rel=0.03)


def test_every_coordinate_may_have_noise_of_its_own():
    """Half of (3 * .1)^2 + (1 * .2)^2; the scale of one size is that of each coordinate."""
    observations, weight = torch.zeros(50_000, 2), torch.tensor([[3.0], [1.0]])
    generator = torch.Generator().manual_seed(0)

    def found(scale):
        return noise_sensitivity(lambda s: s @ weight, observations, scale, generator=generator)

    assert found(torch.tensor([0.1, 0.2])).item() == pytest.approx(0.5 * (0.09 + 0.04), rel=0.02)
    assert found(torch.zeros(2)) == 0.0
    with pytest.raises(TypeError, match="observations must be a floating-point tensor, got list"):
        noise_sensitivity(lambda s: s, [0.0, 0.0], torch.ones(2))
    for scale, told in (
        (torch.ones(3), r"each coordinate of observations \(50000, 2\), got the shape \(3,\)"),
        (torch.tensor([0.1, -0.1]), "finite and at least 0, got"),
        (torch.tensor([0.1, torch.nan]), "finite and at least 0, got"),
    ):
        with pytest.raises(ValueError, match=told):
            found(scale)


def test_noise_sensitivity_refuses_what_is_no_action():
    """A TorchRL actor returns more than its action."""
    with pytest.raises(TypeError, match="only the mean actions, got a tuple"):
        noise_sensitivity(lambda s: (s, s), torch.zeros(4, 3), 0.2)


def test_of_an_odd_number_of_steps_the_last_frequency_is_whole():
    """A cosine with two periods in five steps has the amplitude 1."""
    cosine = torch.cos(2 * torch.pi * 2 * torch.arange(5.0) / 5).unsqueeze(-1)
    assert amplitude_spectrum(cosine)[1][-1].item() == pytest.approx(1.0, abs=1e-5)


def test_noise_sensitivity_refuses_integers():
    """Noise on them would be rounded away."""
    with pytest.raises(
        TypeError, match=r"floating-point tensor, got torch\.uint8: noise on integers"
    ):
        noise_sensitivity(lambda s: s, torch.zeros(4, 3, dtype=torch.uint8), 0.2)


def test_noise_sensitivity_refuses_actions_without_a_dimension_of_their_own():
    """It would sum over the batch, and grow with it."""
    observations = torch.randn(8, 3)
    with pytest.raises(ValueError, match=r"\[\*B, A\] .* got \(8,\) of \(8, 3\)"):
        noise_sensitivity(lambda s: s[:, 0], observations, 0.2)
    assert noise_sensitivity(lambda s: s[:1], observations[0], 0.2).ndim == 0
    assert noise_sensitivity(lambda s: s.flatten(1), observations.view(8, 3, 1, 1), 0.2).ndim == 0


@pytest.mark.parametrize(
    ("measure", "least"),
    [
        (action_rate, 2),
        (action_fluctuation_ratio, 2),
        (previous_action_gain, 2),
        (action_jerk, 4),
        (amplitude_spectrum, 4),
        (spectral_smoothness, 4),
        (roughness, 4),
    ],
)
def test_measures_of_batches_and_what_is_too_short(measure, least):
    """Each episode of a batch by itself; one step fewer than it takes is refused."""
    torch.manual_seed(0)
    batch = torch.randn(2, 3, 9, 2)
    if measure is not amplitude_spectrum:
        torch.testing.assert_close(measure(batch)[1, 2], measure(batch[1, 2]))
    with pytest.raises(ValueError, match=f"T of at least {least}, got"):
        measure(torch.zeros(least - 1, 2))
    with pytest.raises(ValueError, match=rf"{measure.__name__}: actions must .* got \(9,\)"):
        measure(torch.zeros(9))


@pytest.mark.parametrize(
    "measure",
    [
        *(action_variation, action_rate, action_fluctuation_ratio, action_jerk),
        *(previous_action_gain, amplitude_spectrum, spectral_smoothness, roughness),
        lambda actions: action_jerk(actions, 50.0),
        lambda actions: saturation(actions, -1.0, 1.0),
    ],
)
def test_labels_and_arrays_are_refused_and_half_precision_is_not(measure):
    """Integers would be rounded to a number that means nothing.

    In half precision, a rate to the power of three is infinite, and sums lose digits.
    """
    torch.manual_seed(0)
    for given in (torch.ones(9, 2, dtype=torch.long), np.ones((9, 2))):
        told = f"must be a floating-point tensor, got {given.dtype}"
        with pytest.raises(TypeError, match=told):
            measure(given)
    drawn = torch.randn(9, 2)
    for half in (drawn.half(), drawn.bfloat16()):
        torch.testing.assert_close(measure(half), measure(half.float()))
