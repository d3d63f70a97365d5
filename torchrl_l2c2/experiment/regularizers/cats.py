"""CATS, a rival: the temporal term alone, on a ramp."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class CATSConfig(GainConfig):
    """A rival, CATSLoss, with its linear ramp over the training."""

    name: str = "cats"
    gain: Literal["constant", "ramp", "target"] = Field(
        default="ramp", description="as for the others; the ramp is the method's own"
    )
    lambda_temporal: float = Field(
        default=0.1, ge=0, description="gain of the distance between s and s' [inferred]"
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import CATSLoss

        return CATSLoss(loss, self.lambda_temporal, mean=self.mean)
