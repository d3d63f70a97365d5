"""One gradient step: rows, batch, loss, gradients, optimizer, targets; eager or compiled.

Read from below: a :class:`ReplayUpdate` draws the rows of a batch, :func:`make_update` makes the
step that learns from them, and the rows get their new priorities.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictPrioritizedReplayBuffer, TensorDictReplayBuffer

from torchrl_l2c2.experiment.agents._torchrl_internals import forget_traced, stored_tensors
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.learn.compilation import compiled
from torchrl_l2c2.experiment.learn.tracing import traceable_step, traceable_targets
from torchrl_l2c2.gains import is_loss
from torchrl_l2c2.transforms import NeighborTransform

Step = Callable[..., tuple[Tensor | None, Tensor | None]]
"""A gradient step: the means of the loss's entries, ``None`` if skipped, and new priorities."""


def make_update(
    agent: Agent,
    *,
    compile: bool,
    skip_nonfinite: bool = False,
    read: Callable[..., TensorDictBase] | None = None,
) -> Step:
    """One gradient step as a function of a batch: loss, gradients, optimizer, target networks.

    Args:
        agent (Agent): what is updated, in place. Compiled, the step is made for the agent's tensors
            and settings as they are at its first call: make another after replacing any. Learning
            rates become tensors, and what is written into them is followed.
        compile (bool): whether to compile. The whole step is one graph where the optimizer's and
            the target networks' steps are :mod:`~.tracing`'s; with others, loss and gradients are.
        skip_nonfinite (bool): whether a batch with a loss or gradient that is NaN or infinite
            changes nothing and gives no means. The step is two graphs then.
        read (Callable, optional): makes the batch of other things, as the first part of the graph.

    Returns:
        Callable: takes whether the policy is updated too, and the target networks with it, then the
        batch or what ``read`` makes it of. Returns the means of ``agent.loss.out_keys``, in their
        order, as one tensor, and the new priorities of the batch, if the loss gives any. Parameters
        have no ``grad`` after it.
    """
    parameters = [p for group in agent.optimizer.param_groups for p in group["params"]]
    keys = agent.loss.out_keys
    step: Callable[[], object] | None = None
    if compile and traceable_targets(agent.target_updater):
        step = traceable_step(agent.optimizer)
    whole = step is not None
    step = step or agent.optimizer.step

    def differentiate(
        with_policy: bool, *drawn: Any
    ) -> tuple[Tensor, Tensor | None, tuple[Tensor | None, ...]]:
        # A copy, as losses write into what they are given, some of it with a gradient.
        batch = drawn[0].copy() if read is None else read(*drawn)
        terms = agent.loss(batch)
        if torch.compiler.is_compiling():
            forget_traced(agent.loss)
        priority = batch.get("td_error", None)
        total = sum(
            terms[key]
            for key in keys
            if is_loss(key) and (with_policy or key not in agent.policy_terms)
        )
        gradients = torch.autograd.grad(total, parameters, allow_unused=True)
        values = torch.stack([terms[key].detach().float().mean() for key in keys])
        return values, None if priority is None else priority.detach(), gradients

    def apply(with_policy: bool, gradients: tuple[Tensor | None, ...]) -> None:
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if agent.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(parameters, agent.max_grad_norm)
        step()
        if agent.target_updater is not None and with_policy:
            agent.target_updater.step()
        # Kept, they would be outputs of the graph, and each output takes time.
        for parameter in parameters:
            parameter.grad = None

    def update(with_policy: bool, *drawn: Any) -> tuple[Tensor, Tensor | None]:
        values, priority, gradients = differentiate(with_policy, *drawn)
        apply(with_policy, gradients)
        return values, priority

    if compile and whole and not skip_nonfinite:
        return compiled(update)
    if compile:
        differentiate = compiled(differentiate)
        apply = compiled(apply) if whole else apply
    if not skip_nonfinite:
        return update

    # What a loss itself keeps of the batches it has seen, such as PPO-RPE's threshold.
    kept = list(agent.loss.buffers())

    def checked_update(with_policy: bool, *drawn: Any) -> tuple[Tensor | None, Tensor | None]:
        before = [buffer.clone() for buffer in kept]
        values, priority, gradients = differentiate(with_policy, *drawn)
        tensors = (values, *(g for g in gradients if g is not None))
        if not all(bool(tensor.isfinite().all()) for tensor in tensors):
            for buffer, was in zip(kept, before, strict=True):
                buffer.copy_(was)
            return None, priority
        apply(with_policy, gradients)
        return values, priority

    return checked_update


class Draw(NamedTuple):
    """What was drawn for one update: everything that tells its batch from others.

    Attributes:
        stored: the storage's tensors, ``[capacity, ...]`` each.
        rows: of the batch, ``[B]``.
        weight: importance weights, ``[B]``; ``None`` without priorities.
        uniform: random numbers of the neighbors; ``None`` without these.
    """

    stored: tuple[Tensor, ...]
    rows: Tensor
    weight: Tensor | None
    uniform: Tensor | None


