"""rsl_rl's rollout storage with next observations."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import unpad_trajectories
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

# Entry of the observations with their rows in the rollout, while a batch is drawn.
ROW = "_row"


def recurrent_keys(name: str, count: int) -> tuple[str, ...]:
    """Keys of a model's recurrent states in batches: one of a GRU, two of an LSTM."""
    return tuple(f"recurrent_{name}_{part}" for part in "hc"[:count])


class SuccessorStorage(RolloutStorage):
    """A rollout storage whose batches have the next observations.

    It takes over the buffers of the storage that rsl_rl has made. The next observation is read from
    the next step of the rollout, so the storage grows by only one step of observations. If an
    episode ended, the next step belongs to another episode, and the next observation is unknown
    unless it was passed to :meth:`add_final`.

    Batches have two more attributes: ``next_observations``, a TensorDict of the ``groups``, and
    ``has_next``, boolean, ``[B]``, false in rows whose next observation is unknown. Batches of
    recurrent models have them for the ``B`` steps of their environments, in the order of
    ``batch.actions.flatten(0, 1)``, and ``single_steps``: the observations and recurrent states
    before each of these steps.

    Attributes:
        groups (list of str): observation groups whose next observations batches have; initially
            all.

    Args:
        storage (RolloutStorage): the storage, for reinforcement learning. Do not use it afterwards.

    Examples:
        >>> import torch
        >>> from rsl_rl.storage import RolloutStorage
        >>> from tensordict import TensorDict
        >>> from torchrl_l2c2.rsl_rl import SuccessorStorage
        >>> obs = TensorDict({"policy": torch.zeros(2, 3)}, [2])
        >>> storage = SuccessorStorage(RolloutStorage("rl", 2, 4, obs, [1]))
        >>> storage.observations.shape
        torch.Size([4, 2])
    """

    def __init__(self, storage: RolloutStorage) -> None:
        self.__dict__.update(vars(storage))
        stored = storage.observations
        self.groups = list(stored.keys())
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
        """Stores the last observations of the episodes that ended in the previous step.

        Args:
            observations: the observations, ``[num_envs]``; only rows of ended episodes are read.
            dones: mask of the ended episodes, ``[num_envs]``.
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
        """Draws batches as rsl_rl does, and adds their next observations."""
        finals = self._find_finals()
        for batch in super().mini_batch_generator(num_mini_batches, num_epochs):
            rows = batch.observations.pop(ROW)
            batch.next_observations, batch.has_next = self._successors(rows, finals)
            yield batch

    def recurrent_mini_batch_generator(
        self, num_mini_batches: int, num_epochs: int = 8
    ) -> Iterator[RolloutStorage.Batch]:
        """Draws batches as rsl_rl does, and adds single steps and their next observations."""
        finals, states = self._find_finals(), self._recurrent_states()
        observations = self._observations.exclude(ROW).flatten(0, 1)
        for batch in super().recurrent_mini_batch_generator(num_mini_batches, num_epochs):
            rows = unpad_trajectories(batch.observations.pop(ROW), batch.masks).flatten()
            batch.next_observations, batch.has_next = self._successors(rows, finals)
            batch.single_steps = observations[rows].update(states[rows])
            yield batch

    def _recurrent_states(self) -> TensorDict:
        """The recurrent states of all models, ``[steps * num_envs, layers, width]``."""
        saved = {"actor": self.saved_hidden_state_a, "critic": self.saved_hidden_state_c}
        found = TensorDict(batch_size=[self.observations.numel()])
        for name, states in saved.items():
            for key, state in zip(
                recurrent_keys(name, len(states or ())), states or (), strict=True
            ):
                found.set(key, state.transpose(1, 2).flatten(0, 1))
        return found

    def _find_finals(self) -> tuple[Tensor, TensorDictBase] | None:
        """The index of each row's final observation, -1 without one, and these observations."""
        if not self._finals:
            return None
        finals, rows = torch.cat(self._finals), torch.cat(self._final_rows)
        place = torch.full((self.observations.numel(),), -1, device=self.device)
        place[rows] = torch.arange(len(rows), device=self.device)
        return (place, finals) if len(rows) else None

    def _successors(
        self, rows: Tensor, finals: tuple[Tensor, TensorDictBase] | None
    ) -> tuple[TensorDict, Tensor]:
        after = self._observations.select(*self.groups).flatten(0, 1)[rows + self.num_envs]
        known = ~self.dones.flatten()[rows].bool()
        if finals is not None:
            place = finals[0][rows]
            final = place >= 0
            after = finals[1].select(*after.keys())[place.clamp_min(0)].where(final, after)
            known = known | final
        return after, known
