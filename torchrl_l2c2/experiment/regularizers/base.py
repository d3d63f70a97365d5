"""What every regularizer's settings make, and how those say what sets the gain."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    import torch
    from torchrl.objectives import LossModule

    from torchrl_l2c2.neighborhood import Neighborhood
    from torchrl_l2c2.transforms import NeighborTransform

# The gains that read a setting: with the others it would have no effect.
READ_BY = {
    "gain_target": ("gradient", "target"),
    "gain_of": ("target",),
    "gain_rate": ("gradient", "target"),
    "gain_limit": ("gradient", "target"),
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
            raise SettingError("", f"regularizer={self.name}: {error}") from error

    def neighbors(self, generator: torch.Generator) -> NeighborTransform | None:
        """What draws the neighbors in the replay buffer's batches; ``None`` where none are read."""
        return None


@settings
class GainConfig(RegularizerConfig):
    """A regularizer whose terms have a gain: how it is set in the course of a run."""

    gain: Literal["constant", "ramp", "gradient", "target"] = Field(
        default="constant",
        description="what multiplies the regularizer's gains: 1, a linear ramp from 0 to 1, what "
        "keeps the terms' gradients at gain_target of the loss's own, network by network, or what "
        "keeps gain_of at gain_target or below; set after every episode",
    )
    gain_target: float | None = Field(
        default=None, gt=0, description="of gain=gradient, a ratio of norms, or gain=target"
    )
    gain_of: str = Field(
        default="action_variation",
        description="of gain=target: the column of metrics.csv, of numbers of at least 0, that is "
        "to be at most gain_target",
    )
    gain_rate: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="of gain=gradient and gain=target: how fast the gain's logarithm follows",
    )
    gain_limit: float = Field(
        default=1000.0,
        gt=1,
        description="of gain=gradient and gain=target: the gain is at most this times the first "
        "that was measured, or 1, and at least that divided by this",
    )
    gain_length: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="of gain=ramp: share of the whole training after which the gain is 1",
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

    @property
    def ramped(self) -> bool:
        """As :attr:`RegularizerConfig.ramped`."""
        return self.gain == "ramp"

    @property
    def targets(self) -> dict[str, float]:
        """What gains are to meet, by the names of the settings; nothing where there is none."""
        return {} if self.gain_target is None else {"gain_target": self.gain_target}

    def apply(self, loss: LossModule, gains: Mapping[str, float]) -> None:
        """Sets the gains that a loss has now.

        Args:
            loss (LossModule): made by :meth:`wrap`.
            gains (Mapping): of ``"policy"`` and ``"value"``, or of ``"all"``; 1 where it has none.
        """
        for_all = gains.get("all", 1.0)
        self.set_gains(loss, gains.get("policy", for_all), gains.get("value", for_all))

    def set_gains(self, loss: LossModule, policy: float, value: float) -> None:
        """Multiplies the terms that train the policy and the values, from what the settings say."""
        raise NotImplementedError
