"""The agent of a run: loss, policy, optimizer and target networks."""

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

# They branch on tensor values, which a graph cannot.
EXPLORATION_MODULES = (AdditiveGaussianModule, EGreedyModule, OrnsteinUhlenbeckProcessModule)


@dataclass
class Agent:
    """Loss, policy, optimizer and target networks of a run.

    Attributes:
        loss: Loss with the regularizer's terms.
        policy: Policy that acts. It shares its parameters with ``loss``, or is a copy on the CPU
            (:meth:`act_on_cpu`).
        optimizer: Optimizer of all parameters of the loss.
        target_updater: Updater of the target networks, called when the policy is updated, as in
            TD3; ``None`` without target networks.
        advantage: Advantage estimator of on-policy algorithms, or ``None``.
        max_grad_norm: Maximum norm of the gradient; larger gradients are scaled down. ``None``: no
            maximum.
        policy_terms: Keys of the loss terms that train the policy. The regularizer's terms are
            added automatically.
        policy_delay: Value updates per update of the policy.
        normalization: Normalization of the training data and inside ``policy``, or ``None``.
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
    def device(self) -> torch.device:
        """Device of the loss's parameters and batches."""
        return next(self.loss.parameters()).device

    def prepare_for_loss(self, transitions: TensorDictBase, reward_factor: float) -> TensorDictBase:
        """Returns a copy of transitions on the loss's device, with scaled rewards and advantages.

        Args:
            transitions (TensorDictBase): Transitions ``[T]``.
            reward_factor (float): Factor on the rewards.
        """
        scaled = transitions["next", "reward"] * reward_factor
        transitions = transitions.copy().set(("next", "reward"), scaled)
        if self.device.type != "cpu":  # The call is slow even if nothing is moved.
            transitions = transitions.to(self.device)
        return transitions if self.advantage is None else self.advantage(transitions)

    def load_networks(self, state: Mapping[str, Any]) -> None:
        """Restores the networks and the normalization from a checkpoint."""
        self.loss.load_state_dict(state["loss"])
        if self.normalization is not None:
            self.normalization.load_state_dict(state["normalization"])

    def act_on_cpu(self) -> None:
        """Replaces the acting policy by a copy on the CPU.

        For single observations, the transfer to another device takes longer than the policy.
        """
        self._trained = without_exploration(self.policy)
        self.policy = deepcopy(self.policy).to("cpu")

    @torch.no_grad()
    def refresh_policy(self) -> None:
        """Copies the current parameters to the acting policy on the CPU, if there is one."""
        if self._trained is None:
            return
        acting, trained = without_exploration(self.policy).state_dict(), self._trained.state_dict()
        for name, value in acting.items():
            value.copy_(trained[name])


def exploration_module(policy: TensorDictModule) -> nn.Module | None:
    """Returns the exploration module of TorchRL at the end of a policy, or ``None``."""
    last = policy[-1] if isinstance(policy, TensorDictSequential) else None
    return last if isinstance(last, EXPLORATION_MODULES) else None


def without_exploration(policy: TensorDictModule) -> TensorDictModule:
    """Returns the policy without its exploration module."""
    return policy if exploration_module(policy) is None else policy[:-1]
