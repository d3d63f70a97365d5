"""ASAP, a rival: actions that could be predicted from the state before."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import COMPARED_MEAN, GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class ASAPConfig(GainConfig):
    """A rival, ASAPLoss; frames keep the observation before theirs."""

    reads_previous: ClassVar[bool] = True

    name: str = "asap"
    lambda_spatial: float = Field(
        default=0.3,
        ge=0,
        description="gain of the distance to what was predicted [its authors' on MuJoCo, and .03 "
        "on LunarLander and Pendulum]",
    )
    lambda_temporal: float = Field(
        default=2.0, ge=0, description="gain of the predictor's own loss [its authors']"
    )
    lambda_grad: float = Field(
        default=0.05,
        ge=0,
        description="gain of the change of the action's change [its authors' on MuJoCo, and .005 "
        "on LunarLander and Pendulum]",
    )
    epsilon: float = Field(
        default=0.1, gt=0, description="smaller ones punish zigzags around one place more"
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
