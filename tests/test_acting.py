"""Policies that are compiled to act: the same actions, also where exploration follows."""

from __future__ import annotations

import pytest
import torch
import torch._inductor.compile_fx
from tensordict.nn import TensorDictSequential
from torchrl.data import Bounded, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import Actor, AdditiveGaussianModule, EGreedyModule, QValueActor

from tests.losses import OBSERVATION, gaussian_actor, mlp
from torchrl_l2c2.experiment.collect.acting import policy_function
from torchrl_l2c2.experiment.learn.compilation import compiler_available

BOX, CHOICES = Bounded(-1, 1, (2,)), OneHot(4)
POLICIES = {
    "samples": lambda: (gaussian_actor(), ["action", "action_log_prob"]),
    "added noise": lambda: (
        TensorDictSequential(Actor(mlp(OBSERVATION, 2)), AdditiveGaussianModule(BOX)),
        ["action"],
    ),
    "epsilon-greedy": lambda: (
        TensorDictSequential(
            QValueActor(mlp(OBSERVATION, 4), spec=CHOICES), EGreedyModule(CHOICES, eps_init=0.5)
        ),
        ["action", "action_value"],
    ),
}


@pytest.mark.skipif(not compiler_available(), reason="no C++ compiler")
@pytest.mark.parametrize("how", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
@pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)
def test_a_compiled_policy_acts_as_it_does(make, how, monkeypatch):
    """With the same random numbers, from one graph of its network."""
    graphs = []
    monkeypatch.setattr(
        torch._inductor.compile_fx, "compile_fx", lambda graph, _: graphs.append(graph) or graph
    )
    torch.manual_seed(0)
    policy, keys = make()
    observations, actions = torch.randn(20, OBSERVATION), []
    for compile_policy in (False, True):
        act = policy_function(policy, keys, compile_policy)
        torch.manual_seed(1)
        with torch.no_grad(), set_exploration_type(how):
            actions.append([act(observation) for observation in observations])
    assert len(graphs) == 1
    torch.testing.assert_close(actions[1], actions[0])
