"""How smooth a policy is: the variation of its actions and empirical local Lipschitz constants."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchrl_l2c2._checks import check_choice


def action_variation(actions: Tensor, mask: Tensor | None = None) -> Tensor:
    r"""Mean change of the action from step to step, the paper's measure of smoothness.

    .. math::
        \frac{1}{T - 1} \sum_{t=1}^{T-1} \lVert a_t - a_{t+1} \rVert_2

    (Kobayashi, L2C2, 2022, "Setup", on the policy's mean actions). Smaller is smoother. It is in
    the action's unit per step, so it compares runs with the same action bounds and step time;
    samples of a stochastic policy give larger values than its means.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least two steps.
        mask (Tensor, optional): which steps belong to the episode, boolean, shape ``[*B, T]``;
            for episodes that were padded to one length. Default: all do.

    Returns:
        Tensor: the variation of each episode, shape ``[*B]``.

    Raises:
        ValueError: an episode has fewer than two steps, or the shapes do not fit.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import action_variation
        >>> action_variation(torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 3.0]]))
        tensor(3.)
    """
    if actions.ndim < 2 or actions.shape[-2] < 2:
        raise ValueError(
            "action_variation: actions must have shape [*B, T, A] with T of at least 2, got "
            f"{tuple(actions.shape)}."
        )
    change = torch.linalg.vector_norm(actions.diff(dim=-2), dim=-1)
    if mask is None:
        return change.mean(-1)
    if mask.shape != actions.shape[:-1] or mask.dtype != torch.bool:
        raise ValueError(
            f"action_variation: mask must be boolean of shape {tuple(actions.shape[:-1])}, got "
            f"{mask.dtype} of shape {tuple(mask.shape)}."
        )
    pairs = mask[..., 1:] & mask[..., :-1]
    if not pairs.any(-1).all():
        raise ValueError("action_variation: an episode has no two successive steps in its mask.")
    return torch.where(pairs, change, 0.0).sum(-1) / pairs.sum(-1)


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

    from the function's values at a state and at its neighbors, for example those of
    :meth:`Neighborhood.sample <torchrl_l2c2.Neighborhood.sample>`. Smaller is smoother. The
    largest quotient bounds the true constant in the neighborhood from below, and more neighbors
    tighten it. Unlike the regularization, which counts distance in units of the transition, this
    is in the output's unit per unit of the state.

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
        left out; where none is left the estimate is NaN.

    Raises:
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
    moved = distance > 0.0
    quotient = torch.where(moved, change / distance, 0.0)
    if reduction == "mean":
        return quotient.sum(-1) / moved.sum(-1)
    return torch.where(moved.any(-1), quotient.amax(-1), torch.nan)


def _check_neighbors(name: str, point: Tensor, neighbors: Tensor) -> None:
    fits = neighbors.ndim == point.ndim + 1 and neighbors.shape[-2] > 0
    if not fits or (*neighbors.shape[:-2], neighbors.shape[-1]) != tuple(point.shape):
        raise ValueError(
            f"local_lipschitz: {name} must have one dimension of neighbors before the last one of "
            f"{tuple(point.shape)}, got {tuple(neighbors.shape)}."
        )
