r"""The equations of PPO-RPE, as functions of tensors.

Kobayashi, "Proximal policy optimization with relative Pearson divergence", arXiv:2010.03290, of
which the abstract alone could be read: see :class:`~torchrl_l2c2.PPORPELoss` for what is inferred.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor


def relative_density_ratio(
    ratio: Tensor,  # shape: [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The density ratio to a mixture, :math:`\rho_R = \rho / (1 - \beta + \beta\rho)`.

    Args:
        ratio: :math:`\rho = \pi(a|s) / b(a|s)`, at least 0.
        beta: share of :math:`\pi` in the mixture, in ``(0, 1)``. Larger values bound the relative
            ratio, which lies in :math:`[0, 1 / \beta)`, more tightly.

    Examples:
        >>> import torch
        >>> relative_density_ratio(torch.tensor([0.0, 1.0, 3.0]), beta=0.5)
        tensor([0.0000, 1.0000, 1.5000])
    """
    return ratio / (1.0 - beta + beta * ratio)


def penalty_gain(
    advantage: Tensor,  # shape: [*B]
    threshold: Tensor,  # shape: [] or [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The gain at which the loss is stationary just where the ratio meets the threshold.

    .. math::
        C = |A| / \big(\epsilon\,((1-\beta) - \mathrm{sgn}(A)\,\beta\epsilon/2)\big)

    Args:
        advantage: :math:`A`.
        threshold: :math:`\epsilon`, allowed :math:`|\rho_R - 1|`, in :math:`(0, 2(1/\beta - 1))`:
            beyond, the gain is negative. Larger values penalize less.
        beta: as in :func:`relative_density_ratio`.

    Examples:
        >>> import torch
        >>> penalty_gain(torch.tensor([1.0, -1.0]), torch.tensor(0.4), beta=0.5)
        tensor([6.2500, 4.1667])
    """
    stationary = (1.0 - beta) - advantage.sign() * beta * threshold / 2.0
    return advantage.abs() / (threshold * stationary)


def actor_loss(
    advantage: Tensor,  # shape: [*B]
    ratio: Tensor,  # shape: [*B]
    threshold: Tensor,  # shape: [] or [*B]
    beta: float,
) -> Tensor:  # shape: [*B]
    r"""The policy's loss: the penalized, importance-weighted advantage.

    .. math::
        L_\pi = -A\rho + \tfrac{C}{2} (1-\beta+\beta\rho) (\rho_R - 1)^2

    Args:
        advantage: :math:`A`, without a gradient.
        ratio: :math:`\rho`, as in :func:`relative_density_ratio`.
        threshold: as in :func:`penalty_gain`.
        beta: likewise.

    Examples:
        >>> import torch
        >>> actor_loss(torch.tensor(1.0), torch.tensor([1.0, 3.0]), torch.tensor(0.4), beta=0.5)
        tensor([-1.0000, -1.4375])
    """
    relative_ratio = relative_density_ratio(ratio, beta)
    mixture = 1.0 - beta + beta * ratio
    divergence = 0.5 * mixture * (relative_ratio - 1.0).square()
    return penalty_gain(advantage, threshold, beta) * divergence - advantage * ratio


def critic_loss(
    target: Tensor,  # shape: [*B, 1]
    heads: Tensor,  # shape: [*B, K]
) -> Tensor:  # shape: [*B]
    r"""The value function's loss, :math:`L_V = \tfrac12 \sum_k (y - V_k(s))^2`.

    Args:
        target: :math:`y`, one for all heads [inferred].
        heads: :math:`V_k(s)`.

    Examples:
        >>> import torch
        >>> critic_loss(torch.tensor([[1.0]]), torch.tensor([[0.0, 3.0]]))
        tensor([2.5000])
    """
    return 0.5 * (target - heads).square().sum(-1)


def update_deviation(
    largest: Tensor,  # shape: []
    relative_ratio: Tensor,  # shape: [*B]
    *,
    decay: float,
    floor: float,
    reading: Literal["max", "ema"],
    mask: Tensor | None = None,  # shape: [*B]
) -> tuple[Tensor, Tensor]:  # shape: [], []
    r"""The batch's deviation of the ratio, and :math:`\Delta`, to which the threshold is set.

    With ``reading="max"``, :math:`\Delta \leftarrow \max(\Delta_{\min}, \delta\Delta,
    \max|\rho_R - 1|)`; with ``"ema"``, :math:`\Delta \leftarrow \max(\Delta_{\min}, \delta\Delta +
    (1 - \delta)\,\mathrm{mean}|\rho_R - 1|)` [inferred].

    Args:
        largest: :math:`\Delta` before.
        relative_ratio: :math:`\rho_R`, without a gradient. NaN counts as no deviation: it shows in
            the losses, and must not stay in a running maximum as well.
        decay: :math:`\delta`, in ``[0, 1]``. Smaller values forget large deviations sooner.
        floor: :math:`\Delta_{\min}`, greater than 0.
        reading: how batches are summed up.
        mask: which of the batch count; ``None``: all.

    Returns:
        The largest or, with ``"ema"``, mean :math:`|\rho_R - 1|` of the batch; and :math:`\Delta`
        after it.

    Examples:
        >>> import torch
        >>> ratio = torch.tensor([1.0, 1.5])
        >>> update_deviation(torch.tensor(0.1), ratio, decay=0.9, floor=0.1, reading="max")
        (tensor(0.5000), tensor(0.5000))
    """
    deviation = (relative_ratio - 1.0).abs().nan_to_num(0.0)
    if mask is not None:
        deviation = torch.where(mask, deviation, 0.0)
    if reading == "max":
        deviation = deviation.max()
        updated = (decay * largest).maximum(deviation)
    else:
        count = None if mask is None else mask.sum().clamp_min(1)
        deviation = deviation.mean() if count is None else deviation.sum() / count
        updated = decay * largest + (1.0 - decay) * deviation
    return deviation, updated.clamp_min(floor)


def importance_weight(
    weight: Tensor,  # shape: [*B]
    reading: Literal["max", "mean"],
    mask: Tensor | None = None,  # shape: [*B]
) -> Tensor:  # shape: [*B]
    r"""The weights of prioritized replay over their largest, or over their mean [inferred].

    Args:
        weight: as the replay buffer gives them, at least 0.
        reading: what they are divided by.
        mask: which of the batch count; ``None``: all.

    Examples:
        >>> import torch
        >>> weight, mask = torch.tensor([1.0, 2.0, 8.0]), torch.tensor([True, True, False])
        >>> importance_weight(weight, "max", mask)
        tensor([0.5000, 1.0000, 0.0000])
    """
    if mask is None:
        return weight / (weight.max() if reading == "max" else weight.mean())
    kept = torch.where(mask, weight, 0.0)
    divisor = kept.max() if reading == "max" else kept.sum() / mask.sum().clamp_min(1)
    # Where nothing counts, 0 / 0 would be a gradient of NaN behind a loss of 0.
    return kept / divisor.clamp_min(torch.finfo(kept.dtype).tiny)


def of_each_transition(
    log_ratio: Tensor,  # shape: [*B] or [*B, 1]
    advantage: Tensor,  # shape: [*B]
) -> Tensor:  # shape: [*B]
    """A log-likelihood as one number for each transition, as its advantage is.

    Raises:
        ValueError: it is one for each of several actions.
    """
    if log_ratio.shape == (*advantage.shape, 1):
        return log_ratio.squeeze(-1)
    if log_ratio.shape != advantage.shape:
        raise ValueError(
            f"the log-likelihood of an action must be one number, of shape "
            f"{tuple(advantage.shape)} in this batch, got {tuple(log_ratio.shape)}: use a "
            "distribution over whole actions, such as torchrl's IndependentNormal or TanhNormal."
        )
    return log_ratio
