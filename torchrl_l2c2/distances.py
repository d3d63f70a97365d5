"""Distances between policies and between values: squared Hellinger and squared error."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Categorical,
    Distribution,
    Independent,
    Normal,
    OneHotCategorical,
    TransformedDistribution,
)
from torch.distributions.utils import _sum_rightmost
from torchrl.modules import Delta, MaskedCategorical, TanhDelta, TanhNormal

from torchrl_l2c2._checks import check_positive_int

LogAffinity = Callable[[Any, Any], Tensor]

MONTE_CARLO_SAMPLES = 16
"""Actions drawn from each policy where no closed form is known and no number was asked for."""

_LOG_AFFINITIES: dict[tuple[type, type], LogAffinity] = {}


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

    is the distance of policies of Kobayashi, L2C2, 2022 (:math:`d_\pi`). It lies in ``[0, 1]``, is
    symmetric, and no bijection of the action changes it. Its gradient flows into both policies.

    By default it is exact, in closed form, for normal, categorical and Bernoulli policies, masked,
    independent, squashed or composed of several (see :func:`register_hellinger` for others).
    A pair without a closed form is estimated from :data:`MONTE_CARLO_SAMPLES` actions each.
    With ``num_samples`` it is estimated by importance sampling, as in the paper, the mixture
    :math:`b = (p + q) / 2` being the sampler:

    .. math::
        H^2(p, q) = \mathbb E_{a \sim b}\left[
            \frac 1 2 \left(\sqrt{\frac{p(a)}{b(a)}} - \sqrt{\frac{q(a)}{b(a)}}\right)^2\right].

    The estimate and its gradient are unbiased, and each term lies in ``[0, 1]``.
    With ``sample`` and ``sample_log_prob`` one replayed action takes the place of the expectation,
    its stored likelihood that of :math:`b`: unbiased if it was drawn from :math:`b`, but unbounded.

    .. note:: Under ``torch.compile``, or while a CUDA graph is captured, two
        :class:`~torchrl.modules.TanhNormal` of different bounds give NaN, where eager code falls
        back to sampling: the bounds cannot be compared before the computation.

    Args:
        p: one policy, batch shape ``[*B]``.
        q: the other, with the same event shape and a batch shape that broadcasts.
        num_samples: actions drawn from each of the two policies, at least 1; the standard
            deviation falls with its square root. TorchRL's masked policies score no batch of
            draws, so they have the closed form only. Defaults to ``None``, the closed form.
        sample: replayed actions, shape ``[*B, *event]``.
        sample_log_prob: their log-likelihood when they were taken, ``[*B]``, without a gradient.

    Returns:
        The distances, shape ``[*B]``.

    Raises:
        TypeError: if a policy is deterministic or can neither be sampled nor scored, or
            ``num_samples`` is no integer.
        ValueError: if the event shapes differ, or arguments are out of range or contradictory.

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
    _check_pair(p, q)
    if sample is not None or sample_log_prob is not None:
        if sample is None or sample_log_prob is None:
            raise ValueError("sample and sample_log_prob belong together: give both or neither.")
        if num_samples is not None:
            raise ValueError("give either num_samples or a replayed sample, not both.")
        return _weighted_difference(p, q, sample, sample_log_prob)
    if num_samples is not None:
        return _monte_carlo(p, q, num_samples)
    log_affinity = _log_affinity(p, q)
    if log_affinity is NotImplemented:
        return _monte_carlo(p, q, MONTE_CARLO_SAMPLES)
    return -torch.expm1(log_affinity)


def register_hellinger(
    type_p: type[Distribution], type_q: type[Distribution] | None = None
) -> Callable[[LogAffinity], LogAffinity]:
    r"""Registers the closed form of a pair of distributions with :func:`squared_hellinger`.

    The decorated function takes ``p`` and ``q`` and returns their log-affinity
    :math:`\ln \int \sqrt{p(a)\, q(a)}\, da`, the logarithm of the Bhattacharyya coefficient, in the
    batch shape; or ``NotImplemented`` where this very pair has no closed form. It serves subclasses
    too, the most specific type of ``p`` first, and both orders of the pair.

    Args:
        type_p: the class of one distribution.
        type_q: the class of the other. Defaults to ``type_p``.

    Raises:
        TypeError: if a type is not a subclass of :class:`torch.distributions.Distribution`.

    Examples:
        >>> import torch
        >>> from torch.distributions import Poisson
        >>> from torchrl_l2c2 import register_hellinger, squared_hellinger
        >>> @register_hellinger(Poisson)
        ... def poisson_log_affinity(p, q):
        ...     return -0.5 * (p.rate.sqrt() - q.rate.sqrt()).square()
        >>> squared_hellinger(Poisson(torch.tensor(1.0)), Poisson(torch.tensor(4.0)))
        tensor(0.3935)
    """
    type_q = type_p if type_q is None else type_q
    for kind in (type_p, type_q):
        if not (isinstance(kind, type) and issubclass(kind, Distribution)):
            expected = "subclasses of torch.distributions.Distribution"
            raise TypeError(f"register_hellinger takes {expected}, got {kind!r}.")

    def decorator(function: LogAffinity) -> LogAffinity:
        _LOG_AFFINITIES[type_p, type_q] = function
        if type_p is not type_q:
            _LOG_AFFINITIES[type_q, type_p] = lambda p, q: function(q, p)
        return function

    return decorator


def squared_error(a: Tensor, b: Tensor) -> Tensor:
    r"""Half the squared error over the last dimension.

    :math:`\frac 1 2 \lVert a - b \rVert_2^2`, the distance of values of Kobayashi, L2C2, 2022
    (:math:`d_V`, over the heads of an ensemble), and of mean actions of CAPS.

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


