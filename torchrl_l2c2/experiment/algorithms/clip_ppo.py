"""TorchRL's clipped PPO, with an entropy bonus that can be a part of a graph."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution
from torchrl.modules.distributions import has_analytic_entropy
from torchrl.objectives import ClipPPOLoss


class TraceableClipPPOLoss(ClipPPOLoss):
    """Takes an entropy that has a closed form as it is.

    TorchRL's loss looks whether it is finite, and otherwise estimates it: what a graph computes
    may not depend on that. That of a normal with a positive scale is finite.
    """

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        if has_analytic_entropy(dist):
            return dist.entropy().unsqueeze(-1)
        return super()._get_entropy(dist, adv_shape)
