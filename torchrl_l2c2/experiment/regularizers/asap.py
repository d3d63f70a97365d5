"""Settings of ASAP: actions that are predictable from the previous state."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class ASAPConfig(GainConfig):
    """Settings of ASAPLoss. Batches have the previous observation."""

    reads_previous: ClassVar[bool] = True

    name: str = "asap"
    lambda_spatial: float = Field(
        default=0.3,
        ge=0,
        description="gain of the distance to the predicted action [the authors' value for MuJoCo; "
        "0.03 for LunarLander and Pendulum]",
    )
    lambda_temporal: float = Field(
        default=2.0, ge=0, description="gain of the predictor's loss [the authors' value]"
    )
    lambda_grad: float = Field(
        default=0.05,
        ge=0,
        description="gain of the action's second difference [the authors' value for MuJoCo; 0.005 "
        "for LunarLander and Pendulum]",
    )
    epsilon: float = Field(
        default=0.1,
        gt=0,
        description="constant in the denominator; smaller values penalize small zigzags more",
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.experiment.frames import PREVIOUS
        from torchrl_l2c2.objectives import ASAPLoss

        return ASAPLoss(
            loss,
            self.lambda_spatial,
            self.lambda_temporal,
            self.lambda_grad,
            self.epsilon,
            previous_key=PREVIOUS,
            mean=self.mean,
        )
