"""The optimizers that a run can choose from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    from torch.nn import Parameter
    from torch.optim import Optimizer


@settings
class AdaTermConfig:
    """The paper's optimizer, AdaTerm, at one learning rate."""

    linear: ClassVar[bool] = False

    name: str = "adaterm"
    lr: float = Field(default=1e-3, ge=0, description="learning rate [paper]")
    beta: float = Field(default=0.9, gt=0, lt=1, description="decay of the moments [paper]")
    eps: float = Field(default=1e-5, gt=1.1e-19, description="smallest scale of a gradient [paper]")
    nu_min: float = Field(
        default=1.0, gt=0, description="fewest degrees of freedom; larger is less robust [paper]"
    )

    def make(self, parameters: Iterable[Parameter]) -> Optimizer:
        """The optimizer of these parameters."""
        from torchrl_l2c2.optim import AdaTerm

        return AdaTerm(parameters, lr=self.lr, beta=self.beta, eps=self.eps, nu_min=self.nu_min)


@settings
class AdamConfig:
    """Adam."""

    name: str = "adam"
    lr: float = Field(default=3e-4, ge=0, description="learning rate")
    betas: tuple[float, float] = Field(
        default=(0.9, 0.999), description="decay of the first and second moment, each in [0, 1)"
    )
    eps: float = Field(default=1e-8, ge=0, description="added to the denominator")
    linear: bool = Field(
        default=False,
        description="the learning rate falls to 0 in a line over the training that is asked for: a "
        "run that is later continued for longer had a steeper line",
    )

    def __post_init__(self) -> None:
        if not all(0 <= beta < 1 for beta in self.betas):
            raise SettingError("betas", f"must each be in [0, 1), got {list(self.betas)}.")

    def make(self, parameters: Iterable[Parameter]) -> Optimizer:
        """The optimizer of these parameters."""
        import torch

        return torch.optim.Adam(parameters, lr=self.lr, betas=self.betas, eps=self.eps)


def anneal(config: OptimizerConfig, optimizer: Optimizer, done: float) -> None:
    """Sets the learning rate that follows a part of the training, where it changes.

    Args:
        config (AdaTermConfig or AdamConfig): made the optimizer.
        optimizer (Optimizer): its learning rates are set, in place where they are tensors.
        done (float): share of the training that is over; beyond 1 the rate stays at 0.
    """
    import torch

    if not config.linear:
        return
    rate = config.lr * max(0.0, 1.0 - done)
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):  # A compiled step reads it.
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


OptimizerConfig = AdaTermConfig | AdamConfig
OPTIMIZERS: dict[str, OptimizerConfig] = {"adaterm": AdaTermConfig(), "adam": AdamConfig()}
