"""What every regularizer's settings make, and how those say what sets the gain."""

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

# The gains that read a setting: with the others it would have no effect.
READ_BY = {
    "gain_target": ("target",),
    "gain_of": ("target",),
    "gain_rate": ("target",),
    "gain_limit": ("target",),
    "gain_length": ("ramp",),
}
# A setting of all who compare means.
COMPARED_MEAN: Any = Field(
    default="loc",
    description="means compared before or after the squashing, which deterministic policies (td3) "
    "have after it alone [inferred: loc]",
)


class RegularizerConfig:
    """Makes a regularized loss and, where batches are to hold neighbors for it, what draws them.

    Attributes:
        reads_previous: whether its batches are to have the observation before each state.
    """

    reads_previous: ClassVar[bool] = False

    name: str

    @property
    def neighborhood(self) -> Neighborhood | None:
        """Where the states lie that it compares with; ``None`` where that is no neighborhood."""
        return None

    @property
    def ramped(self) -> bool:
        """Whether its gain rises over the length of a training."""
        return False

    def wrap(self, loss: LossModule) -> LossModule:
        """The loss with the regularizer's terms."""
        raise NotImplementedError

    def add_to(self, loss: LossModule) -> LossModule:
        """As :meth:`wrap`, for the loss of an algorithm that was chosen.

        Raises:
            SettingError: the regularizer is none for such a loss.
        """
        try:
            return self.wrap(loss)
        except TypeError as error:
            if not raised_by_component(error):
                raise
            raise SettingError("", f"regularizer={self.name}: {error}") from error

    def neighbors(self, generator: torch.Generator) -> NeighborTransform | None:
        """What draws the neighbors in the replay buffer's batches; ``None`` where none are read."""
        return None


@settings
class GainConfig(RegularizerConfig):
    """A regularizer whose terms have a gain: how it is set in the course of a run."""

    strength: float = Field(
        default=1.0,
        ge=0,
        description="factor on the penalty; larger values smooth more, at some point at the cost "
        "of return",
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
                    f"is of gain={' and gain='.join(gains)} alone, got {given} with "
                    f"gain={self.gain}: choose such a gain, or leave {name} at "
                    f"{'null' if usual is None else usual}.",
                )

    def add_to(self, loss: LossModule) -> LossModule:
        """As :meth:`RegularizerConfig.add_to`, at its strength."""
        loss = super().add_to(loss)
        loss.regularizer_gain = self.strength
        return loss

    @property
    def ramped(self) -> bool:
        """As :attr:`RegularizerConfig.ramped`."""
        return self.gain == "ramp"
