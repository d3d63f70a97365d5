"""Distances between policies and between values: squared Hellinger and squared error."""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Categorical, Distribution
from torchrl.modules import Delta, TanhDelta

from torchrl_l2c2._checks import check_positive_int
from torchrl_l2c2.affinities import log_affinity, sum_to

MONTE_CARLO_SAMPLES = 16
"""Actions drawn from each policy where no closed form is known and no number was asked for."""


def squared_hellinger(
    p: Distribution,
    q: Distribution,
    *,
    num_samples: int | None = None,
    sample: Any = None,
    sample_log_prob: Tensor | None = None,
) -> Tensor:
    r"""Squared Hellinger distance between two policies.

    .. math::
        H^2(p, q) = \frac 1 2 \int \left(\sqrt{p(a)} - \sqrt{q(a)}\right)^2 da
                  = 1 - \int \sqrt{p(a)\, q(a)}\, da

    This is the distance between policies of Kobayashi, L2C2, 2022 (:math:`d_\pi`). It lies in
    ``[0, 1]``, is symmetric, and a bijection of the action does not change it. Its gradient flows
    into both policies.

    By default it is exact, in closed form, for normal, categorical and Bernoulli policies, masked,
    independent, squashed or composed of several (see :func:`register_hellinger` for others).
    A pair without a closed form is estimated from :data:`MONTE_CARLO_SAMPLES` actions each.

    With ``num_samples`` it is estimated by importance sampling, as in the paper. The sampler is the
    mixture :math:`b = (p + q) / 2`:

    .. math::
        H^2(p, q) = \mathbb E_{a \sim b}\left[
            \frac 1 2 \left(\sqrt{\frac{p(a)}{b(a)}} - \sqrt{\frac{q(a)}{b(a)}}\right)^2\right].

    The estimate and its gradient are unbiased, and each term lies in ``[0, 1]``.

    With ``sample`` and ``sample_log_prob`` the estimate uses one replayed action, and its stored
    likelihood instead of the likelihood under :math:`b`. This is also unbiased if the action was
    drawn from :math:`b`, but unbounded.

    .. note::
        Under ``torch.compile``, or while a CUDA graph is captured, the bounds of two
        :class:`~torchrl.modules.TanhNormal` cannot be compared before the computation: different
        bounds then give NaN, where eager code falls back to sampling.

    Args:
        p: one policy, batch shape ``[*B]``.
        q: the other, with the same event shape and a batch shape that broadcasts.
        num_samples: actions drawn from each of the two policies, at least 1; the standard
            deviation falls with its square root. TorchRL's masked policies cannot score a batch of
            draws and have only the closed form. Defaults to ``None``, the closed form.
        sample: replayed actions, shape ``[*B, *event]``.
        sample_log_prob: their log-likelihood when they were taken, shape ``[*B]``; carries no
            gradient.

    Returns:
        The distances, shape ``[*B]``.

    Raises:
        TypeError: if a policy is deterministic or can neither be sampled nor scored, or
            ``num_samples`` is no integer.
        ValueError: if the event shapes differ, ``num_samples`` is below 1, or the arguments
            contradict each other, or a registered closed form has another shape.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal
        >>> from torchrl_l2c2 import squared_hellinger
        >>> p, q = Normal(torch.zeros(2), 1.0), Normal(torch.tensor([0.0, 2.0]), 1.0)
        >>> squared_hellinger(p, q)
        tensor([0.0000, 0.3935])
        >>> squared_hellinger(p, q, num_samples=8).shape
        torch.Size([2])
        >>> squared_hellinger(p, q, sample=torch.zeros(2), sample_log_prob=torch.zeros(2))
        tensor([0.0000, 0.0797])
    """
    check_pair(p, q)
    if sample is not None or sample_log_prob is not None:
        if sample is None or sample_log_prob is None:
            raise ValueError("sample and sample_log_prob belong together: give both or neither.")
        if num_samples is not None:
            raise ValueError("give either num_samples or a replayed sample, not both.")
        return _weighted_difference(p, q, sample, sample_log_prob)
    if num_samples is not None:
        return _monte_carlo(p, q, num_samples)
    exact = log_affinity(p, q)
    if exact is NotImplemented:
        return _monte_carlo(p, q, MONTE_CARLO_SAMPLES)
    pairs = torch.broadcast_shapes(p.batch_shape, q.batch_shape)
    if exact.shape != pairs:
        raise ValueError(
            f"the closed form of {type(p).__name__} and {type(q).__name__} must return one number "
            f"for each pair of policies, shape {tuple(pairs)}, got {tuple(exact.shape)}: sum over "
            "the action's dimensions in what register_hellinger has."
        )
    return -torch.expm1(exact)


def squared_error(a: Tensor, b: Tensor) -> Tensor:
    r"""Half the squared error over the last dimension.

    :math:`\frac 1 2 \lVert a - b \rVert_2^2`, the distance between values of Kobayashi, L2C2, 2022
    (:math:`d_V`, over the heads of an ensemble), and between mean actions of CAPS.

    Args:
        a: values, shape ``[*B, N]``.
        b: values, with as many dimensions and the same ``N``; the others broadcast.

    Returns:
        The distances, shape ``[*B]``.

    Raises:
        ValueError: if the numbers of dimensions or the last dimensions differ.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import squared_error
        >>> squared_error(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))
        tensor([2.5000])
    """
    if a.ndim != b.ndim or a.shape[-1:] != b.shape[-1:]:
        raise ValueError(
            "squared_error takes tensors of as many dimensions and of the same last dimension, "
            f"got shapes {tuple(a.shape)} and {tuple(b.shape)}."
        )
    return 0.5 * (a - b).square().sum(-1)


