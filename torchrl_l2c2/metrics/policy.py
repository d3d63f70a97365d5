"""Local steepness of a policy, its sensitivity to noise, and the inputs that its actions follow."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from torchrl_l2c2._checks import check_choice, check_real
from torchrl_l2c2.metrics.actions import in_single


def local_lipschitz(
    state: Tensor,
    neighbor: Tensor,
    output: Tensor,
    neighbor_output: Tensor,
    *,
    reduction: Literal["max", "mean"] = "max",
) -> Tensor:
    r"""Empirical local Lipschitz constant of a function around states.

    .. math::
        \max_k \text{ or } \mathrm{mean}_k \;
        \frac{\lVert f(s) - f(\tilde s_k) \rVert_2}{\lVert s - \tilde s_k \rVert_\infty}

    It uses the function's values at a state and at its neighbors, for example from
    :meth:`Neighborhood.sample <torchrl_l2c2.Neighborhood.sample>`. Smaller is smoother. The
    largest quotient bounds the true constant in the neighborhood from below, and more neighbors
    tighten it. Unlike the regularization, which counts distance in units of the transition, this
    is in the output's unit per unit of the state's coordinate that differs most.

    Args:
        state (Tensor): states, shape ``[*B, F]``.
        neighbor (Tensor): their neighbors, shape ``[*B, K, F]``.
        output (Tensor): the function's values at the states, such as mean actions or values, shape
            ``[*B, M]``.
        neighbor_output (Tensor): its values at the neighbors, shape ``[*B, K, M]``.

    Keyword Args:
        reduction (str): ``"max"`` or ``"mean"`` over the neighbors. Default ``"max"``.

    Returns:
        Tensor: the estimate for each state, shape ``[*B]``. Neighbors equal to their state are
        left out; if none is left or a neighbor is NaN, the estimate is NaN.

    Raises:
        TypeError: ``reduction`` is no string.
        ValueError: the shapes do not fit, or ``reduction`` is not one of the two.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import local_lipschitz
        >>> state, neighbor = torch.zeros(1), torch.tensor([[0.5], [-2.0]])
        >>> local_lipschitz(state, neighbor, state.square(), neighbor.square())
        tensor(2.)
    """
    check_choice("local_lipschitz: reduction", reduction, ("max", "mean"))
    _check_neighbors("neighbor", state, neighbor)
    _check_neighbors("neighbor_output", output, neighbor_output)
    if neighbor.shape[:-1] != neighbor_output.shape[:-1]:
        raise ValueError(
            "local_lipschitz: neighbor and neighbor_output must agree in all but their last "
            f"dimension, got {tuple(neighbor.shape)} and {tuple(neighbor_output.shape)}."
        )
    distance = (neighbor - state.unsqueeze(-2)).abs().amax(-1)
    change = torch.linalg.vector_norm(neighbor_output - output.unsqueeze(-2), dim=-1)
    moved = distance != 0.0  # A NaN neighbor counts, and makes the result NaN.
    quotient = torch.where(moved, change / distance.where(moved, 1.0), 0.0)
    if reduction == "mean":
        return quotient.sum(-1) / moved.sum(-1)
    return torch.where(moved.any(-1), quotient.amax(-1), torch.nan)


@torch.no_grad()
def noise_sensitivity(
    policy: Callable[[Tensor], Tensor],
    observations: Tensor,
    scale: float | Tensor,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Change of the action under white noise on the observations.

    .. math::
        \frac{1}{2} \mathbb E \left[ \lVert \mu(s) - \mu(s + \epsilon) \rVert_2^2 \right],
        \qquad \epsilon \sim \mathcal N(0, \mathrm{scale}^2)

    (half the mean squared difference, as in CATS, arXiv:2610.07910). Smaller is smoother; in the
    action's unit squared. It grows with the square of the scale where the policy is linear.

    Args:
        policy (callable): observations ``[*B, *F]`` to mean actions ``[*B, A]``.
        observations (Tensor): observations to measure at, shape ``[*B, *F]``.
        scale (float or Tensor): standard deviation of the noise, in the observation's unit, greater
            than 0; or of each coordinate, at least 0, shape ``[*F]``.

    Keyword Args:
        generator (torch.Generator, optional): source of the noise. Default: PyTorch's global
            generator.

    Returns:
        Tensor: a single number, the mean over ``[*B]``.

    Raises:
        TypeError: the observations are not floating point, the policy returns no tensor, or the
            scale is no number.
        ValueError: the scale is not a finite number greater than 0, it has no value for each
            coordinate, or actions lack their dimension.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import noise_sensitivity
        >>> observations = torch.zeros(20_000, 3)
        >>> generator = torch.Generator().manual_seed(0)
        >>> twice = lambda observation: 2 * observation
        >>> noise_sensitivity(twice, observations, 0.1, generator=generator).round(decimals=3)
        tensor(0.0600)
    """
    if not isinstance(observations, Tensor) or not observations.is_floating_point():
        given = getattr(observations, "dtype", type(observations).__name__)
        raise TypeError(
            f"noise_sensitivity: observations must be a floating-point tensor, got {given}: noise "
            "on integers would be rounded away. Cast them as the policy does."
        )
    if not isinstance(scale, Tensor):
        check_real("noise_sensitivity: scale", scale, above=0)
    elif not (scale.isfinite() & (scale >= 0.0)).all():
        raise ValueError(
            f"noise_sensitivity: scale must be finite and at least 0, got {scale.tolist()}."
        )
    elif scale.shape != observations.shape[observations.ndim - scale.ndim :]:
        raise ValueError(
            "noise_sensitivity: scale must have a value for each coordinate of observations "
            f"{tuple(observations.shape)}, got the shape {tuple(scale.shape)}."
        )
    noise = torch.randn(
        observations.shape,
        generator=generator,
        dtype=observations.dtype,
        device=observations.device,
    )
    actions = policy(observations)
    if not isinstance(actions, torch.Tensor):
        raise TypeError(
            f"noise_sensitivity: policy must return only the mean actions, got a "
            f"{type(actions).__name__}. With a TorchRL actor, return the 'action' that it writes "
            "under ExplorationType.DETERMINISTIC."
        )
    scale = torch.as_tensor(scale).to(observations)
    change = in_single(policy(observations + scale * noise)) - in_single(actions)
    batch = change.shape[:-1]
    if (not batch and observations.ndim > 1) or observations.shape[: len(batch)] != batch:
        raise ValueError(
            "noise_sensitivity: actions must be [*B, A] of observations [*B, *F], got "
            f"{tuple(change.shape)} of {tuple(observations.shape)}: give actions of one number a "
            "last dimension of 1, and a single observation a batch dimension."
        )
    return 0.5 * change.square().sum(-1).mean()


