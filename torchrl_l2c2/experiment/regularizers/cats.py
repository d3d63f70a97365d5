"""Settings of CATS: the temporal term with a ramp."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class CATSConfig(GainConfig):
    """Settings of CATSLoss, with a linear ramp over the training."""

    name: str = "cats"
    gain: Literal["constant", "ramp", "target"] = Field(
        default="ramp", description="schedule of the gain, as for other methods [paper: ramp]"
    )
    lambda_temporal: float = Field(
        default=0.1, ge=0, description="gain of the distance between s and s' [inferred]"
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import CATSLoss

        return CATSLoss(loss, self.lambda_temporal, mean=self.mean)
