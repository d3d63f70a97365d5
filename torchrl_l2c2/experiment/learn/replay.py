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
from torchrl.objectives import LossModule

from torchrl_l2c2.experiment.envs.environments import time_limit
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.experiment.settings.replay import (
    PrioritizedReplayConfig,
    ReplayConfig,
    RolloutReplayConfig,
)
from torchrl_l2c2.objectives import L2C2Loss

# Added to the run's seed for its neighbors, to differ from the seeds of tests and noise.
NEIGHBOR_SEED = 32_452_843


def make_replay(config: ExperimentConfig, loss: LossModule) -> TensorDictReplayBuffer:
    """Builds the replay buffer of a run, including the transform that samples neighbors.

    Args:
        config (ExperimentConfig): Settings of the run.
        loss (LossModule): Loss of the run.

    Raises:
        SettingError: If replay is prioritized, and TorchRL's compiled trees do not support the
            installed version of torch.
    """
    longest = config.algorithm.frames
    if config.algorithm.num_envs is None:  # The last episode may exceed the rollout's frames.
        longest += time_limit(config.task)
    buffer = make_buffer(config.replay, config.seed, longest, config.device)
    if isinstance(loss, L2C2Loss):
        # A different seed from the sampler's: otherwise both would sample the same numbers, and a
        # transition's row would determine its neighbor.
        generator = torch.Generator(config.device).manual_seed(config.seed + NEIGHBOR_SEED)
        buffer.append_transform(loss.neighbor_transform(generator))
    return buffer


def make_buffer(
    config: ReplayConfig, seed: int, longest_rollout: int, device: str = "cpu"
) -> TensorDictReplayBuffer:
    """Builds a replay buffer without transforms.

    Args:
        config (PrioritizedReplayConfig, UniformReplayConfig or RolloutReplayConfig): Settings of
            the buffer.
        seed (int): Random seed of the sampler.
        longest_rollout (int): Capacity in frames, for ``RolloutReplayConfig``.
        device (str): Device of the storage. Default ``"cpu"``.

    Raises:
        SettingError: As :func:`make_replay`.
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
            # replay_state reads the trees on the CPU, also if the storage is on a GPU.
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