def _check_pair(p: Distribution, q: Distribution) -> None:
    for distribution in (p, q):
        if isinstance(distribution, (Delta, TanhDelta)):
            raise TypeError(
                f"{type(distribution).__name__} has no density, so no Hellinger distance: compare "
                "the actions of deterministic policies with squared_error."
            )
    if isinstance(p, CompositeDistribution) and isinstance(q, CompositeDistribution):
        if p.dists.keys() != q.dists.keys():
            entries = [sorted(map(str, composite.dists)) for composite in (p, q)]
            raise ValueError(
                f"p and q must be composed of the same entries, got {entries[0]} and {entries[1]}."
            )
        for name, entry in p.dists.items():
            _check_pair(entry, q.dists[name])
        return
    if p.event_shape != q.event_shape:
        raise ValueError(
            "p and q must be distributions of the same actions, got event shapes "
            f"{tuple(p.event_shape)} and {tuple(q.event_shape)}."
        )


def _log_affinity(p: Distribution, q: Distribution) -> Tensor:
    for type_p in type(p).__mro__:
        for type_q in type(q).__mro__:
            if (type_p, type_q) in _LOG_AFFINITIES:
                return _LOG_AFFINITIES[type_p, type_q](p, q)
    return NotImplemented


def _monte_carlo(p: Distribution, q: Distribution, num_samples: int) -> Tensor:
    check_positive_int("num_samples", num_samples)
    shape = torch.Size([num_samples])
    try:
        # Half of the draws from either policy: the mixture, without the noise of a coin.
        halves = [_mixture_difference(p, q, source.sample(shape)) for source in (p, q)]
    except NotImplementedError as error:
        raise TypeError(
            f"{type(p).__name__} and {type(q).__name__} have no closed-form Hellinger distance "
            "and cannot be sampled and scored: register one with register_hellinger."
        ) from error
    return 0.5 * (halves[0] + halves[1])


def _mixture_difference(p: Distribution, q: Distribution, sample: Any) -> Tensor:
    log_p, log_q = _log_prob(p, sample), _log_prob(q, sample)
    log_b = torch.logaddexp(log_p.detach(), log_q.detach()) - math.log(2.0)
    return _root_difference(log_p - log_b, log_q - log_b).mean(0)


def _weighted_difference(
    p: Distribution, q: Distribution, sample: Any, sample_log_prob: Tensor
) -> Tensor:
    log_p, log_q = _log_prob(p, sample), _log_prob(q, sample)
    if sample_log_prob.shape != log_p.shape:
        raise ValueError(
            "sample_log_prob must have the shape of the policies' log-likelihood of the sample, "
            f"{tuple(log_p.shape)}, got {tuple(sample_log_prob.shape)}."
        )
    log_b = sample_log_prob.detach()
    return _root_difference(log_p - log_b, log_q - log_b)


def _root_difference(log_ratio_p: Tensor, log_ratio_q: Tensor) -> Tensor:
    return 0.5 * ((0.5 * log_ratio_p).exp() - (0.5 * log_ratio_q).exp()).square()


