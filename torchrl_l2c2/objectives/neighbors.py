"""The neighbors of a batch, or of a random share of it, as a loss compares with them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from math import isclose
from typing import Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torchrl_l2c2._checks import check_of_each, read_key
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives.transitions import is_floating_point, next_key
from torchrl_l2c2.objectives.wiring import Wiring


class Neighbors(NamedTuple):
    """The neighbors of the states in a batch ``[*B]``, or of ``M`` of them.

    Attributes:
        states: the neighbors, ``[K, *B]``, or ``[K, M]``.
        distance: how far away they count, of the same shape.
        rows: whose neighbors they are, ``[M]``, in the batch written as one row; ``None``: all.
    """

    states: TensorDictBase
    distance: Tensor
    rows: Tensor | None = None

    def to_batch(self, value: Tensor, shape: torch.Size) -> Tensor:
        """One number for each transition of the batch, of those for the rows.

        Drawn rows stand for the others: they count ``B / M`` times, the others 0. That leaves the
        expectation of every sum and mean over the batch, with weights and masks or without, as it
        is.

        Args:
            value: ``[M, ...]``.
            shape: of the batch, ``[*B]``.

        Returns:
            ``[*B, ...]``.
        """
        if self.rows is None:
            return value
        count, rest = shape.numel(), value.shape[1:]
        spread = value.new_zeros(count, *rest)
        spread = spread.index_copy(0, self.rows, value * (count / len(self.rows)))
        return spread.reshape(*shape, *rest)


def draw_rows(
    tensordict: TensorDictBase, fraction: float, device: torch.device | None = None
) -> Tensor | None:
    """A random share of a batch, with torch's global generator: no row twice, each as likely.

    Args:
        tensordict (TensorDictBase): the batch, ``[*B]``.
        fraction (float): its share, in (0, 1]; rounded to whole rows, at least one.
        device (torch.device, optional): of the batch's tensors.

    Returns:
        Tensor: ``[M]``, in the batch written as one row; ``None`` stands for all of them.
    """
    count = tensordict.numel()
    drawn = max(1, round(fraction * count))
    if drawn >= count:
        return None
    return torch.randperm(count, device=device)[:drawn]


def read_neighbors(
    neighbor: TensorDictBase, key: NestedKey
) -> tuple[TensorDictBase, Tensor, Tensor | None]:
    """What :class:`~torchrl_l2c2.NeighborTransform` has written, with ``K`` in front.

    Args:
        neighbor (TensorDictBase): the entry, ``[*B]``, of states ``[*B, K, *F]``.
        key (NestedKey): its name, for errors.

    Returns:
        tuple: the neighbors, ``[K, *B]``; their distances, ``[K, *B]``; and the numbers of the
        neighborhood that they were drawn in, ``[n, *B]``, if the entry has them.

    Raises:
        KeyError: it has no distances, or is a tensor.
    """
    if not isinstance(neighbor, TensorDictBase):
        raise KeyError(
            f"{key!r} is a tensor of the batch's own, and no neighbors of NeighborTransform: name "
            "another neighbor_key."
        )
    entries = {
        key: value.detach().movedim(neighbor.batch_dims, 0)
        for key, value in neighbor.items(include_nested=True, leaves_only=True)
    }
    if "distance" not in entries:
        raise KeyError(
            f"{key!r} holds {list(entries)}, but no 'distance': write it with NeighborTransform, "
            "or name another neighbor_key."
        )
    distance, drawn = entries.pop("distance"), entries.pop("neighborhood", None)
    return TensorDict(entries, batch_size=distance.shape), distance, drawn


def read_moved_keys(
    moved_keys: str | Sequence[NestedKey], read: Mapping[str, Sequence[NestedKey]]
) -> list[NestedKey]:
    """The entries that neighbors differ in; a string is one, as TorchRL's transforms have it.

    Args:
        moved_keys (str or sequence of NestedKey): their names.
        read (Mapping): those that each network reads, by its name.

    Raises:
        TypeError: they are no names.
        ValueError: there is none, one that no network reads, or a network reads none of them.
    """
    if not isinstance(moved_keys, Sequence):
        raise TypeError(f"moved_keys must be a list of entries, got {moved_keys!r}.")
    names = [moved_keys] if isinstance(moved_keys, str) else moved_keys
    keys = [read_key("an entry of moved_keys", key) for key in names]
    if not keys:
        raise ValueError(
            "moved_keys must name at least one observation, got none: leave it at None for all "
            "that can be moved, or pass coeff=0 for no regularization."
        )
    there = sorted({key for states in read.values() for key in states}, key=str)
    if unread := [key for key in keys if key not in there]:
        raise ValueError(
            f"moved_keys names {unread}, and the networks read {there}; what begins with '_' is "
            "TorchRL's own and no observation."
        )
    if still := [name for name, states in read.items() if not set(keys) & set(states)]:
        raise ValueError(
            f"moved_keys names {keys}, and {still[0]} reads {list(read[still[0]])} alone, which "
            "would not move: name one of these, too, or leave its term out (of value functions "
            "with beta=0)."
        )
    return keys


def check_moved(neighbors: TensorDictBase, moved_keys: Sequence[NestedKey] | None) -> None:
    """Refuses neighbors in a batch that differ in other entries than was asked for.

    Raises:
        ValueError: names both.
    """
    moved = list(neighbors.keys(include_nested=True, leaves_only=True))
    if moved_keys is not None and set(moved) != set(moved_keys):
        raise ValueError(
            f"the batch has neighbors of {moved}, and moved_keys names {list(moved_keys)}: give "
            "the NeighborTransform these in_keys, or leave moved_keys out."
        )


def warn_of_unmoved(
    neighbors: TensorDictBase, tensordict: TensorDictBase, networks: Iterable[Wiring]
) -> None:
    """Says which observations neighbors in a batch leave as they are, though they have successors.

    Args:
        neighbors (TensorDictBase): the states, ``[K, *B]``.
        tensordict (TensorDictBase): the batch, ``[*B]``.
        networks (Iterable of Wiring): those that are evaluated.

    Warns:
        UserWarning: there are some, which a loss that draws neighbors itself would move.
    """
    moved = list(neighbors.keys(include_nested=True, leaves_only=True))
    others = {key for network in networks for key in network.states} - set(moved)
    batch = tensordict.select(*others, strict=False)
    following = tensordict.select(*map(next_key, others), strict=False)
    floating = (key for key in others if is_floating_point(batch.get(key, None)))
    still = [key for key in floating if following.get(next_key(key), None) is not None]
    if still:
        warnings.warn(
            f"neighbors in the batch move {moved} alone, and the networks also read "
            f"{sorted(still, key=str)}: add it to the in_keys of NeighborTransform, or say "
            f"moved_keys={moved} to L2C2Loss.",
            stacklevel=4,
        )


def warn_of_far(neighbors: TensorDictBase, tensordict: TensorDictBase, sigma: float) -> None:
    """Says where neighbors lie outside the box of their transition, as before a normalization.

    Args:
        neighbors (TensorDictBase): the states, ``[K, *B]``.
        tensordict (TensorDictBase): the batch, ``[*B]``.
        sigma (float): that of the neighborhood that they are drawn in.

    Warns:
        UserWarning: at least one does.
    """
    for key, near in neighbors.items(include_nested=True, leaves_only=True):
        here, there = tensordict.get(key, None), tensordict.get(next_key(key), None)
        if here is None or there is None:
            continue
        # A little more, for the numbers are rounded.
        rounding = 10.0 * torch.finfo(near.dtype).eps * torch.maximum(here.abs(), there.abs())
        if ((near - here).abs() > 1.01 * sigma * (there - here).abs() + rounding).any():
            warnings.warn(
                f"neighbors of {key!r} in the batch lie further from it than the next state does: "
                "a transform has changed it since they were drawn. Append NeighborTransform after "
                "all that change observations, or leave it out, and L2C2Loss draws neighbors.",
                stacklevel=4,
            )


def l2c2_penalty(
    difference: Tensor,  # shape: [K, *B, ...]
    gain: Tensor,  # shape: [K, *B]
    over_neighbors: Literal["mean", "max"] = "mean",
) -> Tensor:  # shape: [*B, ...]
    r"""The mean over ``K`` neighbors of the gain times the difference, before the reduction.

    .. math::
        \frac1K \sum_k \frac{\lambda}{d(s, \tilde s_k; s')}\, d_f(f(s), f(\tilde s_k))

    of a policy or a value function :math:`f` (Kobayashi, L2C2, 2022).

    Args:
        difference: :math:`d_f`, at least 0; it may have more dimensions, those of agents.
        gain: :math:`\lambda / d`, as :meth:`Neighborhood.gain <torchrl_l2c2.Neighborhood.gain>`
            gives it.
        over_neighbors: ``"max"`` takes the largest of the ``K`` in the place of their mean.

    Raises:
        ValueError: the differences are not of each transition.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.neighbors import l2c2_penalty
        >>> gain = torch.tensor([[1.0, 1.0], [0.5, 0.5]])
        >>> l2c2_penalty(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), gain)
        tensor([1.2500, 2.0000])
    """
    check_of_each(difference.shape, gain.shape)
    gain = gain[(...,) + (None,) * (difference.ndim - gain.ndim)]
    penalty = gain * difference
    # Not amax: of some of PPO-RPE's graphs inductor makes no program with it.
    return penalty.mean(0) if over_neighbors == "mean" else penalty.max(0).values


def warn_of_other_neighbors(
    drawn: Sequence[float], num_drawn: int, neighborhood: Neighborhood, num_samples: int
) -> None:
    """Says where neighbors are drawn otherwise than a loss counts them.

    Args:
        drawn (Sequence of float): the numbers of the neighborhood that they are drawn in.
        num_drawn (int): neighbors per state.
        neighborhood (Neighborhood): that of the loss.
        num_samples (int): likewise.

    Warns:
        UserWarning: the neighborhood or the number is not that of the loss.
    """
    own = neighborhood.numbers
    # The batch has them in its own precision.
    same = all(isclose(a, b, rel_tol=0.01) for a, b in zip(drawn, own, strict=True))
    if same and num_drawn == num_samples:
        return
    names = (*(field.name for field in fields(neighborhood)), "num_samples")
    pairs = zip(names, (*drawn, num_drawn), (*own, num_samples), strict=True)
    each = ", ".join(f"{name} {a:.4g} and {b:.4g}" for name, a, b in pairs)
    warnings.warn(
        f"neighbors are drawn otherwise than L2C2Loss counts them: {each}. Give the same "
        "neighborhood and num_samples to NeighborTransform and L2C2Loss.",
        stacklevel=4,
    )
