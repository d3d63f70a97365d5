"""Settings of Grad-CAPS: the second difference of the actions."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class GradCAPSConfig(GainConfig):
    """Settings of GradCAPSLoss. Batches have the previous observation."""

    reads_previous: ClassVar[bool] = True

    name: str = "grad_caps"
    lambda_temporal: float = Field(
        default=0.01, ge=0, description="gain of the action's second difference [inferred]"
    )
    epsilon: float = Field(
        default=0.1,
        gt=0,
        description="constant in the denominator; smaller values penalize small zigzags more",
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.experiment.frames import PREVIOUS
        from torchrl_l2c2.objectives import GradCAPSLoss

        return GradCAPSLoss(
            loss, self.lambda_temporal, self.epsilon, previous_key=PREVIOUS, mean=self.mean
        )
