"""L2C2, the paper's method."""

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
    """The paper's method, L2C2Loss."""

    name: str = "l2c2"
    sigma: float = Field(
        default=1.0,
        gt=0,
        description="size of the neighborhood relative to the step from s to s' [paper]",
    )
    lambda_min: float = Field(
        default=0.01, gt=0, description="gain at the edge of the neighborhood [paper]"
    )
    lambda_max: float = Field(default=1.0, gt=0, description="gain at its center [paper]")
    shared: bool = Field(
        default=False,
        description="one draw for all dimensions of the state, and not one for each [paper: each]",
    )
    max_step: float | None = Field(
        default=None,
        gt=0,
        description="longest step from s to s' that counts, in the observation's units (with "
        "algorithm.normalize_observations in its deviations): a reset or a teleport is longer; "
        "null: all [paper]",
    )
    beta: float = Field(
        default=0.1,
        ge=0,
        description="gain of the value's regularization relative to the policy's [paper]",
    )
    num_samples: int = Field(default=1, ge=1, description="neighbors per transition [inferred: 1]")
    over_neighbors: Literal["mean", "max"] = Field(
        default="mean",
        description="mean over a transition's neighbors [paper], or the largest of them, which "
        "needs num_samples above 1",
    )
    fraction: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of the batch that has neighbors; smaller ones cost less in large "
        "batches, and are noisier [paper: all]",
    )
    policy_distance: Literal["hellinger", "mean", "mse", "kl"] = Field(
        default="hellinger",
        description="how policies are compared: hellinger [paper], half the squared distance of "
        "their means before the squashing, these means' squared error, a mean over the action's "
        "dimensions, or the KL divergence; they need other gains; of deterministic policies (td3) "
        "the first two are half the squared distance of the actions",
    )

    tchebycheff_mu: float | None = Field(
        default=None,
        gt=0,
        description="the policy descends the smooth maximum of its loss and its regularization, "
        "smoother for larger values; null: their sum [paper]",
    )
    tchebycheff_ideal: float | None = Field(
        default=None,
        description="of tchebycheff_mu: the policy's loss that is hoped for, as minus the largest "
        "value; null: 0",
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
                f"is of tchebycheff_mu, which is null, got {self.tchebycheff_ideal}: set both.",
            )

    @property
    def neighborhood(self) -> Neighborhood:
        """Where neighbors are drawn, for the loss and the transform alike."""
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
