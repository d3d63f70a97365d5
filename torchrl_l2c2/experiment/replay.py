"""Replay buffers, and learning from them without a detour for every batch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import (
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from torchrl_l2c2.experiment.agents import Agent, make_update
from torchrl_l2c2.experiment.config import (
    AlgorithmConfig,
    ExperimentConfig,
    L2C2Config,
    PrioritizedReplayConfig,
    RolloutReplayConfig,
)
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.transforms import NeighborTransform


def make_replay(config: ExperimentConfig) -> TensorDictReplayBuffer:
    """The replay buffer; for L2C2 its batches have neighbors."""
    replay, algorithm = config.replay, config.algorithm
    generator = torch.Generator().manual_seed(config.seed)
    if isinstance(replay, RolloutReplayConfig):
        # The last episodes may go past the rollout's frames.
        storage = LazyTensorStorage(algorithm.frames + config.num_workers * config.task.max_steps)
        buffer = TensorDictReplayBuffer(
            storage=storage,
            sampler=SamplerWithoutReplacement(),
            batch_size=replay.batch_size,
            generator=generator,
        )
    elif isinstance(replay, PrioritizedReplayConfig):
        buffer = TensorDictPrioritizedReplayBuffer(
            alpha=replay.alpha,
            beta=replay.beta,
            priority_key="td_error",
            storage=LazyTensorStorage(replay.capacity),
            batch_size=replay.batch_size,
            generator=generator,
        )
    else:
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(replay.capacity),
            batch_size=replay.batch_size,
            generator=generator,
        )
    if isinstance(config.regularizer, L2C2Config):
        regularizer = config.regularizer
        buffer.append_transform(
            NeighborTransform(
                Neighborhood(regularizer.sigma, regularizer.lambda_min, regularizer.lambda_max),
                num_samples=regularizer.num_samples,
                generator=torch.Generator().manual_seed(config.seed),
            )
        )
    return buffer


def scale_reward(batch: TensorDictBase, algorithm: AlgorithmConfig) -> TensorDictBase:
    """A batch with the rewards that are learned from."""
    factor = 1.0 - algorithm.gamma if algorithm.reward_scale is None else algorithm.reward_scale
    return batch.copy().set(("next", "reward"), batch["next", "reward"] * factor)


class Draw(NamedTuple):
    """What was drawn for one update: everything that tells its batch from others.

    Attributes:
        stored: the storage's tensors, ``[capacity, ...]`` each.
        index: rows of the batch, ``[B]``.
        weight: importance weights, ``[B]``; ``None`` without priorities.
        uniform: random numbers of the neighbors; ``None`` without these.
    """

    stored: tuple[Tensor, ...]
    index: Tensor
    weight: Tensor | None
    uniform: Tensor | None


class ReplayUpdate:
    """Updates from a replay buffer: as ``sample``, update and ``update_tensordict_priority``.

    The numbers are the same, to rounding where the update is compiled. But the batch is gathered
    from the storage, and its neighbors are placed, within the update: compiled, they are a part of
    its graph, which then costs next to nothing, whereas making the batch's TensorDicts takes about
    as long as the rest of the update.

    Args:
        agent (Agent): what is updated, in place.
        replay (TensorDictReplayBuffer): as :func:`make_replay` makes it.

    Keyword Args:
        compile (bool): as for :func:`make_update`.
        skip_nonfinite (bool): as for :func:`make_update`.
    """

    def __init__(
        self,
        agent: Agent,
        replay: TensorDictReplayBuffer,
        *,
        compile: bool,
        skip_nonfinite: bool = False,
    ) -> None:
        self._replay = replay
        self._prioritized = isinstance(replay, TensorDictPrioritizedReplayBuffer)
        transforms = list(replay.transform.transforms)
        self._neighbors: NeighborTransform | None = transforms[0] if transforms else None
        self._source: TensorDictBase | None = None
        self._names: tuple[NestedKey, ...] = ()
        self._stored: tuple[Tensor, ...] = ()
        self.update = make_update(
            agent, compile=compile, skip_nonfinite=skip_nonfinite, read=self._read
        )

    def __call__(self, with_policy: bool) -> tuple[Tensor, Tensor | None] | None:
        """One update, which sets the batch's priorities as well.

        Args:
            with_policy (bool): whether the policy is updated too.

        Returns:
            tuple: as the function that :func:`make_update` returns.
        """
        draw = self.draw()
        result = self.update(with_policy, *draw)
        if result is not None:
            self.prioritize(draw.index, result[1])
        return result

    def draw(self) -> Draw:
        """Draws the rows of a batch, and the random numbers for their neighbors."""
        storage = self._replay.storage
        if storage._storage is not self._source:
            self._source = storage._storage
            self._names, self._stored = zip(*self._source.items(True, True), strict=True)
        index, info = self._replay.sampler.sample(storage, self._replay.batch_size)
        uniform = None
        if self._neighbors is not None:
            near, count = self._neighbors.neighborhood, self._neighbors.num_samples
            # Only the shape of the states counts: any rows will do.
            states = self._source.get("observation")[: len(index)]
            uniform = near.draw(states, count, self._neighbors.generator)
        return Draw(self._stored, index, info.get("priority_weight"), uniform)

    def prioritize(self, index: Tensor, priority: Tensor | None) -> None:
        """Sets the priorities of rows, where the buffer has any."""
        if self._prioritized and priority is not None:
            self._replay.sampler.update_priority(index, priority, storage=self._replay.storage)

    def _read(
        self,
        stored: tuple[Tensor, ...],
        index: Tensor,
        weight: Tensor | None,
        uniform: Tensor | None,
    ) -> TensorDictBase:
        """The batch that ``replay.sample`` would have given."""
        batch = TensorDict(batch_size=index.shape)
        for name, tensor in zip(self._names, stored, strict=True):
            batch.set(name, tensor[index])
        if weight is not None:
            batch.set("priority_weight", weight)
        if uniform is None:
            return batch
        return self._neighbors.place(batch, TensorDict({"observation": uniform}, index.shape))