@torch.no_grad()
def change_with_held_input(
    policy: Callable[[Tensor], Tensor], observations: Tensor, next_observations: Tensor
) -> Tensor:
    r"""Change of the action per step if one input is held, relative to the change as it is.

    .. math::
        \rho_i = \sqrt{\frac{\mathbb E\left[\lVert \mu(s'_{(i)}) - \mu(s) \rVert_2^2\right]}
            {\mathbb E\left[\lVert \mu(s') - \mu(s) \rVert_2^2\right]}}

    where :math:`s'_{(i)}` is :math:`s'` with the coordinate :math:`i` of :math:`s`. It shows which
    inputs make an action shake, whatever their units are. Near 0 the action follows only this
    input, and at 1 it does not depend on the movement of this input. Above 1 the input opposes
    others: held, it would make the action change more.

    Args:
        policy (callable): observations ``[N, *F]`` to mean actions ``[N, A]``.
        observations (Tensor): observations :math:`s`, shape ``[N, *F]``.
        next_observations (Tensor): their successors :math:`s'`, shape ``[N, *F]``.

    Returns:
        Tensor: a number for each coordinate, at least 0, shape ``[*F]``; NaN if the action does not
        change at all. It takes an evaluation of ``N`` observations for each coordinate.

    Raises:
        ValueError: the shapes differ, or have no dimension of the coordinates.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import change_with_held_input
        >>> seen = torch.tensor([[0.0, 0.0], [1.0, 1.0]])
        >>> policy = lambda observation: observation @ torch.tensor([[3.0], [1.0]])
        >>> change_with_held_input(policy, seen[:1], seen[1:])  # a change of 4, of 3 and 1
        tensor([0.2500, 0.7500])
    """
    if observations.shape != next_observations.shape or observations.ndim < 2:
        raise ValueError(
            "change_with_held_input: observations and next_observations must have one shape, "
            f"[N, *F], got {tuple(observations.shape)} and {tuple(next_observations.shape)}."
        )
    before, after = observations.flatten(1), next_observations.flatten(1)
    action = in_single(policy(observations))
    whole = (in_single(policy(next_observations)) - action).square().sum(-1).mean()
    changes = []
    for coordinate in range(before.shape[1]):
        held = after.clone()
        held[:, coordinate] = before[:, coordinate]
        change = in_single(policy(held.view_as(next_observations))) - action
        changes.append(change.square().sum(-1).mean())
    return (torch.stack(changes) / whole).sqrt().view(observations.shape[1:])


def _check_neighbors(name: str, point: Tensor, neighbors: Tensor) -> None:
    fits = neighbors.ndim == point.ndim + 1 and neighbors.shape[-2] > 0
    if not fits or (*neighbors.shape[:-2], neighbors.shape[-1]) != tuple(point.shape):
        raise ValueError(
            f"local_lipschitz: {name} must have one dimension of neighbors before the last one of "
            f"{tuple(point.shape)}, got {tuple(neighbors.shape)}."
        )
