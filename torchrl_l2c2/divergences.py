"""The Kullback-Leibler divergence of two policies, in closed form or estimated."""

from __future__ import annotations

import functools

import torch
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal, OneHotCategorical
from torch.distributions import kl_divergence as closed_kl_divergence
from torchrl.modules import TanhNormal
from torchrl.modules.distributions import has_analytic_kl

from torchrl_l2c2._checks import check_positive_int
from torchrl_l2c2.affinities import all_probs, same_bounds, sum_to
from torchrl_l2c2.distances import MONTE_CARLO_SAMPLES, check_pair, draws, log_prob_of


def kl_divergence(
    p: Distribution, q: Distribution, *, num_samples: int = MONTE_CARLO_SAMPLES
) -> Tensor:
    r"""Kullback-Leibler divergence of two policies, in closed form or as a non-negative estimate.

    .. math::
        D(p \Vert q) = \int p(a) \ln\frac{p(a)}{q(a)}\, da

    It lies in ``[0, inf]`` and is not symmetric. Squashing both policies in the same way does not
    change it. Closed forms come from torch; the heads of composite policies add up. A pair without
    a closed form is estimated from actions of :math:`p`:

    .. math::
        \mathbb E_{a \sim p}\left[r - 1 - \ln r\right], \qquad r = q(a) / p(a),

    No term is negative (Schulman, "Approximating KL divergence", 2020: k3). The estimate and its
    gradient into both policies are unbiased, if each policy has all actions of the other: it is
    too small for bounds that differ. Between categorical policies that are nearly the same, the
    closed form may be negative by rounding.

    Args:
        p: one policy, batch shape ``[*B]``.
        q: the other, of the same actions.
        num_samples: actions drawn where there is no closed form, at least 1; the standard deviation
            falls with its square root. Defaults to ``16``.

    Returns:
        The divergences, shape ``[*B]``.

    Raises:
        TypeError: a policy is deterministic, or can neither be sampled nor scored, or
            ``num_samples`` is no integer.
        ValueError: the event shapes differ, or ``num_samples`` is below 1.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal
        >>> from torchrl_l2c2.divergences import kl_divergence
        >>> kl_divergence(Normal(torch.tensor([0.0, 3.0]), 1.0), Normal(torch.zeros(2), 1.0))
        tensor([0.0000, 4.5000])
    """
    check_pair(p, q)
    check_positive_int("num_samples", num_samples)
    if isinstance(p, CompositeDistribution) and isinstance(q, CompositeDistribution):
        heads = (
            kl_divergence(head, q.dists[name], num_samples=num_samples)
            for name, head in p.dists.items()
        )
        ndim = max(len(p.batch_shape), len(q.batch_shape))
        return functools.reduce(torch.add, (sum_to(head, ndim) for head in heads))
    if isinstance(p, Independent) and isinstance(q, Independent):
        base = kl_divergence(p.base_dist, q.base_dist, num_samples=num_samples)
        return sum_to(base, base.ndim - p.reinterpreted_batch_ndims)
    for kind in (Categorical, OneHotCategorical):
        if isinstance(p, kind) and isinstance(q, kind):
            return _categorical_kl(p, q)
    if isinstance(p, TanhNormal) and isinstance(q, TanhNormal):
        # Torch's own comparison of the bounds does not compile.
        same = same_bounds(p, q)
        base = kl_divergence(p.base_dist, q.base_dist, num_samples=num_samples)
        if isinstance(same, Tensor):
            return torch.where(same, base, torch.nan)
        return base if same else _monte_carlo(p, q, num_samples)
    if isinstance(p, Normal) and isinstance(q, Normal):
        return _normal_kl(p, q)
    if has_analytic_kl(p, q):
        return closed_kl_divergence(p, q)
    return _monte_carlo(p, q, num_samples)


def _normal_kl(p: Normal, q: Normal) -> Tensor:
    """The closed form that torch has, too; torch's look-up of it does not compile."""
    ratio, apart = (p.scale / q.scale).square(), ((p.loc - q.loc) / q.scale).square()
    return 0.5 * (apart + (ratio - 1 - ratio.log()))


def _categorical_kl(
    p: Categorical | OneHotCategorical, q: Categorical | OneHotCategorical
) -> Tensor:
    """The closed form of torch, with a finite gradient for impossible (masked) actions."""
    probs_p, probs_q = all_probs(p), all_probs(q)
    possible, both = probs_p > 0, (probs_p > 0) & (probs_q > 0)
    logs = p.logits, q.logits
    listed = probs_p is not p.probs or probs_q is not q.probs
    if listed:  # by a sparse mask, in any order
        smallest = torch.finfo(probs_p.dtype).tiny
        logs = probs_p.clamp_min(smallest).log(), probs_q.clamp_min(smallest).log()
    log_p, log_q = (torch.where(both, log, 0.0) for log in logs)
    finite = (probs_p * (log_p - log_q)).sum(-1)
    return torch.where((possible & ~both).any(-1), torch.inf, finite)


def _monte_carlo(p: Distribution, q: Distribution, num_samples: int) -> Tensor:
    try:
        sample = p.sample(draws(p, q, num_samples))
        log_p, log_q = log_prob_of(p, sample), log_prob_of(q, sample)
    except NotImplementedError as error:
        raise TypeError(
            f"{type(p).__name__} and {type(q).__name__} have no closed-form divergence and cannot "
            "be sampled and scored: give a function of your own instead."
        ) from error
    log_ratio = log_q - log_p
    # The value is 1; the gradient is the sampling distribution's score.
    drawn = (log_p - log_p.detach()).exp()
    return (drawn * (torch.expm1(log_ratio) - log_ratio)).mean(0)
