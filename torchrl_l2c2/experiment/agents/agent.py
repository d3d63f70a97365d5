"""The agent: everything that learns in a run, built from an algorithm's settings."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.optim import Optimizer
from torchrl.modules import AdditiveGaussianModule, EGreedyModule, OrnsteinUhlenbeckProcessModule
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import GAE

from torchrl_l2c2.experiment.agents.normalization import Normalization

# They look into their tensors to decide what to do, which a graph cannot.
EXPLORING = (AdditiveGaussianModule, EGreedyModule, OrnsteinUhlenbeckProcessModule)


@dataclass
class Agent:
    """Everything that learns in a run.

    Attributes:
        loss: regularized.
        policy: acts; shares its parameters with ``loss``, so it is always the current one, or is
            a copy on the CPU (:meth:`act_on_cpu`).
        optimizer: of all of the loss's parameters.
        target_updater: moves the target networks when the policy is updated, as in TD3; ``None``
            without any.
        advantage: estimates advantages of an episode, for on-policy learning.
        max_grad_norm: norm that gradients are scaled down to; ``None`` leaves them.
        policy_terms: the algorithm's own terms that train the policy; a regularizer's loss knows
            its own.
        policy_delay: updates of the values per update of the policy.
        normalization: normalization of the training data, also inside ``policy``; or ``None``.
    """

    loss: LossModule
    policy: TensorDictModule
    optimizer: Optimizer
    target_updater: TargetNetUpdater | None = None
    advantage: GAE | None = None
    max_grad_norm: float | None = None
    policy_terms: frozenset[str] = field(default_factory=frozenset)
    policy_delay: int = 1
    normalization: Normalization | None = None
    _trained: nn.Module | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.policy_terms |= getattr(self.loss, "policy_terms", frozenset())

    @property
    def exploration(self) -> nn.Module | None:
        """The part of ``policy`` that only explores; ``None`` where it samples."""
        return exploring_in(self.policy)

    @property
    def device(self) -> torch.device:
        """Device of the loss's parameters, and of its batches."""
        return next(self.loss.parameters()).device

    def as_learned(self, transitions: TensorDictBase, reward_factor: float) -> TensorDictBase:
        """A copy of transitions as the loss reads them: scaled rewards, its device, advantages."""
        scaled = transitions["next", "reward"] * reward_factor
        transitions = transitions.copy().set(("next", "reward"), scaled)
        if self.device.type != "cpu":  # Finding out that all is there takes long, too.
            transitions = transitions.to(self.device)
        return transitions if self.advantage is None else self.advantage(transitions)

    def load_networks(self, state: Mapping[str, Any]) -> None:
        """Restores what a policy acts by: networks, their inputs' scales, exploration."""
        self.loss.load_state_dict(state["loss"])
        if self.exploration is not None:
            self.exploration.load_state_dict(state["exploration"])
        if self.normalization is not None:
            self.normalization.load_state_dict(state["normalization"])

    def act_on_cpu(self) -> None:
        """Has a copy of the policy act on the CPU, whatever the device of the loss is.

        For one observation after the other the way to another device takes longer than the policy.
        """
        self._trained = network_of(self.policy)
        self.policy = deepcopy(self.policy).to("cpu")

    @torch.no_grad()
    def refresh_policy(self) -> None:
        """Gives a copy of the policy that acts the parameters as they are now."""
        if self._trained is None:
            return
        acting, trained = network_of(self.policy).state_dict(), self._trained.state_dict()
        for name, value in acting.items():
            value.copy_(trained[name])


def exploring_in(policy: TensorDictModule) -> nn.Module | None:
    """The module of TorchRL's at the end of a policy that only explores; ``None`` without one."""
    last = policy[-1] if isinstance(policy, TensorDictSequential) else None
    return last if isinstance(last, EXPLORING) else None


def network_of(policy: TensorDictModule) -> TensorDictModule:
    """The policy without what only explores."""
    return policy if exploring_in(policy) is None else policy[:-1]
