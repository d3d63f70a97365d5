"""Private TorchRL names that the experiment uses. No other file of it may use any.

``tests/test_internals.py`` compares their results with TorchRL's public functions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Distribution
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import GymWrapper
from torchrl.modules.distributions import has_analytic_entropy
from torchrl.objectives import ClipPPOLoss, LossModule

from torchrl_l2c2.experiment.envs.spaces import Env
from torchrl_l2c2.transforms import ObservationNoise


def simulator_of(env: GymWrapper) -> Env:
    """Returns the Gymnasium environment with its wrappers, to step it without TorchRL.

    The public ``env.unwrapped`` leaves out Gymnasium's wrappers.
    """
    return env._env


def first_observation(collector: Collector) -> Tensor:
    """Returns the observation of the reset in the collector's constructor.

    The public way is another reset, which would change all later random numbers.
    """
    observation: Tensor = collector._carrier.get("observation")
    return observation.clone()


def add_noise(noise: ObservationNoise, observation: Tensor) -> Tensor:
    """Returns the observation with noise. The public call needs a TensorDict at every frame."""
    return noise._apply_transform(observation)


def clear_detached_parameters(loss: LossModule) -> None:
    """Clears the detached parameters that TorchRL's losses cache, also while they are traced."""
    for module in loss.modules():
        if isinstance(module, LossModule):
            module._erase_cache()


def stored_tensors(storage: LazyTensorStorage) -> TensorDictBase | None:
    """Returns the storage's tensors ``[capacity, ...]``; the public ``storage[:]`` copies them."""
    tensors: TensorDictBase | None = storage._storage
    return tensors


class RowWriter:
    """Fast replacement of ``replay.extend`` for single rows, with the same effect on the buffer.

    ``extend`` is made for batches: for one row it takes longer than the rest of a frame.

    Args:
        replay (TensorDictReplayBuffer): Buffer of :func:`~.replay.make_replay`, with one
            batch dimension and a round-robin writer.
    """

    def __init__(self, replay: TensorDictReplayBuffer) -> None:
        self._replay = replay
        # The buffer's properties are slow.
        self._storage, self._writer = replay.storage, replay.writer
        self._source: TensorDictBase | None = None
        self._stored: list[tuple[NestedKey, Tensor]] = []

    def write(self, row: Mapping[NestedKey, Tensor]) -> None:
        """Stores a row. The first row determines which entries are stored.

        Args:
            row (Mapping): Entries by key, without a batch dimension. Entries that the first row did
                not have are ignored.
        """
        if not self._storage.initialized:
            batch = TensorDict(batch_size=[1])
            for key, value in row.items():
                batch.set(key, value.unsqueeze(0).to(self._storage.device))
            self._replay.extend(batch)
            return
        if self._storage._storage is not self._source:  # The first row, or after loading.
            self._source = self._storage._storage
            self._stored = list(self._source.items(True, True))
        cursor, length = self._writer._cursor, self._storage._len
        self._writer._cursor = (cursor + 1) % self._storage.max_size
        self._writer._write_count += 1
        index = torch.tensor([cursor])
        self._storage._set_last_cursor(index)
        self._storage._len = min(length + 1, self._storage.max_size)
        for key, stored in self._stored:
            stored[cursor].copy_(index[0] if key == "index" else row[key])
        self._storage._bump_mutation_revision()
        self._writer._mark_update_entities(index)


def replay_state(replay: TensorDictReplayBuffer) -> dict[str, Any]:
    """Returns a buffer's ``state_dict`` with priorities as tensors instead of C++ objects."""
    state = dict(replay.state_dict())
    if isinstance(replay, TensorDictPrioritizedReplayBuffer):
        sampler = dict(state["_sampler"])
        index = torch.arange(len(replay))
        for tree in ("_sum_tree", "_min_tree"):
            sampler[tree] = torch.as_tensor(sampler[tree][index])
        state["_sampler"] = sampler
    return state


def load_replay_state(replay: TensorDictReplayBuffer, state: Mapping[str, Any]) -> None:
    """Restores a state of :func:`replay_state` into a buffer with the same settings."""
    state = dict(state)
    if isinstance(replay, TensorDictPrioritizedReplayBuffer):
        sampler = dict(state["_sampler"])
        empty = replay.sampler.state_dict()
        for tree in ("_sum_tree", "_min_tree"):
            values = sampler[tree]
            sampler[tree] = empty[tree]
            if len(values):
                sampler[tree][torch.arange(len(values))] = values
        state["_sampler"] = sampler
    replay.load_state_dict(state)
    storage = replay.storage
    if storage._storage is not None:  # An empty storage takes the saved state's device.
        storage._storage = storage._storage.to(storage.device)


class TraceableClipPPOLoss(ClipPPOLoss):
    """TorchRL's clipped PPO loss with an entropy bonus that can be traced.

    TorchRL's loss checks whether the entropy is finite, and otherwise estimates it. A graph cannot
    depend on values, and the entropy of a normal with a positive scale is finite.
    """

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        if has_analytic_entropy(dist):
            return dist.entropy().unsqueeze(-1)
        return super()._get_entropy(dist, adv_shape)
