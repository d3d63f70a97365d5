"""No regularizer: the paper's vanilla."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchrl_l2c2.experiment.regularizers.base import RegularizerConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


@settings
class NoRegularizerConfig(RegularizerConfig):
    """The loss as it is: the paper's vanilla."""

    name: str = "none"

    def wrap(self, loss: LossModule) -> LossModule:
        return loss
