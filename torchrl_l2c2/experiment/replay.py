"""The replay buffers that a run can choose from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    from torchrl.data import TensorDictReplayBuffer


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
        # The least priority, 1e-8, to a higher power is 0, which cannot be drawn.
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

    def make(self, seed: int, longest_rollout: int, device: str = "cpu") -> TensorDictReplayBuffer:
        """The buffer; how long a rollout may be does not matter to it.

        Raises:
            SettingError: torchrl's compiled trees are not loaded with this version of torch.
        """
        import torch
        from torchrl.data import LazyTensorStorage, TensorDictPrioritizedReplayBuffer
        from torchrl.data.replay_buffers.samplers import SumSegmentTreeFp32

        if SumSegmentTreeFp32 is None:
            raise SettingError(
                "replay",
                f"{self.name!r} needs torchrl's compiled trees, which torchrl 0.14.1 loads with "
                f"torch 2.14 or newer, got torch {torch.__version__}. Set replay=uniform or "
                'install "torch>=2.14".',
            )
        return TensorDictPrioritizedReplayBuffer(
            alpha=self.alpha,
            beta=self.beta,
            priority_key="td_error",
            storage=LazyTensorStorage(self.capacity, device=device),
            # replay_state reads the trees there; with a storage on a GPU they would lie there.
            sampler_device="cpu",
            batch_size=self.batch_size,
            generator=torch.Generator().manual_seed(seed),
        )


@settings
class UniformReplayConfig:
    """Uniform experience replay."""

    name: str = "uniform"
    capacity: int = Field(default=100_000, ge=1, le=10**12, description="transitions kept")
    batch_size: int = Field(default=256, ge=1, description="transitions per update")

    def __post_init__(self) -> None:
        _check_fits(self.capacity, self.batch_size)

    def make(self, seed: int, longest_rollout: int, device: str = "cpu") -> TensorDictReplayBuffer:
        """The buffer; how long a rollout may be does not matter to it."""
        import torch
        from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.capacity, device=device),
            batch_size=self.batch_size,
            generator=torch.Generator(device).manual_seed(seed),
        )


@settings
class RolloutReplayConfig:
    """The frames of one rollout, each used once per epoch, for on-policy learning."""

    name: str = "rollout"
    batch_size: int = Field(default=64, ge=1, description="transitions per update")

    def make(self, seed: int, longest_rollout: int, device: str = "cpu") -> TensorDictReplayBuffer:
        """The buffer, with room for the longest rollout."""
        import torch
        from torchrl.data import (
            LazyTensorStorage,
            SamplerWithoutReplacement,
            TensorDictReplayBuffer,
        )

        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(longest_rollout, device=device),
            sampler=SamplerWithoutReplacement(),
            batch_size=self.batch_size,
            generator=torch.Generator(device).manual_seed(seed),
        )


ReplayConfig = PrioritizedReplayConfig | UniformReplayConfig | RolloutReplayConfig
REPLAYS: dict[str, ReplayConfig] = {
    "prioritized": PrioritizedReplayConfig(),
    "uniform": UniformReplayConfig(),
    "rollout": RolloutReplayConfig(),
}
