"""Settings of the optimizers."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from torchrl_l2c2.experiment.settings.fields import SettingError, settings


@settings
class AdaTermConfig:
    """The paper's optimizer, AdaTerm, with a constant learning rate."""

    linear: ClassVar[bool] = False

    name: str = "adaterm"
    lr: float = Field(default=1e-3, ge=0, description="learning rate [paper]")
    beta: float = Field(default=0.9, gt=0, lt=1, description="decay of the moments [paper]")
    eps: float = Field(default=1e-5, gt=1.1e-19, description="smallest scale of a gradient [paper]")
    nu_min: float = Field(
        default=1.0, gt=0, description="minimum degrees of freedom; larger is less robust [paper]"
    )


@settings
class AdamConfig:
    """Adam."""

    name: str = "adam"
    lr: float = Field(default=3e-4, ge=0, description="learning rate")
    betas: tuple[float, float] = Field(
        default=(0.9, 0.999), description="decay of the first and second moment, each in [0, 1)"
    )
    eps: float = Field(
        default=1e-8,
        ge=0,
        description="constant in the denominator; larger values make smaller steps",
    )
    linear: bool = Field(
        default=False,
        description="linear decay of the learning rate to 0 over the training. If a run is "
        "extended later, its first part has decayed faster than in a run of the full length",
    )

    def __post_init__(self) -> None:
        if not all(0 <= beta < 1 for beta in self.betas):
            raise SettingError("betas", f"must each be in [0, 1), got {list(self.betas)}.")


OptimizerConfig = AdaTermConfig | AdamConfig
OPTIMIZERS: dict[str, OptimizerConfig] = {"adaterm": AdaTermConfig(), "adam": AdamConfig()}
