"""Gradient steps from a replay buffer, eager or compiled.

:class:`ReplayUpdate` samples the rows of a batch, calls the step of :func:`make_update`, and sets
the rows' new priorities.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorDictPrioritizedReplayBuffer, TensorDictReplayBuffer

from torchrl_l2c2.experiment.agents._torchrl_internals import (
    clear_detached_parameters,
    stored_tensors,
)
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.learn.compilation import compiled
from torchrl_l2c2.experiment.learn.tracing import traceable_step, traceable_targets
from torchrl_l2c2.gains import is_loss
from torchrl_l2c2.transforms import NeighborTransform

Step = Callable[..., tuple[Tensor, Tensor | None]]
"""Gradient step that returns the means of the loss's entries, and priorities."""


def make_update(
    agent: Agent,
    *,
    compile: bool,
    read: Callable[..., TensorDictBase] | None = None,
) -> Step:
    """Returns one gradient step as a function: loss, gradients, optimizer and target networks.

    Args:
        agent (Agent): Agent, updated in place. A compiled step uses the agent's tensors and
            settings at its first call: call :func:`make_update` again after replacing any.
            Learning rates become tensors, which may be changed in place.

    Keyword Args:
        compile (bool): Whether to compile the step. If the steps of the optimizer and the target
            networks compile (:mod:`~.tracing`), the whole step is one graph, otherwise only loss
            and gradients.
        read (Callable, optional): Function that creates the batch, compiled with the step. Default:
            the step's argument is the batch.

    Returns:
        Callable: Function of a bool, whether to also update the policy and the target networks, and
        the batch or the arguments of ``read``. It returns the means of ``agent.loss.out_keys`` as
        one tensor, and the batch's new priorities, or ``None``. It clears the parameters' ``grad``.
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
        # A copy: losses write into their argument, partly with gradients.
        batch = drawn[0].copy() if read is None else read(*drawn)
        terms = agent.loss(batch)
        if torch.compiler.is_compiling():
            clear_detached_parameters(agent.loss)
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
        # Remaining gradients would be outputs of the graph, which take time.
        for parameter in parameters:
            parameter.grad = None

    def update(with_policy: bool, *drawn: Any) -> tuple[Tensor, Tensor | None]:
        values, priority, gradients = differentiate(with_policy, *drawn)
        apply(with_policy, gradients)
        return values, priority

    if compile and whole:
        return compiled(update)
    if compile:
        differentiate = compiled(differentiate)
    return update


class Draw(NamedTuple):
    """Sampled rows and random numbers of one update.

    Attributes:
        stored: Tensors ``[capacity, ...]`` of the storage.
        rows: Rows ``[B]`` of the batch.
        weight: Importance weights ``[B]``; ``None`` without priorities.
        uniform: Random numbers of the neighbors; ``None`` without neighbors.
    """

    stored: tuple[Tensor, ...]
    rows: Tensor
    weight: Tensor | None
    uniform: Tensor | None


class ReplayUpdate:
    """Updates an agent from a replay buffer.

    Equivalent to ``replay.sample``, an update and ``replay.update_tensordict_priority``, with the
    same numbers (up to rounding if compiled). The batch and its neighbors are gathered inside the
    compiled update, which takes almost no time. Creating the batch's TensorDicts outside would take
    about as long as the rest of the update.

    Args:
        agent (Agent): Agent, updated in place.
        replay (TensorDictReplayBuffer): Buffer of :func:`~.replay.make_replay`.

    Keyword Args:
        compile (bool): Whether to compile the update, as for :func:`make_update`.
    """

    def __init__(self, agent: Agent, replay: TensorDictReplayBuffer, *, compile: bool) -> None:
        # The buffer's properties are slow.
        self._storage, self._sampler = replay.storage, replay.sampler
        self._batch_size = replay.batch_size
        self._prioritized = isinstance(replay, TensorDictPrioritizedReplayBuffer)
        transforms = list(replay.transform.transforms)
        self._neighbors: NeighborTransform | None = transforms[0] if transforms else None
        self._device = agent.device
        self._source: TensorDictBase | None = None
        self._names: tuple[NestedKey, ...] = ()
        self._stored: tuple[Tensor, ...] = ()
        make = partial(make_update, agent, read=self.read)
        self.update = make(compile=compile)
        # The last batch of a rollout may have any size: compiling it does not pay off.
        self._smaller_update = make(compile=False)

    def __call__(self, with_policy: bool) -> Tensor:
        """Makes one update and sets the batch's priorities.

        Args:
            with_policy (bool): Whether to also update the policy and the target networks.

        Returns:
            Tensor: Means of the loss's terms, as from :func:`make_update`.
        """
        draw = self.draw()
        smaller = len(draw.rows) < self._batch_size
        update = self._smaller_update if smaller else self.update
        values, priority = update(with_policy, *draw)
        self.prioritize(draw.rows, priority)
        return values

    def draw(self) -> Draw:
        """Samples the rows of a batch and the random numbers of their neighbors."""
        source = stored_tensors(self._storage)
        if source is not None and source is not self._source:
            self._source = source
            # Their order differs between processes, and the compiler's cache is by the order.
            items = sorted(self._source.items(True, True), key=lambda item: str(item[0]))
            self._names, self._stored = zip(*items, strict=True)
        rows, weight = self._rows()
        rows = rows.to(self._device)
        weight = None if weight is None else weight.to(self._device)
        generator = None if self._neighbors is None else self._neighbors.generator
        uniform = self._uniform(len(rows), generator)
        return Draw(self._stored, rows, weight, uniform)

    def _rows(self) -> tuple[Tensor, Tensor | None]:
        """Returns rows from the buffer's sampler, and their importance weights if prioritized."""
        rows, info = self._sampler.sample(self._storage, self._batch_size)
        weight = info.get("priority_weight")
        # TorchRL's weight of a single row has no dimension.
        return rows, None if weight is None else weight.reshape(rows.shape)

    def example(self) -> TensorDictBase:
        """Returns a batch from the whole storage, without changing the run's random numbers."""
        # A rollout may be shorter than a batch.
        size, device = min(self._batch_size, len(self._storage)), self._device
        rows = torch.linspace(0, len(self._storage) - 1, size, device=device).long()
        weight = torch.ones(size, device=device) if self._prioritized else None
        uniform = self._uniform(size, torch.Generator(device).manual_seed(0))
        return self.read(self._stored, rows, weight, uniform)

    def _uniform(self, size: int, generator: torch.Generator | None) -> Tensor | None:
        """Returns random numbers for the neighbors of ``size`` rows, or ``None``."""
        if self._neighbors is None or self._source is None:
            return None
        near, count = self._neighbors.neighborhood, self._neighbors.num_samples
        # Only the states' shape matters: any rows work.
        return near.draw(self._source.get("observation")[:size], count, generator)

    def prioritize(self, index: Tensor, priority: Tensor | None) -> None:
        """Sets the priorities of rows, if the buffer is prioritized."""
        if self._prioritized and priority is not None:
            self._sampler.update_priority(index, priority)

    def read(
        self,
        stored: tuple[Tensor, ...],
        index: Tensor,
        weight: Tensor | None,
        uniform: Tensor | None,
    ) -> TensorDictBase:
        """Returns the batch that ``replay.sample`` would return."""
        batch = TensorDict(batch_size=index.shape)
        for name, tensor in zip(self._names, stored, strict=True):
            batch.set(name, tensor[index])
        if weight is not None:
            batch.set("priority_weight", weight)
        if self._neighbors is None:
            return batch
        return self._neighbors.place(batch, TensorDict({"observation": uniform}, index.shape))
