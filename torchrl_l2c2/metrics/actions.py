"""Smoothness of actions, from differences between steps."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_l2c2._checks import check_real


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
        TypeError: the actions are no floating-point tensor.
        ValueError: an episode has fewer than two steps, or the shapes do not fit.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import action_variation
        >>> action_variation(torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 3.0]]))
        tensor(3.)
    """
    actions = episodes_of("action_variation", actions, 2)
    if mask is None:
        return torch.linalg.vector_norm(actions.diff(dim=-2), dim=-1).mean(-1)
    if mask.shape != actions.shape[:-1] or mask.dtype != torch.bool:
        raise ValueError(
            f"action_variation: mask must be boolean of shape {tuple(actions.shape[:-1])}, got "
            f"{mask.dtype} of shape {tuple(mask.shape)}."
        )
    pairs = mask[..., 1:] & mask[..., :-1]
    if not pairs.any(-1).all():
        raise ValueError("action_variation: an episode has no two successive steps in its mask.")
    # Padding may be NaN, and so would be the gradient of a masked difference.
    shown = torch.where(mask.unsqueeze(-1), actions, 0.0)
    change = torch.linalg.vector_norm(shown.diff(dim=-2), dim=-1)
    return torch.where(pairs, change, 0.0).sum(-1) / pairs.sum(-1)


def action_rate(actions: Tensor) -> Tensor:
    r"""Mean squared change of the action, a common penalty in the rewards of robots.

    .. math::
        \frac{1}{T - 1} \sum_{t=1}^{T-1} \lVert a_{t+1} - a_t \rVert_2^2

    (legged_gym's and Isaac Lab's "action rate"). Smaller is smoother; in the action's unit squared
    per step. A few large jumps count for more than in :func:`action_variation`.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least two steps.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``.

    Raises:
        TypeError: the actions are no floating-point tensor.
        ValueError: an episode has fewer than two steps.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import action_rate
        >>> action_rate(torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 3.0]]))
        tensor(13.)
    """
    actions = episodes_of("action_rate", actions, 2)
    return actions.diff(dim=-2).square().sum(-1).mean(-1)


def action_fluctuation_ratio(actions: Tensor) -> Tensor:
    r"""LipsNet's AFR: the summed change of the action over the number of its steps.

    .. math::
        \frac{1}{T} \sum_{t=2}^{T} \lVert a_t - a_{t-1} \rVert_2

    It is :func:`action_variation` times :math:`(T - 1) / T`. Smaller is smoother; in the action's
    unit per step.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least two steps.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``.

    Raises:
        TypeError: the actions are no floating-point tensor.
        ValueError: an episode has fewer than two steps.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import action_fluctuation_ratio
        >>> action_fluctuation_ratio(torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 3.0]]))
        tensor(2.)
    """
    actions = episodes_of("action_fluctuation_ratio", actions, 2)
    steps = actions.shape[-2]
    return action_variation(actions) * (steps - 1) / steps


def action_jerk(actions: Tensor, sampling_rate: float = 1.0) -> Tensor:
    r"""Mean third derivative of the action in time, by differences.

    .. math::
        \frac{f_s^3}{T - 3} \sum_t \lVert a_{t+3} - 3 a_{t+2} + 3 a_{t+1} - a_t \rVert_2

    Smaller is smoother; in the action's unit per second cubed, or per step cubed at the default
    rate. An action that moves with constant acceleration has none.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least four steps.
        sampling_rate (float): actions per second, greater than 0. Default 1.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``.

    Raises:
        TypeError: the actions are no floating-point tensor, or the rate is no number.
        ValueError: an episode has fewer than four steps, or the rate is not greater than 0.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import action_jerk
        >>> action_jerk(torch.arange(6.0).pow(3).unsqueeze(-1))
        tensor(6.)
    """
    actions = episodes_of("action_jerk", actions, 4)
    check_real("action_jerk: sampling_rate", sampling_rate, above=0)
    third = actions.diff(n=3, dim=-2)
    return sampling_rate**3 * torch.linalg.vector_norm(third, dim=-1).mean(-1)


