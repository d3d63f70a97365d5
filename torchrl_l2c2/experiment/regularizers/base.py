"""Base classes of the regularizers' settings, and the settings of the gain."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.errors import raised_by_component
from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    import torch
    from torchrl.objectives import LossModule

    from torchrl_l2c2.neighborhood import Neighborhood
    from torchrl_l2c2.transforms import NeighborTransform

# Values of ``gain`` with which a setting has an effect.
READ_BY = {
    "gain_target": ("target",),
    "gain_of": ("target",),
    "gain_rate": ("target",),
    "gain_limit": ("target",),
    "gain_length": ("ramp",),
}
# The setting of regularizers that compare means.
COMPARED_MEAN: Any = Field(
    default="loc",
    description="loc: compare means before the squashing; action: after it. No difference for "
    "deterministic policies (td3) [inferred: loc]",
)


class RegularizerConfig:
    """Settings of a regularizer.

    Attributes:
        reads_previous: whether batches must have the previous observation.
    """

    reads_previous: ClassVar[bool] = False

    name: str

    @property
    def neighborhood(self) -> Neighborhood | None:
        """The neighborhood of the compared states; ``None`` without a neighborhood."""
        return None

    @property
    def ramped(self) -> bool:
        """Checks whether the gain is a ramp."""
        return False

    def wrap(self, loss: LossModule) -> LossModule:
        """Adds the regularizer's terms to a loss."""
        raise NotImplementedError

    def add_to(self, loss: LossModule) -> LossModule:
        """Calls :meth:`wrap`; errors name the setting.

        Raises:
            SettingError: the regularizer does not work with this loss.
        """
        try:
            return self.wrap(loss)
        except TypeError as error:
            if not raised_by_component(error):
                raise
            raise SettingError("", f"regularizer={self.name}: {error}") from error

    def neighbors(self, generator: torch.Generator) -> NeighborTransform | None:
        """Makes the transform that draws neighbors in the replay buffer; ``None`` if not needed."""
        return None


@settings
class GainConfig(RegularizerConfig):
    """Settings of a regularizer with a gain, and of the gain's schedule."""

    strength: float = Field(
        default=1.0,
        ge=0,
        description="factor on the penalty; larger values smooth more, too large values lower the "
        "return",
    )
    gain: Literal["constant", "ramp", "target"] = Field(
        default="constant",
        description="schedule of the gain: constant, a linear ramp from 0 to 1, or the gain that "
        "keeps gain_of at or below gain_target; set after every episode",
    )
    gain_target: float | None = Field(
        default=None, gt=0, description="largest value of gain_of with gain=target"
    )
    gain_of: str = Field(
        default="action_variation",
        description="metrics.csv column that gain=target keeps at or below gain_target; its "
        "numbers must be at least 0",
    )
    gain_rate: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="largest change of the gain's logarithm in a step of gain=target",
    )
    gain_limit: float = Field(
        default=1000.0,
        gt=1,
        description="largest gain of gain=target; the smallest is 1 over it",
    )
    gain_length: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of training after which the gain of gain=ramp is 1",
    )

    def __post_init__(self) -> None:
        if self.gain in READ_BY["gain_target"] and self.gain_target is None:
            raise SettingError("gain_target", f"must be given with gain={self.gain}, got null.")
        declared: Any = {field.name: field.default for field in dataclasses.fields(GainConfig)}
        for name, gains in READ_BY.items():
            given, usual = getattr(self, name), declared[name].default
            if self.gain not in gains and given != usual:
                raise SettingError(
                    name,
                    f"works only with gain={' or gain='.join(gains)}, got {given} with "
                    f"gain={self.gain}: change gain, or leave {name} at "
                    f"{'null' if usual is None else usual}.",
                )

    def add_to(self, loss: LossModule) -> LossModule:
        """Calls :meth:`RegularizerConfig.add_to`, and sets the strength."""
        loss = super().add_to(loss)
        loss.regularizer_gain = self.strength
        return loss

    @property
    def ramped(self) -> bool:
        """Checks whether the gain is a ramp."""
        return self.gain == "ramp"
