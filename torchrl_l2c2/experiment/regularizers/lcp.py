"""Settings of LCP: a penalty on the gradient of the log-likelihood."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import GainConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class LCPConfig(GainConfig):
    """Settings of LCPLoss."""

    name: str = "lcp"
    coeff: float = Field(default=0.002, ge=0, description="gain of the squared gradient")
    of: Literal["log_prob", "mean"] = Field(
        default="log_prob",
        description="function to differentiate: the log-likelihood [the authors' choice] or the "
        "mean action, whose gradient does not fall when the policy gets wider",
    )

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import LCPLoss

        return LCPLoss(loss, self.coeff, of=self.of)
