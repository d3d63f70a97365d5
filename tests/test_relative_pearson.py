"""The equations of PPO-RPE against hand-computed numbers."""

import math

import pytest
import torch

from torchrl_l2c2.objectives.ppo_rpe import (
    actor_loss,
    critic_loss,
    penalty_gain,
    relative_density_ratio,
    update_deviation,
)


def test_the_relative_density_ratio():
    """rho / (3/4 + rho / 4): 0, 1, 4/3 and, at infinity, 4."""
    found = relative_density_ratio(torch.tensor([0.0, 1.0, 1.5, 1e9]), beta=0.25)
    assert found.tolist() == pytest.approx([0.0, 1.0, 4 / 3, 4.0])


def test_the_gain_of_the_penalty():
    """beta = 1/4, epsilon = .4: |A| / (.4 (.75 -+ .05)), with the sign of A."""
    found = penalty_gain(torch.tensor([2.1, -1.6, 0.0]), torch.tensor(0.4), beta=0.25)
    assert found.tolist() == pytest.approx([2.1 / 0.28, 1.6 / 0.32, 0.0])


def test_the_actors_loss():
    """A = 2.1, rho = 1.5: C / 2 * 1.125 * (1/3)^2 - 3.15; at rho = 1 it is -A."""
    advantage, ratio = torch.tensor([2.1, 2.1]), torch.tensor([1.5, 1.0])
    found = actor_loss(advantage, ratio, torch.tensor(0.4), beta=0.25)
    expected = [2.1 / 0.28 / 2 * 1.125 / 9 - 3.15, -2.1]
    assert found.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_actors_loss_is_stationary_at_the_threshold(sign):
    """Where rho_R = 1 + sgn(A) epsilon its derivative by rho is 0."""
    beta, epsilon = 0.3, 0.2
    relative = 1 + sign * epsilon
    ratio = torch.tensor((1 - beta) * relative / (1 - beta * relative), dtype=torch.float64)
    ratio.requires_grad_()
    advantage = torch.tensor(1.7 * sign, dtype=torch.float64)
    loss = actor_loss(advantage, ratio, torch.tensor(epsilon, dtype=torch.float64), beta)
    (slope,) = torch.autograd.grad(loss, ratio)
    assert slope.item() == pytest.approx(0.0, abs=1e-12)


def test_the_critics_loss():
    """Half the sum of squared errors of the heads: (1 + 4) / 2 and 9 / 2."""
    found = critic_loss(torch.tensor([[1.0], [3.0]]), torch.tensor([[0.0, 3.0], [3.0, 0.0]]))
    assert found.tolist() == [2.5, 4.5]


@pytest.mark.parametrize(
    ("statistic", "deviation", "updated"),
    [("max", 0.8, 0.8), ("ema", 0.5, 0.9 * 0.6 + 0.1 * 0.5)],
)
def test_the_deviation_is_a_decaying_maximum_or_an_average(statistic, deviation, updated):
    """Of |rho_R - 1| = .2 and .8, after Delta = .6."""
    found = update_deviation(
        torch.tensor(0.6), torch.tensor([0.8, 1.8]), decay=0.9, floor=0.1, statistic=statistic
    )
    assert [x.item() for x in found] == pytest.approx([deviation, updated])


def test_the_deviation_decays_to_its_floor_and_forgets_nan():
    """Equal policies: decay * Delta, and not below; NaN counts as no deviation."""
    settings = {"decay": 0.5, "floor": 0.1, "statistic": "max"}
    same = torch.tensor([1.0, math.nan])
    assert update_deviation(torch.tensor(0.6), same, **settings)[1].item() == pytest.approx(0.3)
    assert update_deviation(torch.tensor(0.15), same, **settings)[1].item() == pytest.approx(0.1)
