"""Settings of the replay buffers."""

from __future__ import annotations

from pydantic import Field

from torchrl_l2c2.experiment.settings.fields import SettingError, settings


def _check_fits(capacity: int, batch_size: int) -> None:
    if capacity < batch_size:
        raise SettingError(
            "capacity", f"must be at least the batch_size ({batch_size}), got {capacity}."
        )


@settings
class PrioritizedReplayConfig:
    """Prioritized experience replay."""

    name: str = "prioritized"
    capacity: int = Field(default=10_000, ge=1, le=10**12, description="transitions kept [paper]")
    batch_size: int = Field(default=32, ge=1, description="transitions per update [paper]")
    alpha: float = Field(
        # The least priority, 1e-8, raised to a higher power is 0, which is never sampled.
        default=1.0,
        ge=0,
        le=4,
        description="exponent of the priorities; 0 is uniform [paper]",
    )
    beta: float = Field(
        default=0.5,
        ge=0,
        description="exponent of the importance weights; 1 corrects fully [paper]",
    )

    def __post_init__(self) -> None:
        _check_fits(self.capacity, self.batch_size)


@settings
class UniformReplayConfig:
    """Uniform experience replay."""

    name: str = "uniform"
    capacity: int = Field(default=100_000, ge=1, le=10**12, description="transitions kept")
    batch_size: int = Field(default=256, ge=1, description="transitions per update")

    def __post_init__(self) -> None:
        _check_fits(self.capacity, self.batch_size)


@settings
class RolloutReplayConfig:
    """Frames of one rollout, each used once per epoch, for on-policy learning."""

    name: str = "rollout"
    batch_size: int = Field(
        default=64, ge=1, description="transitions per update; at most a whole rollout"
    )


ReplayConfig = PrioritizedReplayConfig | UniformReplayConfig | RolloutReplayConfig
REPLAYS: dict[str, ReplayConfig] = {
    "prioritized": PrioritizedReplayConfig(),
    "uniform": UniformReplayConfig(),
    "rollout": RolloutReplayConfig(),
}
