"""A regularized loss with the interface of rsl_rl's symmetry extension."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_l2c2._checks import check_positive_int
from torchrl_l2c2._warnings import warn
from torchrl_l2c2.gains import is_loss
from torchrl_l2c2.objectives import RegularizedLoss
from torchrl_l2c2.rsl_rl.networks import VALID, write_parameters
from torchrl_l2c2.transforms import NeighborTransform


class Regularization:
    """A regularized loss with the interface of rsl_rl's symmetry extension.

    rsl_rl's PPO accepts one additional term, the mirror loss of the symmetry extension. This object
    takes its place: it forwards calls to the real extension, and adds the regularizer's terms to
    the mirror loss. The regularizer is computed at the original rows of the batch, not at mirrored
    rows. Recurrent models take single steps from the states of the rollout.

    Args:
        loss (RegularizedLoss): the regularizer around an
            :class:`~torchrl_l2c2.rsl_rl.ActorCriticLoss`.
        neighbors (NeighborTransform, optional): transform that writes neighbors into batches.
        method (str): the regularizer's name, which is saved in checkpoints.
        ramp_updates (int, optional): number of updates over which ``regularizer_gain`` rises from
            0; ``None`` for a constant gain.
        symmetry (Symmetry, optional): the real extension.
    """

    use_mirror_loss = True
    mirror_loss_coeff = 1.0

    def __init__(
        self,
        loss: RegularizedLoss,
        neighbors: NeighborTransform | None,
        method: str,
        ramp_updates: int | None,
        symmetry: Symmetry | None,
    ) -> None:
        self.loss, self.neighbors, self.symmetry = loss, neighbors, symmetry
        self.method, self.ramp_updates, self.updates = method, ramp_updates, 0
        if ramp_updates is not None:
            check_positive_int("ramp_updates", ramp_updates)
            loss.ramp()
        self._sums: dict[str, Tensor] = {}
        self._batches = 0
        self._set_progress()

    def augment_batch(self, batch: RolloutStorage.Batch, original_batch_size: int) -> None:
        """Adds mirrored rows if there is a symmetry extension."""
        if self.symmetry is not None:
            self.symmetry.augment_batch(batch, original_batch_size)

    def compute_loss(
        self, actor: MLPModel, batch: RolloutStorage.Batch, original_batch_size: int
    ) -> Tensor:
        """Sums the regularizer's terms and the weighted mirror loss.

        rsl_rl calls it after computing the surrogate loss.

        Args:
            actor: the policy, just evaluated at ``batch.observations``.
            batch: a batch of :class:`~torchrl_l2c2.rsl_rl.SuccessorStorage`.
            original_batch_size: number of original rows, which come before the mirrored rows.
        """
        batch_of_loss = self._transitions(actor, batch, original_batch_size)
        terms = dict(self.loss(batch_of_loss).items())
        # Means over the valid rows: these diagnostics are shares of all rows.
        valid = batch.has_next.float().mean()
        terms.update({name: terms[name] * valid for name in terms if name.endswith("_counted")})
        total = sum(term for name, term in terms.items() if is_loss(name))
        if self.symmetry is not None:
            mirror = self.symmetry.compute_loss(actor, batch, original_batch_size)
            terms["symmetry"] = mirror
            if self.symmetry.use_mirror_loss:
                total = total + self.symmetry.mirror_loss_coeff * mirror
        self._record(terms)
        return total

    def report(self) -> dict[str, float]:
        """Returns the means over the batches since the last call, by the names of the terms."""
        names, sums = list(self._sums), list(self._sums.values())
        means = (torch.stack(sums) / self._batches).tolist() if sums else []
        self._sums, self._batches = {}, 0
        return {name.removeprefix("loss_"): mean for name, mean in zip(names, means, strict=True)}

    def step(self) -> None:
        """Counts an update, which moves the gain of a ramp."""
        self.updates += 1
        self._set_progress()

    def state_dict(self) -> dict[str, Any]:
        """The method, the number of updates, the ramp and the state of the generator."""
        generator = None if self.neighbors is None else self.neighbors.generator
        drawn = {} if generator is None else {"generator": generator.get_state()}
        ramp = {"updates": self.updates, "ramp_updates": self.ramp_updates}
        return {"method": self.method, **ramp, **drawn}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores the result of :meth:`state_dict`; ignores the state of another method.

        Warns:
            UserWarning: the ramp has another length than in the run that was saved.
        """
        if state["method"] != self.method:
            return
        self.updates = state["updates"]
        self._set_progress()
        length = state.get("ramp_updates", self.ramp_updates)
        if length != self.ramp_updates:
            warn(
                f"the checkpoint was trained with ramp_updates={length}, and this run has "
                f"ramp_updates={self.ramp_updates}: the gain continues at "
                f"{float(self.loss.regularizer_gain):g}. To continue as before, set ramp_updates "
                f"to {length} in regularizer_cfg."
            )
        generator = None if self.neighbors is None else self.neighbors.generator
        # A generator of another kind of device has another state: do not restore it.
        if generator is not None and "generator" in state:
            saved = state["generator"].cpu()
            if saved.shape == generator.get_state().shape:
                generator.set_state(saved)

    def _set_progress(self) -> None:
        if self.ramp_updates is not None:
            self.loss.set_progress(min(1.0, self.updates / self.ramp_updates))

    def _transitions(
        self, actor: MLPModel, batch: RolloutStorage.Batch, count: int
    ) -> TensorDictBase:
        parameters = actor.output_distribution_params
        if batch.masks is None:
            transitions, actions = batch.observations[:count], batch.actions[:count]
            parameters = tuple(part[:count] for part in parameters)
        else:
            transitions, actions = batch.single_steps, batch.actions.flatten(0, 1)
            parameters = tuple(part.flatten(0, 1) for part in torch.broadcast_tensors(*parameters))
        if not actor.is_recurrent:  # It has evaluated sequences, and not single steps.
            write_parameters(transitions, parameters)
        transitions.set("action", actions)
        transitions.set("next", batch.next_observations).set(VALID, batch.has_next)
        return transitions if self.neighbors is None else self.neighbors(transitions)

    def _record(self, terms: dict[str, Tensor]) -> None:
        self._batches += 1
        for name, term in terms.items():
            self._sums[name] = self._sums.get(name, 0.0) + term.detach()