def previous_action_gain(actions: Tensor) -> Tensor:
    r"""Gain of an action on the action before it: the slope of :math:`a_t` over :math:`a_{t-1}`.

    .. math::
        \frac{\sum_t (a_t - \bar a)(a_{t-1} - \bar a)}{\sum_t (a_{t-1} - \bar a)^2}

    The sums are over all dimensions, and :math:`\bar a` is the episode's mean. Apart from the
    episode's ends, this is the lag-1 autocorrelation of the actions. It is between -1 and 1 in long
    episodes; in episodes of a few steps it may lie beyond. Near 1 the action moves slowly. Near 0
    successive actions are unrelated. Near -1 the action flips from step to step, which is shaking
    at half the control rate.

    Args:
        actions (Tensor): actions of whole episodes, shape ``[*B, T, A]`` with at least two steps.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``; NaN where the action never changes.

    Raises:
        TypeError: the actions are no floating-point tensor.
        ValueError: an episode has fewer than two steps.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import previous_action_gain
        >>> previous_action_gain(torch.tensor([[1.0], [-1.0], [1.0], [-1.0]]))
        tensor(-1.)
    """
    actions = episodes_of("previous_action_gain", actions, 2)
    # Constant actions first become zeros, whose mean has no rounding error.
    moved = actions - actions[..., :1, :]
    centered = moved - moved.mean(-2, keepdim=True)
    before, after = centered[..., :-1, :], centered[..., 1:, :]
    return (after * before).sum((-2, -1)) / before.square().sum((-2, -1))


def saturation(
    actions: Tensor, low: Tensor | float, high: Tensor | float, margin: float = 0.01
) -> Tensor:
    r"""The share of actions at or beyond their bounds, or within a margin of them.

    A policy that is often at its bounds is bang-bang control, or asks for more than is possible:
    its network may be smooth while its actions are not. Between 0 and 1.

    Args:
        actions (Tensor): mean actions, shape ``[*B, T, A]``.
        low (Tensor or float): lower bounds, broadcast over the actions.
        high (Tensor or float): upper bounds.
        margin (float): share of the range that counts as its end, at least 0; a range without a
            bound on one side has no margin. Default 0.01.

    Returns:
        Tensor: the measure of each episode, shape ``[*B]``, over its steps and dimensions; NaN
        where an action is NaN.

    Raises:
        TypeError: the actions are no floating-point tensor, the margin is no number, or a bound is
            a spec.
        ValueError: the shape is wrong, the margin is negative, or a lower bound is above the upper.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.metrics import saturation
        >>> saturation(torch.tensor([[-1.2], [0.0], [0.995], [0.5]]), -1.0, 1.0)
        tensor(0.5000)
    """
    actions = episodes_of("saturation", actions, 1)
    check_real("saturation: margin", margin, at_least=0)
    if any(hasattr(bound, "space") for bound in (low, high)):
        raise TypeError("saturation: low and high are bounds: pass spec.space.low, spec.space.high")
    # Bounds of another precision would not be reached exactly.
    low, high = (
        torch.as_tensor(bound, dtype=actions.dtype, device=actions.device) for bound in (low, high)
    )
    if not bool((low <= high).all()):
        raise ValueError(f"saturation: low must be at most high, got {low} and {high}.")
    width = margin * (high - low)
    width = width.where(width.isfinite(), 0.0)
    ends = ((actions <= low + width) | (actions >= high - width)).float()
    return ends.where(~actions.isnan(), math.nan).mean((-2, -1))


def episodes_of(name: str, actions: Tensor, least: int) -> Tensor:
    """Checks actions, and casts half precision, in which sums lose digits and powers overflow.

    Args:
        name: name of the measure, for messages.
        actions: actions of whole episodes, ``[*B, T, A]``.
        least: smallest number of steps.

    Returns:
        The actions, in single precision at least.

    Raises:
        TypeError: the actions are no floating-point tensor.
        ValueError: the shape is wrong, or there are fewer steps.
    """
    if not isinstance(actions, Tensor) or not actions.is_floating_point():
        given = getattr(actions, "dtype", type(actions).__name__)
        raise TypeError(
            f"{name}: actions must be a floating-point tensor, got {given}: torch.as_tensor(...) "
            "and .float() make one, of labels their one-hot vectors."
        )
    if actions.ndim < 2 or actions.shape[-2] < least:
        raise ValueError(
            f"{name}: actions must have shape [*B, T, A] with T of at least {least}, got "
            f"{tuple(actions.shape)}."
        )
    return in_single(actions)


def in_single(tensor: Tensor) -> Tensor:
    """Casts half precision, in which squares overflow or become 0, to single precision."""
    return tensor.float() if tensor.itemsize < 4 else tensor
