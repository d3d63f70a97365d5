"""Distances between policies besides the Hellinger distance: between means, and KL divergence."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from tensordict.nn import CompositeDistribution
from torch import Tensor
from torch.distributions import (
    Bernoulli,
    Categorical,
    Distribution,
    Independent,
    OneHotCategorical,
    TransformedDistribution,
)
from torchrl.modules import TruncatedNormal

from torchrl_l2c2._checks import check_choice, check_positive_int
from torchrl_l2c2.affinities import all_probs
from torchrl_l2c2.distances import squared_error, squared_hellinger
from torchrl_l2c2.divergences import kl_divergence

PolicyDistance = Callable[[Distribution, Distribution], Tensor]
"""A distance of two policies of batch shape ``[*B]``: a tensor of that shape, at least 0."""

# Names of the distances in logs.
_NAMES = {"hellinger": "hellinger", "mean": "mean_distance", "mse": "mse", "kl": "kl"}


def choose_policy_distance(
    chosen: str | PolicyDistance, hellinger_samples: int | None = None
) -> PolicyDistance:
    """Returns the distance with this name, or checks the results of a given function.

    Args:
        chosen: ``"hellinger"``, ``"mean"``, ``"mse"``, ``"kl"`` or a function.
        hellinger_samples: actions drawn from each policy to estimate the Hellinger distance;
            ``None`` for its closed form.

    Raises:
        TypeError: neither a string nor a function, or ``hellinger_samples`` is no integer.
        ValueError: an unknown name, or ``hellinger_samples`` is below 1 or given with another
            distance.

    Examples:
        >>> import torch
        >>> from torch.distributions import Normal
        >>> from torchrl_l2c2.policy_distances import choose_policy_distance
        >>> distance = choose_policy_distance(lambda p, q: (p.mean - q.mean).abs())
        >>> distance(Normal(torch.zeros(2), 1.0), Normal(torch.ones(2), 1.0))
        tensor([1., 1.])
    """
    if hellinger_samples is not None:
        check_positive_int("hellinger_samples", hellinger_samples)
        if chosen != "hellinger":
            raise ValueError(
                "hellinger_samples is only for policy_distance='hellinger', got policy_distance="
                f"{chosen!r}: leave hellinger_samples at None."
            )
        hellinger_samples = int(hellinger_samples)  # NumPy's do not compile.
    if not isinstance(chosen, str) and callable(chosen):
        return functools.partial(_checked, chosen)
    hint = "Or give a function of two distributions."
    check_choice("policy_distance", chosen, tuple(_NAMES), hint=hint)
    if chosen == "hellinger":
        return functools.partial(squared_hellinger, num_samples=hellinger_samples)
    return {"mean": mean_distance, "mse": mean_squared_error, "kl": kl_divergence}[chosen]


def _checked(distance: PolicyDistance, p: Distribution, q: Distribution) -> Tensor:
    found = distance(p, q)
    if not isinstance(found, Tensor):
        raise TypeError(f"policy_distance must return a tensor, got {found!r}.")
    if found.shape != p.batch_shape:
        raise ValueError(
            "policy_distance must return one number for each pair of policies, a tensor of shape "
            f"{tuple(p.batch_shape)}, got {tuple(found.shape)}: sum over the action's dimensions, "
            "and over nothing else."
        )
    return found


def compare_policies(
    distance: PolicyDistance, p: Distribution | Tensor, q: Distribution | Tensor
) -> Tensor:
    """A distance of two policies, or of two actions: mean squared error or half the squared."""
    if distance is mean_squared_error:
        return mean_squared_error(p, q)
    if isinstance(p, Distribution) and isinstance(q, Distribution):
        return distance(p, q)
    assert isinstance(p, Tensor) and isinstance(q, Tensor)
    return squared_error(p, q)


def distance_name(
    chosen: str | PolicyDistance, stochastic: bool, hellinger_samples: int | None = None
) -> str:
    """Names the distance of :func:`choose_policy_distance` in logs.

    Args:
        chosen: as there.
        stochastic: whether the policies are distributions; otherwise their actions are compared.
        hellinger_samples: as there.

    Raises:
        TypeError: deterministic policies, and a distance that has no counterpart for actions, or
            samples.
    """
    if stochastic:
        return _NAMES[chosen] if isinstance(chosen, str) else "policy_distance"
    if chosen not in ("hellinger", "mean", "mse"):
        raise TypeError(
            "the loss has a deterministic policy, which is no distribution to compare by "
            f"policy_distance={chosen!r}: leave it at its default, here half the squared distance "
            "of the actions."
        )
    if hellinger_samples is not None:
        raise TypeError(
            "the loss has a deterministic policy, of which nothing is drawn, got hellinger_samples="
            f"{hellinger_samples!r}: leave it at None."
        )
    return "mse" if chosen == "mse" else "action_distance"


def policy_mean(policy: Distribution | Tensor, *, squashed: bool = False) -> Tensor:
    r"""The mean action of a policy, before it is squashed into the action's bounds or after.

    Args:
        policy: a distribution of batch shape ``[*B]``. The mean of a discrete distribution is its
            probabilities (actions as one-hot vectors). The heads of a composite distribution are
            concatenated. Actions ``[*B, A]`` are their own mean.
        squashed: ``False`` takes the mean before squashing or truncation, where saturated policies
            also differ; ``True`` takes the deterministic action.

    Returns:
        The means, shape ``[*B, A]``.

    Raises:
        NotImplementedError: the distribution has no mean.

    Examples:
        >>> import torch
        >>> from torchrl.modules import TanhNormal
        >>> from torchrl_l2c2.policy_distances import policy_mean
        >>> policy = TanhNormal(torch.tensor([[2.0]]), 1.0)
        >>> policy_mean(policy), policy_mean(policy, squashed=True)
        (tensor([[2.]]), tensor([[0.9640]]))
    """
    if isinstance(policy, Tensor):
        return policy
    if isinstance(policy, CompositeDistribution):
        ndim = len(policy.batch_shape)
        heads = (policy_mean(head, squashed=squashed) for head in policy.dists.values())
        # A head may have no dimension of its own, or several.
        return torch.cat([head.reshape(*head.shape[:ndim], -1) for head in heads], -1)
    if isinstance(policy, Categorical | OneHotCategorical):
        return all_probs(policy)
    mean = _mean(policy, squashed=squashed)
    # A single number may lack its dimension, as with torch's Normal; a matrix has one too many.
    return mean.flatten(len(policy.batch_shape)) if policy.event_shape else mean.unsqueeze(-1)


def _mean(policy: Distribution, *, squashed: bool) -> Tensor:
    if isinstance(policy, Bernoulli):
        return policy.probs
    if not squashed:
        while isinstance(policy, TransformedDistribution):
            policy = policy.base_dist
        if isinstance(policy, TruncatedNormal):
            return policy.loc
    mean = getattr(policy, "deterministic_sample", None)
    if mean is not None and mean.is_floating_point():  # Labels have no gradient.
        return mean
    if isinstance(policy, Independent):
        # Torch's mean is NaN for labels and missing for squashed distributions.
        return policy_mean(policy.base_dist, squashed=squashed)
    try:
        return policy.mean
    except NotImplementedError as error:
        raise NotImplementedError(
            f"{type(policy).__name__} has no mean: choose another policy_distance or "
            "regularizer, join discrete actions in a CompositeDistribution, or give a continuous "
            "policy's class a deterministic_sample."
        ) from error


def mean_distance(p: Distribution, q: Distribution) -> Tensor:
    r"""Half the squared distance of two policies' means before they are squashed.

    .. math::
        d(p, q) = \frac 1 2 \lVert \mu_p - \mu_q \rVert_2^2,

    with the means of :func:`policy_mean`. CAPS (Mysore et al., 2021) uses this distance, and so do
    implementations of L2C2 for robots instead of the Hellinger distance. It ignores how wide the
    policies are and has no upper bound. It is in squared units of the action before squashing. Its
    gradient flows into both policies.

    Args:
        p: one policy, batch shape ``[*B]``.
        q: the other, of the same actions.

    Returns:
        The distances, shape ``[*B]``, at least 0.

    Raises:
        NotImplementedError: a policy has no mean.
        ValueError: the policies have other numbers of actions.

    Examples:
        >>> import torch
        >>> from torchrl.modules import TanhNormal
        >>> from torchrl_l2c2.policy_distances import mean_distance
        >>> p, q = TanhNormal(torch.zeros(1, 2), 1.0), TanhNormal(torch.ones(1, 2), 3.0)
        >>> mean_distance(p, q)
        tensor([1.])
    """
    return squared_error(policy_mean(p), policy_mean(q))


def mean_squared_error(p: Distribution | Tensor, q: Distribution | Tensor) -> Tensor:
    r"""The mean squared error of two policies' means before they are squashed.

    .. math::
        d(p, q) = \frac 1 A \lVert \mu_p - \mu_q \rVert_2^2

    over :math:`A` dimensions of the action: :func:`mean_distance` times :math:`2 / A`. One gain is
    therefore equally strong for robots with few and with many joints. For discrete actions
    :math:`A` is their number. The gradient flows into both policies.

    Args:
        p: one policy, batch shape ``[*B]``, or its actions, ``[*B, A]``.
        q: the other, of the same actions.

    Returns:
        The distances, shape ``[*B]``, at least 0, in squared units of the action before the
        squashing.

    Raises:
        NotImplementedError: a policy has no mean.
        ValueError: the policies have other numbers of actions.

    Examples:
        >>> import torch
        >>> from torchrl.modules import TanhNormal
        >>> from torchrl_l2c2.policy_distances import mean_squared_error
        >>> from torchrl_l2c2.policy_distances import mean_distance
        >>> p, q = TanhNormal(torch.zeros(1, 4), 1.0), TanhNormal(torch.ones(1, 4), 3.0)
        >>> mean_squared_error(p, q), mean_distance(p, q)
        (tensor([1.]), tensor([2.]))
    """
    mean = policy_mean(p)
    return squared_error(mean, policy_mean(q)) * (2 / mean.shape[-1])
