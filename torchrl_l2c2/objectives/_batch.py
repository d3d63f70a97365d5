"""The states and transitions of a batch, and checks of losses that lack them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.objectives import (
    ACTLoss,
    BCLoss,
    DiffusionBCLoss,
    DreamerActorLoss,
    DreamerV3ActorLoss,
    DreamerV3Loss,
    DreamerV3ValueLoss,
    DreamerValueLoss,
    DTLoss,
    LossModule,
    OnlineDTLoss,
)

from torchrl_l2c2._checks import read_key

IMAGINING = (
    DreamerActorLoss,
    DreamerValueLoss,
    DreamerV3ActorLoss,
    DreamerV3ValueLoss,
    DreamerV3Loss,
)
"""Losses that evaluate their networks along trajectories of a learned model."""

OF_SEQUENCES = (ACTLoss, DTLoss, DiffusionBCLoss, OnlineDTLoss)
"""Losses whose policies read or write sequences."""


def check_evaluates_states(loss: LossModule) -> None:
    """Refuses losses whose networks are not evaluated at single observed states.

    Args:
        loss (LossModule): the loss.

    Raises:
        TypeError: the loss is of another kind; the message names it.
    """
    # Imported here: the import is slow and rarely needed.
    from torchrl.objectives.llm import DistillationLoss, GRPOLoss, SFTLoss

    name = type(loss).__name__
    if isinstance(loss, DistillationLoss | GRPOLoss | SFTLoss):
        raise TypeError(
            f"{name} trains a language model: its states are texts, made of tokens, and between "
            "two of them there is nothing to regularize."
        )
    if isinstance(loss, IMAGINING):
        raise TypeError(
            f"{name} evaluates its networks along trajectories that a learned model imagines, not "
            "at single observed states. There is no neighborhood to regularize them in."
        )
    if isinstance(loss, OF_SEQUENCES):
        raise TypeError(
            f"{name} is not trained on transitions: its policy reads or writes sequences, and "
            "there is no neighborhood of a single state to regularize it in."
        )


def check_batch_size(tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> None:
    """Refuses a whole batch with the batch size ``[]``, which would be taken for a single state.

    Args:
        tensordict (TensorDictBase): a batch with the batch size ``[]``.
        keys: keys of rewards and ends, ``[*B, 1]``. Nested keys are left out: they may have a
            dimension of agents.

    Raises:
        ValueError: such an entry has further dimensions.
    """
    for key in keys:
        entry = tensordict.get(next_key(key), None) if isinstance(key, str) else None
        if entry is not None and entry.ndim > 1:
            raise ValueError(
                f"the batch has the batch size [], and {next_key(key)!r} has the shape "
                f"{list(entry.shape)}: give TensorDict(..., batch_size={list(entry.shape[:-1])})."
            )


def check_reads_next(loss: LossModule) -> None:
    """Refuses losses that are not trained on states with a successor.

    Args:
        loss (LossModule): the loss.

    Raises:
        TypeError: the loss reads no next state.
    """
    in_keys = getattr(loss, "in_keys", [])
    name = getattr(loss, "_parts", (type(loss),))[-1].__name__  # without its regularizers
    # Demonstrations have next states, although behavior cloning does not read them.
    reads_next = any(isinstance(key, tuple) and key[0] == "next" for key in in_keys)
    if in_keys and not (reads_next or isinstance(loss, BCLoss)):
        raise TypeError(
            f"{name} is not trained on transitions (it reads {sorted(in_keys, key=str)}): "
            "without a next observation there is nothing to regularize between. LCPLoss and "
            "SR2LLoss need none."
        )


def find_transitions(
    tensordict: TensorDictBase,
    states: Mapping[str, Iterable[NestedKey]],
    *,
    all_inputs: bool,
) -> dict[NestedKey, tuple[Tensor, Tensor]]:
    """Finds the states that networks read and their successors, detached.

    Inputs without a successor, such as goals, are left out.

    Args:
        tensordict (TensorDictBase): the batch, ``[*B]``.
        states (Mapping): keys of the states that each network reads, by the network's name.
        all_inputs (bool): whether to include inputs that are not floating point, such as masks.

    Returns:
        dict: pairs of state and successor by key, ``[*B, *F]`` each.

    Raises:
        TypeError: a network reads no floating-point state, or a successor is not floating point.
        ValueError: a successor and its state have different shapes.
        KeyError: no state that a network reads has a successor.
    """
    keys = dict.fromkeys(key for read in states.values() for key in read)
    next_states = tensordict.select(*map(next_key, keys), strict=False).detach()
    pairs: dict[NestedKey, tuple[Tensor, Tensor]] = {}
    for network, read in states.items():
        floating = find_states(tensordict, read, network)
        successors = {key: next_states.get(next_key(key), None) for key in floating}
        present = {key: (floating[key], s) for key, s in successors.items() if s is not None}
        if not present:
            raise KeyError(
                f"{network} needs the next observation to be regularized, and the batch has no "
                f"{list(map(next_key, floating))}: keep it (collectors with compact_obs=False do). "
                "If another module computes this input, give the loss a policy that contains it."
            )
        pairs.update(present)
        for key in read if all_inputs else ():
            state, successor = tensordict.get(key, None), next_states.get(next_key(key), None)
            if isinstance(state, Tensor) and isinstance(successor, Tensor):
                pairs.setdefault(key, (state, successor))
    for key, (state, successor) in pairs.items():
        _check_successor(key, state, successor)
    return {key: pairs[key] for key in keys if key in pairs}


def find_recurrent(
    tensordict: TensorDictBase, keys: Iterable[NestedKey]
) -> dict[NestedKey, tuple[Tensor, Tensor]]:
    """Finds the recurrent states of a batch, before and after each step, detached.

    Args:
        tensordict (TensorDictBase): the batch, ``[*B]``.
        keys: keys of the recurrent states, and of ``is_init``.

    Returns:
        dict: pairs by key, ``[*B, *F]`` each.

    Raises:
        KeyError: the batch lacks an entry.
    """
    wanted = [each for key in keys for each in (key, next_key(key))]
    if lacking := [key for key in wanted if tensordict.get(key, None) is None]:
        raise KeyError(
            f"the policy is recurrent, and its next action needs {lacking}, which the batch does "
            "not have: keep them, or choose a regularizer that needs no next action, such as l2c2."
        )
    found = tensordict.select(*wanted).detach()
    return {key: (found.get(key), found.get(next_key(key))) for key in keys}


def find_states(
    tensordict: TensorDictBase, keys: Iterable[NestedKey], network: str
) -> dict[NestedKey, Tensor]:
    """Finds the floating-point states that a network reads, detached.

    Args:
        tensordict (TensorDictBase): the batch, ``[*B]``.
        keys: keys of the states that the network reads.
        network (str): name of the network.

    Returns:
        dict: states by key, ``[*B, *F]``.

    Raises:
        TypeError: no state is floating point, or the states are the entries of a TensorDict.
    """
    keys = list(keys)
    if not keys:
        raise TypeError(
            f"{network} reads no observation to be regularized: actions are none, nor are entries "
            "whose name begins with '_', which are TorchRL's own. Rename the observation."
        )
    tensordict = tensordict.select(*keys, strict=False).detach()
    found = {key: tensordict.get(key, None) for key in keys}
    floating = {key: state for key, state in found.items() if is_floating_point(state)}
    if not floating:
        for key, state in found.items():
            if isinstance(state, TensorDictBase):
                leaves = [unravel_key((key, leaf)) for leaf in state.keys(True, True)]
                raise TypeError(
                    f"Expected tensors as the inputs of {network}, got the TensorDict {key!r}. "
                    f"Name its entries in the in_keys of the network: {leaves}."
                )
        kinds = {key: getattr(s, "dtype", type(s).__name__) for key, s in found.items()}
        raise TypeError(
            f"{network} needs a floating-point observation among its inputs to be regularized, "
            f"got {kinds}: cast it in the environment, the collector or the replay buffer."
        )
    return floating


def finite_successor(state: Tensor, successor: Tensor) -> Tensor:
    """Replaces coordinates of a successor that are not finite by the state's coordinates.

    The result has the state's precision, which the network expects.
    """
    successor = successor.to(state.dtype)
    return torch.where(successor.isfinite(), successor, state)


def as_masked(value: Tensor, tensordict: TensorDictBase, mask_keys: Iterable[NestedKey]) -> Tensor:
    """Expands numbers per transition, ``[*B]``, to numbers per agent if a mask has agents.

    Args:
        value (Tensor): the numbers, ``[*B, ...]``.
        tensordict (TensorDictBase): the batch, ``[*B]``.
        mask_keys (Iterable of NestedKey): possible keys of masks, ``[*B, ...]`` or
            ``[*B, ..., 1]``.
    """
    for mask in (tensordict.get(key, None) for key in mask_keys):
        if mask is not None:
            mask = mask.squeeze(-1) if mask.ndim > value.ndim and mask.shape[-1] == 1 else mask
            if mask.ndim > value.ndim:
                more = (None,) * (mask.ndim - value.ndim)
                value = value[(..., *more)].expand_as(mask)
    return value


def next_key(key: NestedKey) -> NestedKey:
    """The key of an entry's successor."""
    # Not unravel_key: Dynamo does not support it.
    return ("next", *key) if isinstance(key, tuple) else ("next", key)


