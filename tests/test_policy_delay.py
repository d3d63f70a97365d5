"""Between two updates of the policy no term trains it, whoever wrote the term."""

import pytest
import torch
from losses import BOUNDS, deterministic_actor, qvalue, transitions
from tensordict.utils import assert_close
from torchrl.objectives import SoftUpdate, TD3Loss

from torchrl_l2c2 import CAPSLoss, L2C2Loss, RegularizedLoss
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.learn.update import make_update


class Stillness(RegularizedLoss):
    """A user's regularizer, whose term's name says nothing of an actor."""

    def __init__(self, base_loss):
        self.declare_networks(["actor_network"])
        self.declare_terms(policy=["loss_stillness"])

    def policy_regularizer(self, tensordict):
        terms = super().policy_regularizer(tensordict)
        _, action = self.policies_at(tensordict, tensordict.select("observation")[None])
        cost = self.reduce_term(action[0].square().sum(-1), tensordict)
        return terms.set("loss_stillness", cost)


@pytest.mark.parametrize("regularizer", [lambda loss: loss, Stillness, CAPSLoss, L2C2Loss])
def test_a_delayed_update_leaves_the_policy_untouched(regularizer):
    """TD3's own term and every regularizer's wait; the values are trained all the same."""
    torch.manual_seed(0)
    loss = regularizer(TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS))
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    agent = Agent(
        loss, loss.actor_network, optimizer=optimizer, policy_terms=frozenset({"loss_actor"})
    )
    update = make_update(agent, compile=False)
    batch = transitions(6)
    for with_policy in (False, True):
        before = {name: p.detach().clone() for name, p in loss.named_parameters()}
        update(with_policy, batch)
        for name, parameter in loss.named_parameters():
            moved = not torch.equal(parameter, before[name])
            assert moved == (with_policy or name.startswith("qvalue")), name


def test_the_target_networks_wait_for_the_policy():
    """As in TD3's algorithm; then they move to (1 - tau) old + tau new."""
    torch.manual_seed(0)
    loss = TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS)
    agent = Agent(
        loss,
        loss.actor_network,
        optimizer=torch.optim.SGD(loss.parameters(), lr=0.1),
        target_updater=SoftUpdate(loss, tau=0.25),
        policy_terms=frozenset({"loss_actor"}),
    )
    update = make_update(agent, compile=False)
    targets, sources = loss.target_qvalue_network_params, loss.qvalue_network_params
    before = targets.detach().clone()
    update(False, transitions(6))
    assert (targets == before).all()
    update(True, transitions(6))
    assert_close(targets, 0.75 * before + 0.25 * sources.detach())
