"""Settings of CAPS, the method that the paper compares with."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class CAPSConfig(GainConfig):
    """Settings of CAPSLoss."""

    name: str = "caps"
    sigma: float = Field(
        default=0.2, gt=0, description="standard deviation of the noise on the state [paper]"
    )
    lambda_temporal: float = Field(
        default=0.01, ge=0, description="gain of the distance between s and s' [paper]"
    )
    lambda_spatial: float = Field(
        default=0.05, ge=0, description="gain of the distance between s and its noisy copy [paper]"
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import CAPSLoss

        return CAPSLoss(loss, self.sigma, self.lambda_temporal, self.lambda_spatial, mean=self.mean)
