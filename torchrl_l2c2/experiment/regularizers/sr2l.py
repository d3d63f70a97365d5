"""Settings of SR2L: the worst state in a small box."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class SR2LConfig(GainConfig):
    """Settings of SR2LLoss. An update takes several times as long as with other regularizers."""

    name: str = "sr2l"
    epsilon: float = Field(
        default=0.05, gt=0, description="half the width of the box, in the observation's units"
    )
    coeff: float = Field(default=0.1, ge=0, description="gain of the largest distance in the box")
    steps: int = Field(default=10, ge=1, description="ascent steps to the largest distance")
    policy_distance: Literal["jeffreys", "hellinger", "mean", "mse", "kl"] = Field(
        default="jeffreys",
        description="distance of policies; deterministic policies are compared by their actions, "
        "and kl does not work with them",
    )

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import SR2LLoss

        return SR2LLoss(
            loss, self.epsilon, self.coeff, steps=self.steps, policy_distance=self.policy_distance
        )
