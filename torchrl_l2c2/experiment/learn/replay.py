"""Replay buffers from settings."""

from __future__ import annotations

import torch
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.data.replay_buffers.samplers import SumSegmentTreeFp32

from torchrl_l2c2.experiment.agents.regularizers import make_neighbors
from torchrl_l2c2.experiment.envs.environments import time_limit
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.experiment.settings.replay import (
    PrioritizedReplayConfig,
    ReplayConfig,
    RolloutReplayConfig,
)

# Added to a run's seed for its neighbors, as others are for tests and noise: far from all of them.
NEIGHBOR_SEED = 32_452_843


def make_replay(config: ExperimentConfig) -> TensorDictReplayBuffer:
    """Builds the replay buffer of a run; its batches have what the regularizer needs.

    Raises:
        SettingError: prioritized replay needs TorchRL's compiled trees, which are not loaded with
            this version of torch.
    """
    # The last episode may exceed the rollout's frames.
    longest = config.algorithm.frames + time_limit(config.task)
    buffer = make_buffer(config.replay, config.seed, longest, config.device)
    # Another seed than the sampler's: with one number for a neighbor both draw as many at a
    # time, and where a transition lies would say which neighbor it gets.
    generator = torch.Generator(config.device).manual_seed(config.seed + NEIGHBOR_SEED)
    if (transform := make_neighbors(config.regularizer, generator)) is not None:
        buffer.append_transform(transform)
    return buffer


def make_buffer(
    config: ReplayConfig, seed: int, longest_rollout: int, device: str = "cpu"
) -> TensorDictReplayBuffer:
    """Builds a replay buffer without transforms.

    Args:
        config (PrioritizedReplayConfig, UniformReplayConfig or RolloutReplayConfig): the settings.
        seed (int): seed of the sampling.
        longest_rollout (int): capacity, in frames, for a rollout's buffer.
        device (str): device of the storage. Default ``"cpu"``.

    Raises:
        SettingError: as :func:`make_replay`.
    """
    if isinstance(config, PrioritizedReplayConfig):
        if SumSegmentTreeFp32 is None:
            raise SettingError(
                "replay",
                f"{config.name!r} needs torchrl's compiled trees, which torchrl 0.14.1 loads with "
                f"torch 2.14 or newer, got torch {torch.__version__}. Set replay=uniform or "
                'install "torch>=2.14".',
            )
        return TensorDictPrioritizedReplayBuffer(
            alpha=config.alpha,
            beta=config.beta,
            priority_key="td_error",
            storage=LazyTensorStorage(config.capacity, device=device),
            # replay_state reads the trees there; with a storage on a GPU they would lie there.
            sampler_device="cpu",
            batch_size=config.batch_size,
            generator=torch.Generator().manual_seed(seed),
        )
    generator = torch.Generator(device).manual_seed(seed)
    if isinstance(config, RolloutReplayConfig):
        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(longest_rollout, device=device),
            sampler=SamplerWithoutReplacement(),
            batch_size=config.batch_size,
            generator=generator,
        )
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(config.capacity, device=device),
        batch_size=config.batch_size,
        generator=generator,
    )
