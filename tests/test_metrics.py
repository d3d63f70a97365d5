"""The measures of smoothness against hand-computed numbers."""

import pytest
import torch

from torchrl_l2c2 import Neighborhood, action_variation, local_lipschitz


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
