"""Storing one transition at a time, without the TensorDict that the buffer would store."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer


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
        if self._storage._storage is not self._source:  # The first time, or what was loaded.
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
