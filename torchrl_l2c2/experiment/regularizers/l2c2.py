"""Settings of L2C2, the paper's method."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.regularizers.base import GainConfig
from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    import torch
    from torchrl.objectives import LossModule

    from torchrl_l2c2.neighborhood import Neighborhood
    from torchrl_l2c2.transforms import NeighborTransform


@settings
class L2C2Config(GainConfig):
    """Settings of L2C2Loss, the paper's method."""

    name: str = "l2c2"
    sigma: float = Field(
        default=1.0,
        gt=0,
        description="size of the neighborhood relative to the step from s to s' [paper]",
    )
    lambda_min: float = Field(
        default=0.01, gt=0, description="gain at the edge of the neighborhood [paper]"
    )
    lambda_max: float = Field(
        default=1.0, gt=0, description="gain at the center of the neighborhood [paper]"
    )
    shared: bool = Field(
        default=False,
        description="line neighborhood (one random number for all dimensions of the state) instead "
        "of a box neighborhood (one for each) [paper: box]",
    )
    max_step: float | None = Field(
        default=None,
        gt=0,
        description="longest step from s to s' that counts, in the observation's units (with "
        "algorithm.normalize_observations, in standard deviations); excludes resets and teleports; "
        "null: no limit [paper]",
    )
    beta: float = Field(
        default=0.1,
        ge=0,
        description="gain of the value terms relative to the policy term [paper]",
    )
    num_samples: int = Field(default=1, ge=1, description="neighbors per transition [inferred: 1]")
    over_neighbors: Literal["mean", "max"] = Field(
        default="mean",
        description="mean over a transition's neighbors [paper] or the largest penalty, which "
        "needs num_samples above 1",
    )
    fraction: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of the batch that has neighbors; smaller values save time in large "
        "batches and make the terms noisier [paper: all]",
    )
    policy_distance: Literal["hellinger", "mean", "mse", "kl"] = Field(
        default="hellinger",
        description="distance of policies: hellinger [paper]; mean: half the squared distance of "
        "the means before the squashing; mse: their mean squared error over the action's "
        "dimensions; kl: the KL divergence. Each needs other gains. For deterministic policies "
        "(td3), hellinger and mean are half the squared distance of the actions",
    )

    tchebycheff_mu: float | None = Field(
        default=None,
        gt=0,
        description="temperature of the smooth maximum of the policy's loss and its penalty, which "
        "the policy minimizes; larger values are smoother; null: their sum [paper]",
    )
    tchebycheff_ideal: float | None = Field(
        default=None,
        description="smallest expected policy loss, with tchebycheff_mu; for example minus the "
        "largest value; null: 0",
    )

    def __post_init__(self) -> None:
        GainConfig.__post_init__(self)
        if self.lambda_max <= (least := max(1.0, self.sigma) * self.lambda_min):
            raise SettingError(
                "lambda_max",
                f"must be above lambda_min and above sigma * lambda_min, here above {least:g}, got "
                f"{self.lambda_max:g}: raise it, or lower lambda_min or sigma.",
            )
        if self.over_neighbors == "max" and self.num_samples == 1:
            raise SettingError("num_samples", "must be above 1 with over_neighbors=max, got 1.")
        if self.tchebycheff_ideal is not None and self.tchebycheff_mu is None:
            raise SettingError(
                "tchebycheff_ideal",
                f"works only with tchebycheff_mu, got {self.tchebycheff_ideal}: set both.",
            )

    @property
    def neighborhood(self) -> Neighborhood:
        """The neighborhood of the loss and the transform."""
        from torchrl_l2c2.neighborhood import Neighborhood

        return Neighborhood(
            self.sigma, self.lambda_min, self.lambda_max, shared=self.shared, max_step=self.max_step
        )

    def wrap(self, loss: LossModule) -> LossModule:
        from torchrl_l2c2.objectives import L2C2Loss
        from torchrl_l2c2.objectives.tchebycheff import TchebycheffLoss

        loss = L2C2Loss(
            loss,
            neighborhood=self.neighborhood,
            beta=self.beta,
            num_samples=self.num_samples,
            over_neighbors=self.over_neighbors,
            fraction=self.fraction,
            policy_distance=self.policy_distance,
        )
        if self.tchebycheff_mu is None:
            return loss
        return TchebycheffLoss(loss, self.tchebycheff_mu, (self.tchebycheff_ideal or 0.0, 0.0))

    def neighbors(self, generator: torch.Generator) -> NeighborTransform:
        from torchrl_l2c2.transforms import NeighborTransform

        return NeighborTransform(
            self.neighborhood, num_samples=self.num_samples, generator=generator
        )