def _check_successor(key: NestedKey, state: Tensor, successor: Tensor) -> None:
    if state.is_floating_point() and not successor.is_floating_point():
        raise TypeError(
            f"{next_key(key)} must be floating point, as {key!r} is, got {successor.dtype}: cast "
            "both alike in the environment, the collector or the replay buffer."
        )
    if successor.shape != state.shape:
        raise ValueError(
            f"{next_key(key)} must have the shape of {key!r}, {tuple(state.shape)}, got "
            f"{tuple(successor.shape)}."
        )


def is_floating_point(value: object) -> bool:
    """Checks whether an entry of a batch is a floating-point tensor."""
    return isinstance(value, Tensor) and value.is_floating_point()


def read_taken(tensordict: TensorDictBase, key: NestedKey, otherwise: str = "") -> Tensor:
    """Reads actions, or their log-likelihoods, from a batch, detached.

    A rollout may have kept the gradient of the behavior policy. In a likelihood ratio it would
    cancel the gradient of the trained policy.

    Args:
        tensordict: the batch.
        key: key of the entry.
        otherwise: another remedy, for the error message.

    Raises:
        KeyError: the batch has no such entry.
    """
    if (entry := tensordict.get(key, None)) is None:
        raise KeyError(f"the batch has no {key!r}: keep it{otherwise}.")
    return entry.detach()


