"""Regularizers under autocast: near states are compared in full precision."""

from __future__ import annotations

import pytest
import torch
from torchrl.objectives import ClipPPOLoss, DDPGLoss, SACLoss

from tests.losses import (
    critic,
    deterministic_actor,
    gaussian_actor,
    on_policy,
    qvalue,
)
from torchrl_l2c2 import ASAPLoss, CATSLoss, L2C2Loss, LCPLoss, PPORPELoss, SR2LLoss
from torchrl_l2c2.objectives import _evaluation


def ppo():
    return ClipPPOLoss(gaussian_actor(), critic())


# PPO-RPE's evaluations at the batch's states are spared the regularizer, but for these.
LOSSES = {
    "PPO": lambda: L2C2Loss(ppo()),
    "PPO, half of the batch": lambda: L2C2Loss(ppo(), fraction=0.5),
    "PPO-RPE": lambda: L2C2Loss(PPORPELoss(gaussian_actor(), critic())),
    "SAC": lambda: L2C2Loss(SACLoss(gaussian_actor(), qvalue(), target_entropy=-2.0)),
    "DDPG": lambda: L2C2Loss(DDPGLoss(deterministic_actor(), qvalue())),
    "CATS": lambda: CATSLoss(ppo()),
}


@pytest.fixture
def batch():
    """Steps so short that the outputs at their ends are one number in bfloat16."""
    torch.manual_seed(0)
    batch = on_policy(64)
    batch["next", "observation"] = batch["observation"] + 1e-3
    batch["advantage"] = batch["value_target"] = torch.randn(64, 1)
    return batch


def evaluate(loss, batch, autocast):
    """The added terms, their gradients, and the loss's own terms."""
    torch.manual_seed(1)
    with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
        terms = loss(batch.copy())
    added = terms.select(*loss.added_terms)
    weights = [weight for weight in loss.parameters() if weight.requires_grad]
    total = sum(added.values())
    gradients = torch.autograd.grad(total, weights, allow_unused=True, materialize_grads=True)
    own = [key for key in terms.keys() if key.startswith("loss_") and key not in loss.added_terms]
    return added, gradients, terms.select(*own)


@pytest.mark.parametrize("make", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("compiling", [False, True])
def test_the_terms_and_gradients_are_those_without_autocast(make, compiling, batch, monkeypatch):
    """While the loss's own terms are rounded; compiled, small batches are not one pass for both."""
    loss = make()
    added, gradients, own = evaluate(loss, batch, autocast=False)
    if isinstance(loss, PPORPELoss):
        loss.delta.fill_(0.5)  # The adaptive threshold is a state that every forward pass moves.
    monkeypatch.setattr(_evaluation, "is_compiling", lambda: compiling)
    found, its_gradients, its_own = evaluate(loss, batch, autocast=True)
    # Relative to themselves: of states so near the terms are far below 1e-5.
    torch.testing.assert_close(found, added, rtol=0.05, atol=0.0)
    for gradient, expected in zip(its_gradients, gradients, strict=True):
        atol = 0.05 * expected.abs().max().item() + 1e-12  # A bias of values has none.
        torch.testing.assert_close(gradient, expected, rtol=0.0, atol=atol)
    assert (its_own != own).any()


def test_what_is_a_copy_of_the_policy_predicts_it_under_autocast_too(batch):
    """ASAP's terms are 0 then, where its predictor is evaluated as the policy is."""
    batch["previous_observation"] = batch["observation"].clone()
    added, *_ = evaluate(ASAPLoss(ppo(), previous_key="previous_observation"), batch, autocast=True)
    for kind in ("spatial", "temporal"):
        assert added[f"loss_asap_{kind}"].item() == 0.0


@pytest.mark.parametrize("kind", [LCPLoss, SR2LLoss])
def test_gradients_that_a_term_is_made_of_are_in_full_precision(kind, batch):
    """The penalty is one of gradients, or the state is found by them."""
    loss = kind(ppo())
    added, *_ = evaluate(loss, batch, autocast=False)
    found, *_ = evaluate(loss, batch, autocast=True)
    torch.testing.assert_close(found, added, rtol=1e-5, atol=0.0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("kind", [CATSLoss, ASAPLoss, LCPLoss])
def test_observations_in_half_precision_are_taken_as_autocast_takes_them(kind, dtype, batch):
    """At the same states as if they had been stored in single precision."""
    batch["frames"] = torch.cat((batch["observation"], batch["observation"]), -1)
    keys = "observation", ("next", "observation"), "frames"
    halves = batch.copy().update(batch.select(*keys).to(dtype))
    singles = halves.copy().update(halves.select(*keys).float())
    loss = kind(ppo())
    expected = loss.policy_regularizer(singles)
    with torch.autocast("cpu", dtype=dtype):
        loss(halves.copy())
        terms = loss.policy_regularizer(halves)
    torch.testing.assert_close(terms, expected)


def test_it_compiles_under_autocast(batch):
    """Into one graph, also of observations in half precision."""
    batch["observation"], batch["next", "observation"] = (
        batch[key].bfloat16() for key in ("observation", ("next", "observation"))
    )
    loss = CATSLoss(ppo())
    # Not beside the loss's own terms, which would take most of the time.
    compiled = torch.compile(loss.policy_regularizer, fullgraph=True, backend="eager")
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found, expected = compiled(batch.copy()), loss.policy_regularizer(batch.copy())
    torch.testing.assert_close(found["loss_cats"], expected["loss_cats"])


def test_rounded_the_term_would_be_another_number(batch):
    """What is avoided: the same mean of squares, of means that were rounded to 8 bits."""
    loss = CATSLoss(ppo(), lambda_temporal=1.0)
    expected = evaluate(loss, batch, autocast=False)[0]["loss_cats"]
    with torch.no_grad(), torch.autocast("cpu", dtype=torch.bfloat16):
        here, there = (
            loss.actor_network.get_dist_params(states.select("observation"))["loc"]
            for states in (batch, batch["next"])
        )
    naive = (here.float() - there.float()).square().sum(-1).mean()
    assert abs(naive / expected - 1) > 1
