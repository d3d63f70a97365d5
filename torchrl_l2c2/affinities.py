"""Closed forms of the squared Hellinger distance, as log-affinities, in an open registry."""

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
from torchrl.modules import MaskedCategorical, TanhNormal

LogAffinity = Callable[[Any, Any], Tensor]

_LOG_AFFINITIES: dict[tuple[type, type], LogAffinity] = {}


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

    Returns:
        The decorator, which returns the function as it is.

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
            raise TypeError(
                f"register_hellinger takes subclasses of torch.distributions.Distribution, "
                f"got {kind!r}."
            )

    def decorator(function: LogAffinity) -> LogAffinity:
        _LOG_AFFINITIES[type_p, type_q] = function
        if type_p is not type_q:
            _LOG_AFFINITIES[type_q, type_p] = lambda p, q: function(q, p)
        return function

    return decorator


def log_affinity(p: Distribution, q: Distribution) -> Tensor:
    """The closed form of a pair; ``NotImplemented`` where none is registered."""
    for type_p in type(p).__mro__:
        for type_q in type(q).__mro__:
            if (type_p, type_q) in _LOG_AFFINITIES:
                return _LOG_AFFINITIES[type_p, type_q](p, q)
    return NotImplemented


def sum_to(x: Tensor, ndim: int) -> Tensor:
    """The sum over all but the first dimensions."""
    return x if x.ndim == ndim else x.flatten(ndim).sum(-1)


@register_hellinger(Normal)
def _normal(p: Normal, q: Normal) -> Tensor:
    # 2 s t / (s^2 + t^2) = 1 / (1 + (s - t)^2 / (2 s t)): no cancellation for close scales, no
    # overflow for distant scales. Quotients come first: tiny scales would underflow.
    difference = p.scale - q.scale
    spread = 0.5 * (difference / p.scale) * (difference / q.scale)
    shift = (p.loc - q.loc) / torch.hypot(p.scale, q.scale)
    return -0.5 * torch.log1p(spread) - 0.25 * shift.square()


@register_hellinger(Categorical)
@register_hellinger(OneHotCategorical)
def _categorical(p: Categorical, q: Categorical) -> Tensor:
    return _finite_log_affinity(p.probs, q.probs)


@register_hellinger(MaskedCategorical)
def _masked_categorical(p: MaskedCategorical, q: MaskedCategorical) -> Tensor:
    return _finite_log_affinity(all_probs(p), all_probs(q))


def all_probs(distribution: Any) -> Tensor:
    """The probabilities ``[*B, N]`` of all discrete actions, including masked actions."""
    if not getattr(distribution, "_sparse_mask", False):
        return distribution.probs
    # A sparse mask keeps only the probabilities of the listed actions. Padding has probability 0
    # and may be listed under any number.
    listed = distribution._mask.clamp(0, distribution.num_samples - 1)
    shape = (*distribution.batch_shape, distribution.num_samples)
    return distribution.probs.new_zeros(shape).scatter_add(-1, listed, distribution.probs)


@register_hellinger(Bernoulli)
def _bernoulli(p: Bernoulli, q: Bernoulli) -> Tensor:
    return _finite_log_affinity(_both_outcomes(p), _both_outcomes(q))


def _both_outcomes(distribution: Bernoulli) -> Tensor:
    # 1 - probs has no digits left if a policy given by its logits is nearly certain.
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
    base = log_affinity(p.base_dist, q.base_dist)
    if base is NotImplemented:
        return NotImplemented
    return sum_to(base, base.ndim - p.reinterpreted_batch_ndims)


@register_hellinger(TransformedDistribution)
def _transformed(p: TransformedDistribution, q: TransformedDistribution) -> Tensor:
    bijective = all(transform.bijective for transform in p.transforms)
    if not bijective or p.transforms != q.transforms:
        return NotImplemented
    return log_affinity(p.base_dist, q.base_dist)


@register_hellinger(TanhNormal)
def _tanh_normal(p: TanhNormal, q: TanhNormal) -> Tensor:
    base, same = log_affinity(p.base_dist, q.base_dist), same_bounds(p, q)
    if isinstance(same, Tensor):
        return torch.where(same, base, math.nan)
    return base if same else NotImplemented


def same_bounds(p: TanhNormal, q: TanhNormal) -> bool | Tensor:
    """Compares the bounds of two policies; returns a tensor where Python cannot wait for it.

    That is under ``torch.compile`` and while a CUDA graph is captured. The caller then makes
    different bounds visible as NaN.
    """
    same = (p.low == q.low).all() & (p.high == q.high).all()
    capturing = p.loc.is_cuda and torch.cuda.is_current_stream_capturing()
    return same if torch.compiler.is_compiling() or capturing else bool(same)


@register_hellinger(CompositeDistribution)
def _composite(p: CompositeDistribution, q: CompositeDistribution) -> Tensor:
    parts = []
    for name, entry in p.dists.items():
        part = log_affinity(entry, q.dists[name])
        if part is NotImplemented:
            return NotImplemented
        parts.append(sum_to(part, max(len(p.batch_shape), len(q.batch_shape))))
    return functools.reduce(torch.add, parts)