def check_pair(p: Distribution, q: Distribution) -> None:
    """Refuses policies whose densities cannot be compared.

    Raises:
        TypeError: one is deterministic.
        ValueError: they are distributions of different actions.
    """
    for distribution in (p, q):
        if not isinstance(distribution, Distribution):
            raise TypeError(
                f"policies must be distributions, got {type(distribution).__name__}: compare "
                "actions with squared_error."
            )
        if isinstance(distribution, (Delta, TanhDelta)):
            raise TypeError(
                f"{type(distribution).__name__} has no density, so no Hellinger distance and no "
                "divergence: compare the actions of deterministic policies with squared_error."
            )
    if isinstance(p, CompositeDistribution) and isinstance(q, CompositeDistribution):
        if p.dists.keys() != q.dists.keys():
            raise ValueError(
                "p and q must be composed of the same entries, got "
                f"{sorted(map(str, p.dists))} and {sorted(map(str, q.dists))}."
            )
        for name, entry in p.dists.items():
            check_pair(entry, q.dists[name])
        return
    if p.event_shape != q.event_shape:
        raise ValueError(
            "p and q must be distributions of the same actions, got event shapes "
            f"{tuple(p.event_shape)} and {tuple(q.event_shape)}."
        )
    try:
        torch.broadcast_shapes(p.batch_shape, q.batch_shape)
    except RuntimeError as error:
        raise ValueError(
            "p and q must have batch shapes that broadcast, got "
            f"{tuple(p.batch_shape)} and {tuple(q.batch_shape)}."
        ) from error
    if _labels(p) != _labels(q):
        raise ValueError(
            "p and q must be distributions of the same actions, got "
            f"{type(p).__name__} of {_labels(p)} and {type(q).__name__} of {_labels(q)}."
        )


def _labels(distribution: Distribution) -> str:
    if not isinstance(distribution, Categorical):
        return "no labels"
    # All labels, also if a mask lists only some.
    return f"{getattr(distribution, 'num_samples', distribution.probs.shape[-1])} labels"


def _monte_carlo(p: Distribution, q: Distribution, num_samples: int) -> Tensor:
    check_positive_int("num_samples", num_samples)
    try:
        # Half of the draws from either policy: the mixture, without the noise of a coin.
        halves = [
            _mixture_difference(p, q, source.sample(draws(source, other, num_samples)))
            for source, other in ((p, q), (q, p))
        ]
    except (NotImplementedError, ValueError) as error:  # Masked policies score no batch of draws.
        raise TypeError(
            f"{type(p).__name__} and {type(q).__name__} cannot be sampled and scored: leave "
            "num_samples, or hellinger_samples, at None where there is a closed form, or register "
            "one with register_hellinger."
        ) from error
    return 0.5 * (halves[0] + halves[1])


def draws(source: Distribution, other: Distribution, num_samples: int) -> torch.Size:
    """The shape of draws from one policy that broadcast to another with more batch dimensions."""
    missing = len(other.batch_shape) - len(source.batch_shape)
    return torch.Size([num_samples, *[1] * missing])


def _mixture_difference(p: Distribution, q: Distribution, sample: Any) -> Tensor:
    log_p, log_q = log_prob_of(p, sample), log_prob_of(q, sample)
    log_b = torch.logaddexp(log_p.detach(), log_q.detach()) - math.log(2.0)
    return _root_difference(log_p - log_b, log_q - log_b).mean(0)


def _weighted_difference(
    p: Distribution, q: Distribution, sample: Any, sample_log_prob: Tensor
) -> Tensor:
    log_p, log_q = log_prob_of(p, sample), log_prob_of(q, sample)
    if sample_log_prob.shape != log_p.shape:
        raise ValueError(
            "sample_log_prob must have the shape of the policies' log-likelihood of the sample, "
            f"{tuple(log_p.shape)}, got {tuple(sample_log_prob.shape)}."
        )
    log_b = sample_log_prob.detach()
    return _root_difference(log_p - log_b, log_q - log_b)


def _root_difference(log_ratio_p: Tensor, log_ratio_q: Tensor) -> Tensor:
    return 0.5 * ((0.5 * log_ratio_p).exp() - (0.5 * log_ratio_q).exp()).square()


def log_prob_of(distribution: Distribution, sample: Any) -> Tensor:
    """The log-likelihood of actions, also of a composite policy's, in one tensor."""
    if not isinstance(distribution, CompositeDistribution):
        return distribution.log_prob(sample)
    # Its own log_prob returns a tensor or a TensorDict, as a global switch says.
    heads = distribution.dists.items()
    parts = (sum_to(log_prob_of(head, sample.get(name)), sample.ndim) for name, head in heads)
    return functools.reduce(torch.add, parts)
