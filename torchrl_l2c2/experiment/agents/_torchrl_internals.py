"""Private names of TorchRL that the experiment uses. No other file of it may use one.

Tests compare what each gives with what TorchRL's public way gives (``tests/test_internals.py``).
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
    """The Gymnasium environment with its wrappers, which is played without TorchRL's own step.

    The public ``env.unwrapped`` is below Gymnasium's wrappers.
    """
    return env._env


def first_observation(collector: Collector) -> Tensor:
    """The observation of the reset that the collector makes when it is made.

    The public way is another reset, which changes the random numbers of all that follows.
    """
    observation: Tensor = collector._carrier.get("observation")
    return observation.clone()


def noisy(noise: ObservationNoise, observation: Tensor) -> Tensor:
    """The observation with noise; the public call takes a TensorDict, at every frame."""
    return noise._apply_transform(observation)


def forget_traced(loss: LossModule) -> None:
    """Has TorchRL's losses detach their parameters anew: they keep detached ones if traced."""
    for module in loss.modules():
        if isinstance(module, LossModule):
            module._erase_cache()


def stored_tensors(storage: LazyTensorStorage) -> TensorDictBase | None:
    """The storage's own tensors ``[capacity, ...]``; the public ``storage[:]`` copies them."""
    tensors: TensorDictBase | None = storage._storage
    return tensors


class RowWriter:
    """Stores single rows where ``replay.extend`` would, and leaves the buffer as it would.

    For one row ``extend`` takes longer than all that a frame is made of otherwise: specs, nested
    TensorDicts and copies are for batches.

    Args:
        replay (TensorDictReplayBuffer): as :meth:`ExperimentConfig.make_replay` makes it:
            one-dimensional, in turn.
    """

    def __init__(self, replay: TensorDictReplayBuffer) -> None:
        self._replay = replay
        # TorchRL's properties of a buffer take long.
        self._storage, self._writer = replay.storage, replay.writer
        self._source: TensorDictBase | None = None
        self._stored: list[tuple[NestedKey, Tensor]] = []

    def write(self, row: Mapping[NestedKey, Tensor]) -> None:
        """Stores a row; the first decides which entries are stored.

        Args:
            row (Mapping): entries without a batch dimension; more than are stored does no harm.
        """
        if not self._storage.initialized:
            batch = TensorDict(batch_size=[1])
            for key, value in row.items():
                batch.set(key, value.unsqueeze(0).to(self._storage.device))
            self._replay.extend(batch)
            return
        if self._storage._storage is not self._source:  # The first time, or after loading.
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
    """A replay buffer's ``state_dict`` with the priorities as tensors instead of C++ objects."""
    state = dict(replay.state_dict())
    if isinstance(replay, TensorDictPrioritizedReplayBuffer):
        sampler = dict(state["_sampler"])
        index = torch.arange(len(replay))
        for tree in ("_sum_tree", "_min_tree"):
            sampler[tree] = torch.as_tensor(sampler[tree][index])
        state["_sampler"] = sampler
    return state


def load_replay_state(replay: TensorDictReplayBuffer, state: Mapping[str, Any]) -> None:
    """Restores what :func:`replay_state` gave into a buffer made with the same settings."""
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
    if storage._storage is not None:  # It is on the saved state's device if it was empty.
        storage._storage = storage._storage.to(storage.device)


class TraceableClipPPOLoss(ClipPPOLoss):
    """TorchRL's clipped PPO, with an entropy bonus that can be a part of a graph.

    TorchRL's loss looks whether an entropy is finite, and otherwise estimates it: what a graph
    computes may not depend on that. The entropy of a normal with a positive scale is finite.
    """

    def _get_entropy(self, dist: Distribution, adv_shape: torch.Size) -> Tensor:
        if has_analytic_entropy(dist):
            return dist.entropy().unsqueeze(-1)
        return super()._get_entropy(dist, adv_shape)
