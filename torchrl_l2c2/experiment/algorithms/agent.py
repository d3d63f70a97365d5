"""What an algorithm's settings make: everything that learns in a run."""

from __future__ import annotations

from dataclasses import dataclass, field

from tensordict.nn import TensorDictModule
from torch import nn
from torch.optim import Optimizer
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import GAE


@dataclass
class Agent:
    """Everything that learns in a run.

    Attributes:
        loss: regularized.
        policy: acts; shares its parameters with ``loss``, so it is always the current one.
        optimizer: of all of the loss's parameters.
        target_updater: moves the target networks after every update; ``None`` without any.
        exploration: the part of ``policy`` that only explores; ``None`` where it samples.
        advantage: estimates advantages of an episode, for on-policy learning.
        max_grad_norm: norm that gradients are scaled down to; ``None`` leaves them.
        policy_terms: the algorithm's own terms that train the policy; a regularizer's loss knows
            its own.
        policy_delay: updates of the values per update of the policy.
    """

    loss: LossModule
    policy: TensorDictModule
    optimizer: Optimizer
    target_updater: TargetNetUpdater | None = None
    exploration: nn.Module | None = None
    advantage: GAE | None = None
    max_grad_norm: float | None = None
    policy_terms: frozenset[str] = field(default_factory=frozenset)
    policy_delay: int = 1

    def __post_init__(self) -> None:
        self.policy_terms |= getattr(self.loss, "policy_terms", frozenset())

    @property
    def policy_compiles(self) -> bool:
        """Whether the policy compiles: modules that only explore take decisions that do not."""
        return self.exploration is None