def _log_prob(distribution: Distribution, sample: Any) -> Tensor:
    if not isinstance(distribution, CompositeDistribution):
        return distribution.log_prob(sample)
    # Its own log_prob returns a tensor or a TensorDict, as a global switch says.
    heads = distribution.dists.items()
    parts = (_sum_to(_log_prob(head, sample.get(name)), sample.ndim) for name, head in heads)
    return functools.reduce(torch.add, parts)


def _sum_to(x: Tensor, ndim: int) -> Tensor:
    return _sum_rightmost(x, x.ndim - ndim)


@register_hellinger(Normal)
def _normal(p: Normal, q: Normal) -> Tensor:
    # 2 s t / (s^2 + t^2) = 1 / (1 + (s - t)^2 / (2 s t)): no cancellation for close scales, no
    # overflow for distant ones. Quotients come first so that tiny scales do not underflow.
    difference = p.scale - q.scale
    spread = 0.5 * (difference / p.scale) * (difference / q.scale)
    shift = (p.loc - q.loc) / torch.hypot(p.scale, q.scale)
    return -0.5 * torch.log1p(spread) - 0.25 * shift.square()


@register_hellinger(Categorical)
@register_hellinger(OneHotCategorical)
@register_hellinger(MaskedCategorical)
def _categorical(p: Categorical, q: Categorical) -> Tensor:
    return _finite_log_affinity(_all_probs(p), _all_probs(q))


def _all_probs(distribution: Any) -> Tensor:
    if not getattr(distribution, "_sparse_mask", False):
        return distribution.probs
    # A sparse mask keeps the probabilities of the listed actions only. Padding has none, and may
    # be listed under any number.
    listed = distribution._mask.clamp(0, distribution.num_samples - 1)
    shape = (*distribution.batch_shape, distribution.num_samples)
    return distribution.probs.new_zeros(shape).scatter_add(-1, listed, distribution.probs)


@register_hellinger(Bernoulli)
def _bernoulli(p: Bernoulli, q: Bernoulli) -> Tensor:
    return _finite_log_affinity(_both_outcomes(p), _both_outcomes(q))


def _both_outcomes(distribution: Bernoulli) -> Tensor:
    # 1 - probs has no digits left where a policy given by its logits is sure.
    from_logits = distribution._param is distribution.logits
    failure = torch.sigmoid(-distribution.logits) if from_logits else 1.0 - distribution.probs
    return torch.stack((distribution.probs, failure), -1)


def _finite_log_affinity(p: Tensor, q: Tensor) -> Tensor:
    limits = torch.finfo(p.dtype)
    # Clamped, the root has a zero gradient at probability zero, not an infinite one.
    difference = p.clamp_min(limits.tiny).sqrt() - q.clamp_min(limits.tiny).sqrt()
    squared = 0.5 * difference.square().sum(-1)
    # Disjoint supports: an affinity of 0 would have an infinite logarithm and a NaN gradient.
    return torch.log1p(-squared.clamp_max(1.0 - 0.5 * limits.eps))


@register_hellinger(Independent)
def _independent(p: Independent[Any], q: Independent[Any]) -> Tensor:
    log_affinity = _log_affinity(p.base_dist, q.base_dist)
    if log_affinity is NotImplemented:
        return NotImplemented
    return _sum_rightmost(log_affinity, p.reinterpreted_batch_ndims)


@register_hellinger(TransformedDistribution)
def _transformed(p: TransformedDistribution, q: TransformedDistribution) -> Tensor:
    bijective = all(transform.bijective for transform in p.transforms)
    if not bijective or p.transforms != q.transforms:
        return NotImplemented
    return _log_affinity(p.base_dist, q.base_dist)


@register_hellinger(TanhNormal)
def _tanh_normal(p: TanhNormal, q: TanhNormal) -> Tensor:
    log_affinity = _log_affinity(p.base_dist, q.base_dist)
    same_bounds = (p.low == q.low).all() & (p.high == q.high).all()
    # Where Python cannot wait for the answer, a wrong one must at least show.
    capturing = p.loc.is_cuda and torch.cuda.is_current_stream_capturing()
    if torch.compiler.is_compiling() or capturing:
        return torch.where(same_bounds, log_affinity, math.nan)
    return log_affinity if same_bounds else NotImplemented


@register_hellinger(CompositeDistribution)
def _composite(p: CompositeDistribution, q: CompositeDistribution) -> Tensor:
    parts = []
    for name, entry in p.dists.items():
        log_affinity = _log_affinity(entry, q.dists[name])
        if log_affinity is NotImplemented:
            return NotImplemented
        parts.append(_sum_to(log_affinity, len(p.batch_shape)))
    return functools.reduce(torch.add, parts)