def read_moved_keys(
    moved_keys: str | Sequence[NestedKey], read: Mapping[str, Sequence[NestedKey]]
) -> list[NestedKey]:
    """The observations that a regularizer moves: to neighbors, or to the next state.

    Args:
        moved_keys (str or sequence of NestedKey): the names; a string is a single name, as in
            TorchRL's transforms.
        read (Mapping): the inputs of each network, by the network's name.

    Raises:
        TypeError: an entry is not a name.
        ValueError: the list is empty, no network reads a name, or a network reads no name at all.
    """
    if not isinstance(moved_keys, Sequence):
        raise TypeError(f"moved_keys must be a list of entries, got {moved_keys!r}.")
    names = [moved_keys] if isinstance(moved_keys, str) else moved_keys
    keys = [read_key("an entry of moved_keys", key) for key in names]
    if not keys:
        raise ValueError(
            "moved_keys must name at least one observation, got none: leave it at None for all "
            "that can be moved."
        )
    there = sorted({key for states in read.values() for key in states}, key=str)
    if unread := [key for key in keys if key not in there]:
        hint = f"name one or several of {there}."
        if tuple(keys) in there:
            hint = f"put the nested key into a list, [{tuple(keys)!r}]."
        elif any(str(key).startswith("_") for key in unread):
            hint = "an entry that begins with '_' is TorchRL's own, and no observation."
        raise ValueError(f"moved_keys names {unread}, and the networks read {there}: {hint}")
    if still := [name for name, states in read.items() if not set(keys) & set(states)]:
        raise ValueError(
            f"moved_keys names {keys}, but {still[0]} reads only {list(read[still[0]])}, which "
            "would not move: name one of these, too, or leave out its term (beta=0 for value "
            "functions)."
        )
    return keys


def draw_rows(
    tensordict: TensorDictBase, fraction: float, device: torch.device | None = None
) -> Tensor | None:
    """Draws rows of a batch uniformly without replacement, with torch's global generator.

    Args:
        tensordict (TensorDictBase): the batch, ``[*B]``.
        fraction (float): share of the rows, in (0, 1]; rounded to whole rows, at least one.
        device (torch.device, optional): device of the result.

    Returns:
        Tensor: indices in the flattened batch, ``[M]``; ``None`` for all rows.
    """
    count = tensordict.numel()
    drawn = max(1, round(fraction * count))
    if drawn >= count:
        return None
    return torch.randperm(count, device=device)[:drawn]


def spread_rows(value: Tensor, rows: Tensor, shape: torch.Size) -> Tensor:
    """Spreads numbers of drawn rows over the whole batch, with the same expectation.

    Drawn rows are multiplied by ``B / M``, the others are 0. The expectation of every sum and mean
    over the batch stays the same, with or without weights and masks.

    Args:
        value (Tensor): numbers of the drawn rows, ``[M, ...]``.
        rows (Tensor): indices in the flattened batch, ``[M]``.
        shape (torch.Size): shape of the batch, ``[*B]``.

    Returns:
        Tensor: numbers of all rows, ``[*B, ...]``.
    """
    count, rest = shape.numel(), value.shape[1:]
    spread = value.new_zeros(count, *rest)
    spread = spread.index_copy(0, rows, value * (count / len(rows)))
    return spread.reshape(*shape, *rest)


def at_rows(tensordict: TensorDictBase, rows: Tensor | None, dim: int = 0) -> TensorDictBase:
    """Selects rows by indices in the flattened batch, behind ``dim`` dimensions; ``None``: all."""
    if rows is None:
        return tensordict
    if tensordict.ndim > dim + 1:
        tensordict = tensordict.flatten(dim, tensordict.ndim - 1)
    return tensordict[:, rows] if dim else tensordict[rows]
