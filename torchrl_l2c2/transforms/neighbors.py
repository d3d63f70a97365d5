"""The neighbors of replayed states, drawn where the batch is drawn."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_l2c2._checks import check_positive_int, read_key
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.transforms.random import RandomTransform, listed

Transitions = dict[NestedKey, tuple[Tensor, Tensor]]  # states and successors, by the states' keys


def draw_neighbors(
    tensordict: TensorDictBase,
    neighborhood: Neighborhood,
    in_keys: str | Sequence[NestedKey],
    num_samples: int = 1,
    generator: torch.Generator | None = None,
) -> TensorDictBase:
    """Draws the neighbors of a batch ``[*B]``, which the transform writes and the loss reads.

    Arguments are the same as for :class:`NeighborTransform`, without defaults for the first three.

    Returns:
        The entry that :class:`NeighborTransform` writes.

    Examples:
        >>> from tensordict import TensorDict
        >>> import torch
        >>> from torchrl_l2c2 import Neighborhood
        >>> from torchrl_l2c2.transforms import draw_neighbors
        >>> batch = {"observation": torch.zeros(4, 3), "next": {"observation": torch.ones(4, 3)}}
        >>> near = draw_neighbors(TensorDict(batch, [4]), Neighborhood(), ["observation"], 2)
        >>> near["observation"].shape, near["distance"].shape
        (torch.Size([4, 2, 3]), torch.Size([4, 2]))
    """
    in_keys = [in_keys] if isinstance(in_keys, str) else in_keys
    _check_names(in_keys)
    transitions = _transitions(tensordict, in_keys)
    uniform = _draw(tensordict, transitions, neighborhood, num_samples, generator)
    return _place(tensordict, transitions, neighborhood, uniform)


def _draw(
    tensordict: TensorDictBase,
    transitions: Transitions,
    neighborhood: Neighborhood,
    num_samples: int,
    generator: torch.Generator | None,
) -> TensorDictBase:
    uniform = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
    numbers, dims = None, tensordict.batch_dims
    for key, (state, _) in transitions.items():
        if numbers is None or not neighborhood.on_line:
            numbers = neighborhood.draw(state, num_samples, generator, batch_dims=dims)
        uniform.set(key, numbers)
    return uniform


def _place(
    tensordict: TensorDictBase,
    transitions: Transitions,
    neighborhood: Neighborhood,
    uniform: TensorDictBase,
) -> TensorDictBase:
    neighbors = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
    distances = []
    for key, transition in transitions.items():
        neighbor, distance = neighborhood.place(
            *transition, uniform.get(key), batch_dims=tensordict.batch_dims
        )
        neighbors.set(key, neighbor)
        distances.append(distance)
    distance = torch.stack(distances).amax(0)
    if len(transitions) > 1:
        # An entry that is too far away or unknown leaves the whole transition out.
        far = distance.isinf()
        for key, (state, _) in transitions.items():
            near, ndim = neighbors.get(key), tensordict.batch_dims
            left_out = far.reshape(*far.shape, *(1,) * (near.ndim - far.ndim))
            neighbors.set(key, torch.where(left_out, state.unsqueeze(ndim), near))
    return neighbors.set("distance", distance)


def _check_names(keys: Sequence[NestedKey]) -> None:
    roots = [key if isinstance(key, str) else key[0] for key in keys]
    if not roots or "distance" in roots:
        raise ValueError(
            "in_keys must name at least one entry and none called 'distance', which says how far "
            f"away neighbors are; got {list(keys)}. Rename it in the environment, or choose other "
            "in_keys (or moved_keys)."
        )


def _check_apart(written: NestedKey, in_keys: Sequence[NestedKey]) -> None:
    """Checks that writing an entry leaves the read entries as they are."""
    read = [key for in_key in in_keys for key in (in_key, unravel_key(("next", in_key)))]
    paths = [(key,) if isinstance(key, str) else key for key in (written, *read)]
    if any(all(a == b for a, b in zip(paths[0], path, strict=False)) for path in paths[1:]):
        raise ValueError(
            f"out_key must be an entry of its own, got {written!r}, where {read} are read: choose "
            "another, such as 'neighbor'."
        )


def _transitions(tensordict: TensorDictBase, in_keys: Sequence[NestedKey]) -> Transitions:
    transitions = {}
    for key in in_keys:
        names = (key, unravel_key(("next", key)))
        transitions[key] = tuple(tensordict.get(name, None) for name in names)
        for name, entry in zip(names, transitions[key], strict=True):
            if entry is None:
                raise KeyError(
                    f"a neighborhood needs {name!r}, which the tensordict lacks; it has "
                    f"{listed(tensordict)}. Store it, or choose other in_keys (or moved_keys)."
                )
            if not entry.is_floating_point():
                raise TypeError(
                    f"only floating-point numbers have neighbors, and {name!r} is {entry.dtype}: "
                    "name the observations to move in in_keys (or moved_keys), such as "
                    "loss.neighbor_transform(in_keys=['observation']), or append it after the "
                    "transform that converts them, such as ToTensorImage."
                )
    return transitions


class NeighborTransform(RandomTransform):
    r"""Draws neighbors of each sampled state, where the batch is drawn.

    Appended to a replay buffer, it adds to every batch the states
    :math:`\tilde s = s + (s' - s)\, u` of a :class:`Neighborhood` and their distances (Kobayashi,
    L2C2, 2022, "Implementation"). :meth:`L2C2Loss.neighbor_transform` makes it with the settings of
    a loss; otherwise give it the same settings. It can also be called on any tensordict with
    states and successors. The batch keeps its size; with batch size ``[*B]`` and ``K`` samples the
    new entry is, with the same batch size::

        neighbor = {
            "observation": [*B, K, *F],   # one per key of in_keys, nested as there
            "distance": [*B, K],          # infinite where the transition does not count
        }

    Several keys are parts of one state. Their displacements are independent in a box and the
    same on a line; the state's distance is the largest distance of its parts.

    .. note::
        A transform that widens the step from :math:`s` to :math:`s'`, such as
        :class:`~torchrl.envs.transforms.MultiStepTransform`, widens the neighborhood with it.

    Args:
        neighborhood: where neighbors are drawn and how far away they count.
        in_keys: the entries that make up the state; their successors are read from ``("next",
            key)``. Defaults to ``["observation"]``.
        out_key: the entry to write. Defaults to ``"neighbor"``.
        num_samples: neighbors ``K`` per state, at least 1. More give a less noisy regularization
            at ``K`` times its network evaluations. Defaults to ``1``.
        generator: source of the randomness, on the device of the batches, saved and restored with
            the ``state_dict`` of the buffer. Defaults to PyTorch's global generator. Use a
            different seed from the buffer's generator; otherwise both draw the same numbers. The
            buffer's generator does not reach transforms: a buffer that prefetches needs a
            generator here and ``prefetch=1``.

    Raises:
        TypeError: if ``neighborhood``, ``out_key``, ``num_samples`` or ``generator`` is of another
            type, or, in use, if an entry is not floating point.
        ValueError: if ``num_samples`` is not positive, a key is reserved, ``out_key`` is also
            read, or the transform is appended to an environment, which does not know :math:`s'`
            when it shows :math:`s`.
        KeyError: in use, if an entry or its successor is missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_l2c2 import Neighborhood, NeighborTransform
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=32)
        >>> _ = replay.append_transform(NeighborTransform(Neighborhood(), num_samples=4))
        >>> state = torch.randn(50, 3)
        >>> _ = replay.extend(
        ...     TensorDict({"observation": state, "next": {"observation": state + 0.1}}, [50])
        ... )
        >>> batch = replay.sample()
        >>> batch["neighbor", "observation"].shape, batch["neighbor", "distance"].shape
        (torch.Size([32, 4, 3]), torch.Size([32, 4]))
    """

    def __init__(
        self,
        neighborhood: Neighborhood,
        in_keys: Sequence[NestedKey] | None = None,
        out_key: NestedKey = "neighbor",
        num_samples: int = 1,
        generator: torch.Generator | None = None,
    ) -> None:
        if not isinstance(neighborhood, Neighborhood):
            raise TypeError(f"neighborhood must be a Neighborhood, got {neighborhood!r}.")
        check_positive_int("num_samples", num_samples)
        super().__init__(
            in_keys=["observation"] if in_keys is None else in_keys,
            out_keys=[read_key("out_key", out_key)],
            generator=generator,
        )
        _check_names(self.in_keys)
        _check_apart(self.out_key, self.in_keys)
        self.neighborhood = neighborhood
        self.num_samples = int(num_samples)

    @property
    def out_key(self) -> NestedKey:
        """The entry that is written."""
        return self.out_keys[0]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes neighbors and distances into the tensordict, of any batch size; returns it."""
        return self.place(tensordict, self.draw(tensordict))

    def draw(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The random numbers that :meth:`forward` uses, for :meth:`place`: ``[*B, K, *F]`` per key.

        A compiled function cannot draw from a generator: draw first and give it the numbers.
        """
        transitions = _transitions(tensordict, self.in_keys)
        return _draw(tensordict, transitions, self.neighborhood, self.num_samples, self.generator)

    def place(self, tensordict: TensorDictBase, uniform: TensorDictBase) -> TensorDictBase:
        """Writes the neighbors that belong to the numbers of :meth:`draw`; returns the batch."""
        transitions = _transitions(tensordict, self.in_keys)
        neighbors = _place(tensordict, transitions, self.neighborhood, uniform)
        return tensordict.set(self.out_key, neighbors)

    def _check_environment(self, env: EnvBase) -> None:
        raise ValueError(
            "NeighborTransform belongs to a replay buffer, not to an environment: neighbors need "
            "the successor of the state. Append it to the buffer with append_transform."
        )

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.neighborhood}, keys={self.in_keys}, "
            f"out_key={self.out_key!r}, num_samples={self.num_samples})"
        )