class ReplayUpdate:
    """Updates from a replay buffer: as ``sample``, update and ``update_tensordict_priority``.

    A buffer that is gone through without repetition is drawn from in that order.

    The numbers are the same, to rounding where the update is compiled. But the batch is gathered
    from the storage, and its neighbors are placed, within the update: compiled, they are a part of
    its graph, which then costs next to nothing, whereas making the batch's TensorDicts takes about
    as long as the rest of the update.

    Args:
        agent (Agent): what is updated, in place.
        replay (TensorDictReplayBuffer): as :meth:`ExperimentConfig.make_replay` makes it.

    Keyword Args:
        compile (bool): as for :func:`make_update`.
        skip_nonfinite (bool): as for :func:`make_update`.

    Attributes:
        culprit: the row that probably had the last batch skipped, and its reward as stored.
    """

    culprit: tuple[int, float]

    def __init__(
        self,
        agent: Agent,
        replay: TensorDictReplayBuffer,
        *,
        compile: bool,
        skip_nonfinite: bool = False,
    ) -> None:
        # TorchRL's properties of a buffer take long.
        self._storage, self._sampler = replay.storage, replay.sampler
        self._batch_size = replay.batch_size
        self._prioritized = isinstance(replay, TensorDictPrioritizedReplayBuffer)
        transforms = list(replay.transform.transforms)
        self._neighbors: NeighborTransform | None = transforms[0] if transforms else None
        self._device = agent.device
        self._source: TensorDictBase | None = None
        self._names: tuple[NestedKey, ...] = ()
        self._stored: tuple[Tensor, ...] = ()
        make = partial(make_update, agent, skip_nonfinite=skip_nonfinite, read=self.read)
        self.update = make(compile=compile)
        # Of the last of a rollout's batches, which may have any size: none is worth a graph.
        self._smaller_update = make(compile=False)

    def __call__(self, with_policy: bool) -> tuple[Tensor, Tensor | None] | None:
        """One update, which sets the batch's priorities as well.

        If it is skipped, a row that probably made it so is not drawn again by priority.

        Args:
            with_policy (bool): whether the policy is updated too, and the target networks with it.

        Returns:
            tuple: as the function that :func:`make_update` returns; ``None`` if it is skipped.
        """
        draw = self.draw()
        smaller = len(draw.rows) < self._batch_size
        update = self._smaller_update if smaller else self.update
        values, priority = update(with_policy, *draw)
        if values is None:
            self._leave_out(draw.rows, priority)
            return None
        self.prioritize(draw.rows, priority)
        return values, priority

    def draw(self) -> Draw:
        """Draws the rows of a batch, and the random numbers for their neighbors."""
        source = stored_tensors(self._storage)
        if source is not None and source is not self._source:
            self._source = source
            self._names, self._stored = zip(*self._source.items(True, True), strict=True)
        rows, weight = self._rows()
        rows = rows.to(self._device)
        weight = None if weight is None else weight.to(self._device)
        generator = None if self._neighbors is None else self._neighbors.generator
        uniform = self._uniform(len(rows), generator)
        return Draw(self._stored, rows, weight, uniform)

    def _rows(self) -> tuple[Tensor, Tensor | None]:
        """What the buffer's sampler draws: rows, and their weights where they have priorities."""
        rows, info = self._sampler.sample(self._storage, self._batch_size)
        return rows, info.get("priority_weight")

    def example(self) -> TensorDictBase:
        """A batch from all over the storage, for which nothing that runs depend on is drawn."""
        # All of it where a rollout is shorter than a batch.
        size, device = min(self._batch_size, len(self._storage)), self._device
        rows = torch.linspace(0, len(self._storage) - 1, size, device=device).long()
        weight = torch.ones(size, device=device) if self._prioritized else None
        uniform = self._uniform(size, torch.Generator(device).manual_seed(0))
        return self.read(self._stored, rows, weight, uniform)

    def _uniform(self, size: int, generator: torch.Generator | None) -> Tensor | None:
        """Random numbers for the neighbors of so many rows."""
        if self._neighbors is None or self._source is None:
            return None
        near, count = self._neighbors.neighborhood, self._neighbors.num_samples
        # Only the shape of the states counts: any rows will do.
        return near.draw(self._source.get("observation")[:size], count, generator)

    def prioritize(self, index: Tensor, priority: Tensor | None) -> None:
        """Sets the priorities of rows, where the buffer has any."""
        if self._prioritized and priority is not None:
            self._sampler.update_priority(index, priority)

    def _leave_out(self, rows: Tensor, priority: Tensor | None) -> None:
        """Finds the rows that made a batch not finite, and stores a copy of another in their place.

        Without that they would keep their priority, and be drawn again and again.
        """
        assert self._source is not None
        rewards = self._source.get(("next", "reward"))[rows].flatten()
        sizes = (rewards.abs() if priority is None else priority.flatten()).nan_to_num(torch.inf)
        largest = sizes.argmax()
        self.culprit = int(rows[largest]), float(rewards[largest])
        if not self._prioritized or priority is None:
            return
        bad = sizes.isinf()
        if not bad.any() or bad.all():  # If all are infinite, not all of them are to blame.
            bad = torch.arange(len(rows), device=rows.device) == largest
        bad_rows, good_rows = rows[bad].cpu(), rows[~bad].cpu()
        if len(good_rows):
            copies = good_rows[torch.zeros_like(bad_rows)]
            self._storage.set(bad_rows, self._storage.get(copies))
            usual = sizes[~bad].nan_to_num(posinf=0.0).median()
            self._sampler.update_priority(bad_rows, usual.expand(len(bad_rows)).cpu())

    def read(
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
        if self._neighbors is None:
            return batch
        return self._neighbors.place(batch, TensorDict({"observation": uniform}, index.shape))
