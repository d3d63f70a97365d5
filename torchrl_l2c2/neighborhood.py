"""The neighborhood of a state: where its neighbors are drawn and how far away they count."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

import torch
from torch import Tensor

from torchrl_l2c2._checks import check_positive_int, check_real


@dataclass(frozen=True)
class Neighborhood:
    r"""The local box that a transition spans around a state, with its distance and its gain.

    A transition :math:`s \to s'` spans a box with :math:`s` at its center and :math:`s'` at a
    corner. Neighbors are drawn from it and measured relative to the transition (Kobayashi, L2C2,
    2022, "Implementation"):

    .. math::
        \tilde s = s + (s' - s)\, u, \qquad
        u_i \sim \mathcal U(-r, r), \qquad
        d(s, \tilde s; s') = \max_i |u_i| + \epsilon,

    .. math::
        \epsilon = \frac{\sigma \lambda_{\min}}{\lambda_{\max} - \sigma \lambda_{\min}}, \qquad
        r = \sigma + (\sigma - 1)\, \epsilon, \qquad
        \lambda = \lambda_{\max}\, \epsilon .

    The gain :math:`\lambda / d` is then ``lambda_max`` at the center and ``lambda_min`` at the
    edge, for every ``sigma``.

    .. note::
        The largest of ``n`` uniform draws has mean ``n / (n + 1)`` of the radius, so most neighbors
        of a high-dimensional state lie close to the edge and the applied gain close to
        ``lambda_min``: with the default values its mean is about ``4.7 * lambda_min`` for one
        dimension, ``1.25 * lambda_min`` for five and ``1.04 * lambda_min`` for 28.

    Args:
        sigma: size of the box relative to the transition, greater than 0. Above 1 neighbors reach
            past :math:`s'`; smaller values regularize a smaller surrounding. Defaults to ``1.0``.
        lambda_min: gain at the edge of the box, greater than 0. Larger values smooth everywhere
            in it. Defaults to ``0.01``.
        lambda_max: gain at the center, greater than ``lambda_min`` and than
            ``sigma * lambda_min``. Larger values smooth more where the neighbor is close to the
            state, and change nothing at the edge. Defaults to ``1.0``.
        neighbors: ``"box"`` or ``"line"``. With ``"box"`` each dimension of a state has its own
            :math:`u_i` (the paper). With ``"line"`` all dimensions have the same :math:`u`:
            neighbors lie on the line through :math:`s` and :math:`s'`, as in implementations for
            robots. Their distances are uniform, and the mean gain is as large as for a state of one
            dimension. Defaults to ``"box"``.
        max_step: the largest :math:`\lVert s' - s \rVert_2`, greater than 0, in the state's units.
            If a state has several entries, the bound applies to each, and one longer entry is
            enough. A transition with a longer step is a reset or a teleport and does not count:
            its neighbors are the state itself, in all entries, at an infinite distance with a gain
            of 0. Defaults to ``None``, no bound.

    Raises:
        TypeError: if a value is not a real number.
        ValueError: if a value is not finite or out of its range, or ``neighbors`` is unknown.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import Neighborhood
        >>> near = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=1.0)
        >>> near.epsilon, near.radius, near.scale
        (0.25, 1.0, 0.25)
        >>> near.gain(torch.tensor([0.25, 1.25]))
        tensor([1.0000, 0.2000])
        >>> state, next_state = torch.zeros(32, 5), torch.ones(32, 5)
        >>> neighbor, distance = near.sample(state, next_state, num_samples=4)
        >>> neighbor.shape, distance.shape
        (torch.Size([32, 4, 5]), torch.Size([32, 4]))
    """

    sigma: float = 1.0
    lambda_min: float = 0.01
    lambda_max: float = 1.0
    neighbors: str = "box"
    max_step: float | None = None

    def __post_init__(self) -> None:
        hint = "For no regularization, do not wrap the loss, or choose strength=0."
        for name in ("sigma", "lambda_min", "lambda_max"):
            check_real(name, getattr(self, name), above=0, hint=hint)
        if self.neighbors not in ("box", "line"):
            raise ValueError(f"Expected neighbors='box' or 'line', got {self.neighbors!r}.")
        if self.max_step is not None:
            check_real("max_step", self.max_step, above=0, hint="None is no bound.")
        if self.lambda_max <= self.sigma * self.lambda_min:
            raise ValueError(
                f"lambda_max must be greater than sigma * lambda_min, got lambda_max="
                f"{self.lambda_max!r} and sigma * lambda_min={self.sigma * self.lambda_min!r}: "
                "raise lambda_max, or lower sigma or lambda_min."
            )
        # For sigma < 1 the radius is positive exactly when the gains are in order.
        if self.lambda_max <= self.lambda_min:
            raise ValueError(
                f"lambda_max must be greater than lambda_min, got lambda_max={self.lambda_max!r} "
                f"and lambda_min={self.lambda_min!r}: the neighborhood's radius would be "
                f"{self.radius!r}. Raise lambda_max or lower lambda_min."
            )

    @property
    def on_line(self) -> bool:
        """Checks whether neighbors lie on the line through a state and its successor."""
        return self.neighbors == "line"

    @property
    def epsilon(self) -> float:
        """The distance of a state to itself; keeps the gain at the center finite."""
        edge = self.sigma * self.lambda_min
        return edge / (self.lambda_max - edge)

    @property
    def radius(self) -> float:
        """Half the width of the box, in units of the transition's displacement."""
        return self.sigma + (self.sigma - 1.0) * self.epsilon

    @property
    def scale(self) -> float:
        r"""The constant gain :math:`\lambda_\pi` in front of the regularization."""
        return self.lambda_max * self.epsilon

    def gain(self, distance: Tensor) -> Tensor:
        """The gain applied at a distance: :attr:`scale` over it.

        Args:
            distance: distances as :meth:`sample` returns them, any shape, in
                ``[epsilon, radius + epsilon]`` or infinite.

        Returns:
            A tensor of the same shape, in ``[lambda_min, lambda_max]`` or 0.
        """
        return self.scale / distance

    def sample(
        self,
        state: Tensor,
        next_state: Tensor,
        num_samples: int = 1,
        generator: torch.Generator | None = None,
        *,
        batch_dims: int = 1,
    ) -> tuple[Tensor, Tensor]:
        """Draws neighbors of each state and their distances.

        The distance follows from the draw, not from the quotient of displacements, so it is
        right for coordinates that did not move. Coordinates of ``next_state`` that are not finite
        count as not having moved. If none is finite, as at the ends of some episodes, the
        neighbor is the state itself, at an infinite distance with a gain of 0.

        Args:
            state: states, shape ``[*B, *F]`` with features of any shape, floating point.
            next_state: their successors, the same shape.
            num_samples: neighbors ``K`` per state, at least 1. More give a less noisy estimate at
                ``K`` times the network evaluations. Defaults to ``1``.
            generator: source of the randomness, on the device of ``state``. Defaults to
                PyTorch's global generator, the only choice that compiles with ``fullgraph=True``.
            batch_dims: how many leading dimensions are batch dimensions. Defaults to ``1``.

        Returns:
            The neighbors, shape ``[*B, K, *F]`` in the dtype of ``state``, and their distances,
            shape ``[*B, K]``, in single precision at least. Distances are infinite for steps longer
            than ``max_step`` and for successors that are not finite.

        Raises:
            TypeError: if the states are not floating point, or ``num_samples`` is no integer.
            ValueError: if the shapes differ, or ``num_samples`` or ``batch_dims`` is out of range.
        """
        uniform = self.draw(state, num_samples, generator, batch_dims=batch_dims)
        return self.place(state, next_state, uniform, batch_dims=batch_dims)

    def draw(
        self,
        state: Tensor,
        num_samples: int = 1,
        generator: torch.Generator | None = None,
        *,
        batch_dims: int = 1,
    ) -> Tensor:
        """The random numbers that :meth:`sample` needs, for :meth:`place`.

        A compiled function cannot draw from a generator of its own: it takes these numbers instead.

        Args:
            state: states, shape ``[*B, *F]``, floating point; only their shape matters.
            num_samples: as in :meth:`sample`.
            generator: as in :meth:`sample`.
            batch_dims: as in :meth:`sample`.

        Returns:
            Numbers in ``[0, 1)``, shape ``[*B, K, *F]``, or ``[*B, K]`` on a line, in the dtype of
            ``state``.

        Raises:
            TypeError: if the states are not floating point, or ``num_samples`` is no integer.
            ValueError: if ``num_samples`` or ``batch_dims`` is out of range.
        """
        check_positive_int("num_samples", num_samples)
        _check_states(state, state, batch_dims)
        features = () if self.on_line else state.shape[batch_dims:]
        shape = (*state.shape[:batch_dims], num_samples, *features)
        # The argument generator=None would not compile where the batch size is dynamic.
        if generator is None:
            return torch.rand(shape, dtype=state.dtype, device=state.device)
        return torch.rand(shape, generator=generator, dtype=state.dtype, device=state.device)

    def place(
        self, state: Tensor, next_state: Tensor, uniform: Tensor, *, batch_dims: int = 1
    ) -> tuple[Tensor, Tensor]:
        """The neighbors that belong to the random numbers of :meth:`draw`, and their distances.

        Args:
            state: states, shape ``[*B, *F]``, floating point.
            next_state: their successors, the same shape.
            uniform: numbers in ``[0, 1)``, shape ``[*B, K, *F]``, or ``[*B, K]`` on a line: 0.5
                is the state itself, 0 and 1 are the edges of the box.
            batch_dims: how many leading dimensions are batch dimensions. Defaults to ``1``.

        Returns:
            As :meth:`sample`.

        Raises:
            TypeError: if the states are not floating point.
            ValueError: if the shapes differ, or ``batch_dims`` is out of range.

        Examples:
            >>> import torch
            >>> from torchrl_l2c2 import Neighborhood
            >>> near = Neighborhood(sigma=1.0)
            >>> uniform = torch.tensor([[[0.5, 0.5]], [[0.75, 0.5]]])
            >>> neighbor, _ = near.place(torch.zeros(2, 2), torch.ones(2, 2), uniform)
            >>> neighbor.tolist()
            [[[0.0, 0.0]], [[0.5, 0.0]]]
        """
        _check_states(state, next_state, batch_dims)
        batch, features = state.shape[:batch_dims], state.shape[batch_dims:]
        drawn = torch.Size() if self.on_line else features
        if uniform.shape != (*batch, *uniform.shape[batch_dims : batch_dims + 1], *drawn):
            raise ValueError(
                f"uniform must have the shape [*B, K{'' if self.on_line else ', *F'}] of states "
                f"{tuple(state.shape)} with {batch_dims} batch dimensions, got "
                f"{tuple(uniform.shape)}."
            )
        dtype = state.dtype
        if state.itemsize < 4:  # Half precision has no small distances and no long steps.
            state, next_state, uniform = state.float(), next_state.float(), uniform.float()
        # On a line, the numbers may come from an entry of another dtype.
        u = ((2.0 * uniform - 1.0) * self.radius).to(state.dtype)
        displacement = (next_state - state).to(state.dtype)
        known = displacement.isfinite().reshape(*batch, features.numel()).any(-1)
        displacement = torch.nan_to_num(displacement, nan=0.0, posinf=0.0, neginf=0.0)
        # An explicit size: -1 is ambiguous for empty batches.
        distance = u.abs().reshape(*uniform.shape[: batch_dims + 1], drawn.numel()).amax(-1)
        distance = (distance + self.epsilon).masked_fill(~known.unsqueeze(-1), math.inf)
        if self.max_step is not None:
            too_long = step_length(state, next_state, batch_dims) > self.max_step
            distance = distance.masked_fill(too_long.unsqueeze(-1), math.inf)
            too_long = too_long.reshape(*batch, *(1 for _ in features))
            displacement = displacement.masked_fill(too_long, 0.0)
        u = u.reshape(*u.shape, *(1 for _ in features)) if self.on_line else u
        neighbor = state.unsqueeze(batch_dims) + displacement.unsqueeze(batch_dims) * u
        return neighbor.to(dtype), distance


def step_length(state: Tensor, next_state: Tensor, batch_dims: int) -> Tensor:
    """The length of steps, ``[*B]``; entries that are not finite count as not having moved."""
    if state.itemsize < 4:
        state, next_state = state.float(), next_state.float()
    step = torch.nan_to_num(next_state - state, nan=0.0, posinf=0.0, neginf=0.0)
    return step.reshape(*step.shape[:batch_dims], step.shape[batch_dims:].numel()).norm(dim=-1)


def _check_states(state: Tensor, next_state: Tensor, batch_dims: int) -> None:
    for name, tensor in (("state", state), ("next_state", next_state)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            given = getattr(tensor, "dtype", type(tensor).__name__)
            raise TypeError(
                f"{name} must be a floating-point tensor to have neighbors, got {given}: convert "
                "it first if its values are quantities, leave it out if they are labels."
            )
    if state.shape != next_state.shape:
        raise ValueError(
            f"state and next_state must have the same shape, got {tuple(state.shape)} and "
            f"{tuple(next_state.shape)}."
        )
    if not isinstance(batch_dims, Integral) or not 0 <= batch_dims <= state.ndim:
        raise ValueError(
            f"batch_dims must lie between 0 and {state.ndim} for a state of shape "
            f"{tuple(state.shape)}, got {batch_dims!r}."
        )
    if not all(state.shape[batch_dims:]):
        raise ValueError(f"a state must have at least one number, got shape {tuple(state.shape)}.")
