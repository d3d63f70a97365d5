"""What every regularizer's settings make."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torchrl.envs import Transform
    from torchrl.objectives import LossModule


class RegularizerConfig:
    """Makes a regularized loss and, where batches are to hold more for it, a transform."""

    name: str

    def wrap(self, loss: LossModule) -> LossModule:
        """The loss with the regularizer's terms."""
        raise NotImplementedError

    def transform(self, generator: torch.Generator) -> Transform | None:
        """What the replay buffer's batches go through; ``None`` where the loss needs nothing."""
        return None
