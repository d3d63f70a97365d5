"""Grad-CAPS, a rival: the change of the action's change."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class GradCAPSConfig(GainConfig):
    """A rival, GradCAPSLoss; frames keep the observation before theirs."""

    reads_previous: ClassVar[bool] = True

    name: str = "grad_caps"
    lambda_temporal: float = Field(
        default=0.01, ge=0, description="gain of the change of the action's change [inferred]"
    )
    epsilon: float = Field(
        default=0.1, gt=0, description="smaller ones punish zigzags around one place more"
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.experiment.frames import PREVIOUS
        from torchrl_l2c2.objectives import GradCAPSLoss

        return GradCAPSLoss(
            loss, self.lambda_temporal, self.epsilon, previous_key=PREVIOUS, mean=self.mean
        )
