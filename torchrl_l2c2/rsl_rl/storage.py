"""Rollouts of rsl_rl whose batches know the observation that came next."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

# Where a batch's rows lie in the rollout, among the observations while a batch is drawn.
ROW = "_row"


class SuccessorStorage(RolloutStorage):
    """A rollout storage whose batches have the observations after their own.

    It takes over the buffers of the one that rsl_rl has made. The observation after a step is the
    one that is stored with the next step, and is looked up there: there is one step's more of
    observations, and no second copy. Where an episode ended, that is the first observation of
    another one, and counts as unknown unless :meth:`add_final` was told what the episode's own was.

    Batches have two attributes more: ``next_observations``, a TensorDict like ``observations``, and
    ``has_next``, boolean, ``[B]``, false in rows whose next observation is unknown.

    Args:
        storage (RolloutStorage): the storage, for reinforcement learning. It is not to be used
            afterwards.

    Examples:
        >>> import torch
        >>> from rsl_rl.storage import RolloutStorage
        >>> from tensordict import TensorDict
        >>> obs = TensorDict({"policy": torch.zeros(2, 3)}, [2])
        >>> storage = SuccessorStorage(RolloutStorage("rl", 2, 4, obs, [1]))
        >>> storage.observations.shape
        torch.Size([4, 2])
    """

    def __init__(self, storage: RolloutStorage) -> None:
        self.__dict__.update(vars(storage))
        stored = storage.observations
        observations: TensorDict = torch.cat((stored, stored[:1]))
        rows = torch.arange(observations.numel(), device=self.device)
        self._observations = observations.set(ROW, rows.reshape(observations.shape))
        self.observations = self._observations[:-1]
        self._final_rows: list[Tensor] = []
        self._finals: list[TensorDictBase] = []

    def add_last(self, observations: TensorDictBase) -> None:
        """Stores the observations after the last step, ``[num_envs]``."""
        self._observations[-1].copy_(observations)

    def add_final(self, observations: TensorDictBase, dones: Tensor) -> None:
        """Stores the last observations of the episodes that the step before has ended.

        Args:
            observations: ``[num_envs]``; only the rows of ended episodes are read.
            dones: which they are, ``[num_envs]``.
        """
        ended = dones.flatten().nonzero().flatten()
        self._final_rows.append((self.step - 1) * self.num_envs + ended)
        self._finals.append(observations[ended])

    def clear(self) -> None:
        super().clear()
        self._final_rows.clear()
        self._finals.clear()

    def mini_batch_generator(
        self, num_mini_batches: int, num_epochs: int = 8
    ) -> Iterator[RolloutStorage.Batch]:
        """The batches of rsl_rl, drawn as there, with their next observations."""
        finals = self._find_finals()
        for batch in super().mini_batch_generator(num_mini_batches, num_epochs):
            rows = batch.observations.pop(ROW)
            batch.next_observations, batch.has_next = self._successors(rows, finals)
            yield batch

    def _find_finals(self) -> tuple[Tensor, TensorDictBase] | None:
        """Which of the known final observations is each row's, -1 where none is; and these."""
        if not self._finals:
            return None
        finals, rows = torch.cat(self._finals), torch.cat(self._final_rows)
        place = torch.full((self.observations.numel(),), -1, device=self.device)
        place[rows] = torch.arange(len(rows), device=self.device)
        return (place, finals) if len(rows) else None

    def _successors(
        self, rows: Tensor, finals: tuple[Tensor, TensorDictBase] | None
    ) -> tuple[TensorDict, Tensor]:
        after = self._observations.exclude(ROW).flatten(0, 1)[rows + self.num_envs]
        known = ~self.dones.flatten()[rows].bool()
        if finals is not None:
            place = finals[0][rows]
            final = place >= 0
            after = finals[1].select(*after.keys())[place.clamp_min(0)].where(final, after)
            known = known | final
        return after, known
