"""L2C2: policies and values that change little within the neighborhood of a transition."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import ClassVar, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Categorical
from torchrl.objectives import DistributionalDQNLoss, LossModule

from torchrl_l2c2._checks import (
    check_bool,
    check_choice,
    check_of_each,
    check_positive_int,
    check_real,
    read_key,
)
from torchrl_l2c2._warnings import warn
from torchrl_l2c2.distances import squared_error, squared_hellinger
from torchrl_l2c2.neighborhood import Neighborhood, step_length
from torchrl_l2c2.objectives._batch import at_rows, next_key, read_moved_keys
from torchrl_l2c2.objectives._networks import VALUE_NETWORKS
from torchrl_l2c2.objectives.regularized import GAIN, RegularizedLoss
from torchrl_l2c2.policy_distances import (
    PolicyDistance,
    choose_policy_distance,
    compare_policies,
    distance_name,
)
from torchrl_l2c2.presets import without_effect
from torchrl_l2c2.transforms import NeighborTransform, draw_neighbors


def l2c2_penalty(
    difference: Tensor,  # shape: [K, *B, ...]
    gain: Tensor,  # shape: [K, *B]
    over_neighbors: Literal["mean", "max"] = "mean",
) -> Tensor:  # shape: [*B, ...]
    r"""The mean over ``K`` neighbors of the gain times the difference, before the reduction.

    .. math::
        \frac1K \sum_k \frac{\lambda}{d(s, \tilde s_k; s')}\, d_f(f(s), f(\tilde s_k))

    where :math:`f` is a policy, equation (10), or a value function, equation (11) (Kobayashi, L2C2,
    2022).

    Args:
        difference: :math:`d_f`, at least 0. Trailing dimensions, such as agents, are allowed.
        gain: :math:`\lambda / d`, from :meth:`Neighborhood.gain <torchrl_l2c2.Neighborhood.gain>`.
        over_neighbors: ``"max"`` takes the largest of the ``K`` penalties instead of their mean.

    Raises:
        ValueError: the leading dimensions of the two differ.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.l2c2 import l2c2_penalty
        >>> gain = torch.tensor([[1.0, 1.0], [0.5, 0.5]])
        >>> l2c2_penalty(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), gain)
        tensor([1.2500, 2.0000])
    """
    check_of_each(difference.shape, gain.shape)
    gain = gain[(...,) + (None,) * (difference.ndim - gain.ndim)]
    penalty = gain * difference
    # Not amax: inductor fails to compile some of PPO-RPE's graphs with it.
    return penalty.mean(0) if over_neighbors == "mean" else penalty.max(0).values


class Neighbors(NamedTuple):
    """The neighbors of the states in a batch ``[*B]``, or of ``M`` of its states.

    Attributes:
        states: the neighbors, ``[K, *B]`` or ``[K, M]``.
        distance: their distances, same shape; infinite for transitions that do not count.
        counts: mask of the transitions that count, ``[*B]`` or ``[M]``.
        rows: indices of the states in the flattened batch, ``[M]``; ``None`` for all states.
    """

    states: TensorDictBase
    distance: Tensor
    counts: Tensor
    rows: Tensor | None = None


class L2C2Loss(RegularizedLoss):
    r"""A loss with the locally Lipschitz continuous constraint (Kobayashi, L2C2, 2022).

    Adds these terms to any TorchRL loss with a policy, a value function or both:

    .. math::
        \lambda_\pi\, \mathbb E\left[\frac{d_\pi(\pi(\cdot|s), \pi(\cdot|\tilde s))}
        {d(s, \tilde s; s')}\right]
        + \lambda_V\, \mathbb E\left[\frac{d_V(V(s), V(\tilde s))}{d(s, \tilde s; s')}\right],
        \qquad \lambda_V = \beta\lambda_\pi,

    where a :class:`~torchrl_l2c2.Neighborhood` defines the neighbors :math:`\tilde s`, their
    distances :math:`d` and :math:`\lambda_\pi`.

    * :math:`d_\pi` is the squared Hellinger distance (:func:`~torchrl_l2c2.squared_hellinger`) or
      ``policy_distance``. For deterministic policies it is half the squared distance of the
      actions.
    * :math:`d_V = \tfrac12\lVert V(s) - V(\tilde s)\rVert_2^2` sums over all heads or members of an
      ensemble. Action values are compared for all discrete actions, or at the batch's action. For
      :class:`~torchrl.objectives.DistributionalDQNLoss` it is the squared Hellinger distance of the
      value distributions, summed over the actions.

    The policy term trains the policy only, the value terms train the value functions only, through
    both :math:`s` and :math:`\tilde s`. Target networks get no gradient. A value term reaches the
    policy only through a shared trunk that the value loss of the base loss also trains.

    The terms are reduced like the loss's own terms: same ``reduction``, same masks and, if the loss
    uses them, the weights of prioritized replay in TorchRL's weighted mean or sum.
    :class:`PPORPELoss` scales its own terms down by the weights; the terms added here use weights
    with a mean of 1 and keep their full gain [inferred: the paper weights neither or both].

    If a transform such as :meth:`neighbor_transform` has written neighbors into the batch, they are
    used. Otherwise the loss draws them from the observations and next observations with torch's
    global generator. It then moves ``moved_keys`` or, by default, every floating-point input of the
    regularized networks that has a successor in the batch; the distance is the largest over these
    inputs. Transitions whose next observation has no finite coordinate, or whose step exceeds the
    neighborhood's ``max_step``, do not count: means are over the other transitions.

    ``forward`` adds these entries:

    * ``loss_l2c2_actor``, the policy term, and one value term for each value function, named after
      its network: ``loss_l2c2_critic``, ``loss_l2c2_qvalue``, ``loss_l2c2_value``, ...
    * ``l2c2_distance``, the mean :math:`d`, and ``l2c2_gain``, the mean gain
      :math:`\lambda_\pi / d` times the coefficients;
    * ``l2c2_counted``, the share of the batch that counts;
    * the mean :math:`d_\pi`, named after the distance: ``l2c2_hellinger``,
      ``l2c2_mean_distance``, ``l2c2_mse``, ``l2c2_kl``, ``l2c2_policy_distance`` (a function) or
      ``l2c2_action_distance`` (deterministic policies);
    * ``l2c2_value_distance``, the mean :math:`d_V`, summed over the value functions.

    With ``reduction="none"`` these diagnostics are not averaged; ``fraction`` applies to them as to
    the terms.

    .. note:: Gains are buffers: assign to them at any time, as in ``loss.l2c2_coeff = 0.5``, also
        between calls of a compiled loss. They are not part of the ``state_dict``.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        neighborhood (Neighborhood, optional): region in which neighbors are drawn, and their
            distance and gain. Defaults to ``Neighborhood()``, the paper's settings.
        beta (float): gain of the value terms relative to the policy term, at least 0. Larger values
            smooth the value functions more; 0 omits their terms (the paper's ablation). Scheduled
            as ``l2c2_beta``. Defaults to ``0.1``.

    Keyword Args:
        coeff (float): factor of all terms, at least 0. Larger values smooth more; 0 leaves the base
            loss's values and gradients unchanged. Scheduled as ``l2c2_coeff``. Defaults to ``1.0``.
        num_samples (int): neighbors per state, at least 1. Larger values reduce the noise of the
            terms; the number of network evaluations grows in proportion. Defaults to ``1``.
        over_neighbors (str): ``"mean"`` (the paper) averages the penalty over the neighbors;
            ``"max"`` takes the largest penalty, which is larger at the same gain. Defaults to
            ``"mean"``.
        fraction (float): share of the batch, in (0, 1], for which neighbors are drawn. Each call
            draws new rows with torch's global generator. Smaller values save time in large batches
            and make the terms noisier. Their expectation does not change: a drawn transition counts
            ``1 / fraction`` times, the others 0, also with ``reduction="none"``. Defaults to 1.
        moved_keys (str or sequence of NestedKey, optional): observations in which neighbors differ
            from the state, such as noisy sensors. Applies to neighbors that the loss draws itself.
            Defaults to ``None``, all observations with a successor.
        policy_distance (str or callable): :math:`d_\pi`. Each choice needs its own gains.
            ``"hellinger"`` (the paper) is in [0, 1] and relative to the width of the policies.
            ``"mean"`` (:func:`~torchrl_l2c2.policy_distances.mean_distance`) and ``"mse"``
            (:func:`~torchrl_l2c2.policy_distances.mean_squared_error`, a mean over the action's
            dimensions) are absolute and unbounded. ``"kl"``
            (:func:`~torchrl_l2c2.divergences.kl_divergence`, of the policy at :math:`s` from the
            neighbor's policy) is relative and unbounded. A function takes two distributions
            ``[K, *B]`` and returns ``[K, *B]``; if it is a module, the loss does not own its
            parameters. ``"kl"`` and functions need a stochastic policy. Defaults to
            ``"hellinger"``.
        hellinger_samples (int, optional): actions drawn from each policy for the paper's Monte
            Carlo estimate of :math:`d_\pi`, at least 1. Defaults to ``None``, the closed form.
        neighbor_key (NestedKey): entry that ``NeighborTransform`` writes. Defaults to
            ``"neighbor"``.
        skip_ends (bool): whether to leave out transitions that end an episode. Use it for
            environments that store the reset state as the last next observation. Defaults to
            ``False``.

    Raises:
        TypeError: the loss has neither a policy nor a value function, cannot be regularized, has no
            policy for ``policy_distance``, or an argument has the wrong type.
        ValueError: an argument is out of its range; in use, an observation to be moved is called
            ``"distance"``.

    Warns:
        UserWarning: the loss has no policy, or no trained value function while ``beta`` is above 0,
            and one term is left out; or the gains are as small as in the paper, which had no
            measurable effect with such losses.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss, SoftUpdate
        >>> from torchrl_l2c2 import L2C2Loss, Neighborhood
        >>> actor = Actor(torch.nn.Linear(3, 1))
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = L2C2Loss(DDPGLoss(actor, value), Neighborhood(sigma=1.0), beta=0.1)
        >>> isinstance(loss, DDPGLoss), isinstance(loss, L2C2Loss)
        (True, True)
        >>> updater = SoftUpdate(loss, tau=0.01)
        >>> state, flag = torch.randn(32, 3), torch.zeros(32, 1, dtype=torch.bool)
        >>> batch = TensorDict({"observation": state, "action": torch.randn(32, 1)}, [32])
        >>> batch["next"] = {"observation": state + 0.1, "reward": torch.randn(32, 1)}
        >>> _ = batch["next"].update({"done": flag, "terminated": flag})
        >>> terms = loss(batch)
        >>> [key for key in terms.keys() if key.startswith("loss_")]
        ['loss_actor', 'loss_value', 'loss_l2c2_actor', 'loss_l2c2_value']
    """

    _settings: ClassVar[tuple[str, ...]] = (
        "l2c2_policy_distance",
        "l2c2_neighborhood",
        "l2c2_num_samples",
        "l2c2_fraction",
    )

    def __init__(
        self,
        base_loss: LossModule,
        neighborhood: Neighborhood | None = None,
        beta: float = 0.1,
        *,
        coeff: float = 1.0,
        num_samples: int = 1,
        over_neighbors: Literal["mean", "max"] = "mean",
        fraction: float = 1.0,
        moved_keys: str | Sequence[NestedKey] | None = None,
        policy_distance: Literal["hellinger", "mean", "mse", "kl"] | PolicyDistance = "hellinger",
        hellinger_samples: int | None = None,
        neighbor_key: NestedKey = "neighbor",
        skip_ends: bool = False,
    ) -> None:
        neighborhood = Neighborhood() if neighborhood is None else neighborhood
        if not isinstance(neighborhood, Neighborhood):
            raise TypeError(f"neighborhood must be a Neighborhood, got {neighborhood!r}.")
        check_positive_int("num_samples", num_samples)
        check_choice("over_neighbors", over_neighbors, ("mean", "max"))
        if over_neighbors == "max" and num_samples == 1:
            raise ValueError(
                "num_samples must be above 1 with over_neighbors='max', got 1: of one neighbor the "
                "largest is the mean."
            )
        check_real("fraction", fraction, above=0, at_most=1)
        check_bool("skip_ends", skip_ends)
        self.skip_ends = self.skip_ends or skip_ends
        self._l2c2_distance = choose_policy_distance(policy_distance, hellinger_samples)
        # Its name: a module would become part of the loss.
        named = isinstance(policy_distance, str)
        self._l2c2_distance_name = str(policy_distance) if named else "a function"
        self.l2c2_neighborhood = neighborhood
        self.l2c2_num_samples = int(num_samples)
        self.l2c2_over_neighbors: Literal["mean", "max"] = over_neighbors
        self.l2c2_fraction = float(fraction)
        self.l2c2_neighbor_key = read_key("neighbor_key", neighbor_key)
        policies, values = self.policy_networks(), self.value_networks() if beta else []
        self._l2c2_policies, self._l2c2_values = policies, values
        self.register_coefficient("l2c2_coeff", coeff)
        self.register_coefficient("l2c2_beta", beta, used=bool(values))
        own = (policy_distance, hellinger_samples) != ("hellinger", None)
        _check_terms(type(base_loss).__name__, policies, values, beta, own)
        self.declare_networks([*policies, *values])
        read = {name: self.networks[name].states for name in [*policies, *values]}
        self.l2c2_moved_keys = None if moved_keys is None else read_moved_keys(moved_keys, read)
        if policies:
            name = distance_name(policy_distance, self.has_stochastic_policy(), hellinger_samples)
            self._l2c2_policy_diagnostic = f"l2c2_{name}"
        self.declare_terms(
            policy=["loss_l2c2_actor" for _ in policies],
            value=[_value_term(network) for network in values],
            diagnostics=[
                "l2c2_distance",
                "l2c2_gain",
                "l2c2_counted",
                *(self._l2c2_policy_diagnostic for _ in policies),
                *(["l2c2_value_distance"] if values else []),
            ],
        )
        if without_effect(type(base_loss), neighborhood.lambda_max):
            warn(
                f"gains up to {neighborhood.lambda_max:g}, such as the paper's gains, had no "
                f"measurable effect with losses like {type(base_loss).__name__}, unless they were "
                "relative to action values. Take the preset (smooth(loss), regularizer=l2c2 in "
                "train.py), or raise lambda_min and lambda_max."
            )

    @property
    def l2c2_policy_distance(self) -> str:
        """The ``policy_distance`` with which the loss was made."""
        return self._l2c2_distance_name

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        if not self._l2c2_policies:
            return terms
        near = self._neighbors(tensordict)
        policies = self.policies_at(tensordict, near.states, near.rows)
        difference = compare_policies(self._l2c2_distance, *policies)
        if self._l2c2_distance_name == "a function":
            self._watch.see_distance(difference)
        penalty = self._penalty(difference, near, tensordict)
        terms.set("loss_l2c2_actor", self.scaled(penalty, "l2c2_coeff"))
        terms.set(self._l2c2_policy_diagnostic, self._diagnostic(difference, near, tensordict))
        return terms.update(self._neighborhood_diagnostics(near, tensordict))

    def value_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().value_regularizer(tensordict)
        if not self._l2c2_values:
            return terms
        near = self._neighbors(tensordict)
        diagnostics = []
        for network in self._l2c2_values:
            difference = self._value_difference(network, tensordict, near)
            penalty = self._penalty(difference, near, tensordict)
            terms.set(_value_term(network), self.scaled(penalty, "l2c2_coeff", "l2c2_beta"))
            diagnostics.append(self._diagnostic(difference, near, tensordict))
        terms.set("l2c2_value_distance", sum(diagnostics))
        return terms.update(self._neighborhood_diagnostics(near, tensordict))

    def neighbor_transform(
        self,
        generator: torch.Generator | None = None,
        in_keys: str | Sequence[NestedKey] | None = None,
    ) -> NeighborTransform:
        """Makes a transform that draws this loss's neighbors in the replay buffer.

        Append it to a replay buffer, after transforms that change observations::

            replay.append_transform(loss.neighbor_transform())

        It uses the loss's neighborhood, ``num_samples`` and ``neighbor_key``. Without it the loss
        draws neighbors itself. With it they are drawn together with the batch, for example in a
        process that prefetches, and may have their own generator.

        Args:
            generator (torch.Generator, optional): source of the randomness, as for
                :class:`~torchrl_l2c2.NeighborTransform`. Defaults to torch's global generator.
            in_keys (str or sequence of NestedKey, optional): observations to move. Defaults to the
                loss's ``moved_keys``, or else every observation that the regularized networks read.
                Pass it if one of these, such as a goal, has no successor in the batch, or is no
                floating-point number, such as a mask.

        Returns:
            NeighborTransform: the transform.
        """
        if in_keys is None:
            networks = [*self._l2c2_policies, *self._l2c2_values]
            read = dict.fromkeys(key for name in networks for key in self.networks[name].states)
            in_keys = self.l2c2_moved_keys or list(read)
        return NeighborTransform(
            self.l2c2_neighborhood,
            in_keys,
            out_key=self.l2c2_neighbor_key,
            num_samples=self.l2c2_num_samples,
            generator=generator,
        )

    def known_states(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        if self.l2c2_fraction < 1 or tensordict.get(self.l2c2_neighbor_key, None) is None:
            return super().known_states(tensordict)
        return self._neighbors(tensordict).states

    def _value_difference(
        self, network: str, tensordict: TensorDictBase, near: Neighbors
    ) -> Tensor:
        here, there = self.values_at(network, tensordict, near.states, near.rows)
        if isinstance(self, DistributionalDQNLoss):
            # Logarithms of the atoms' probabilities, [K, *B, atoms, actions].
            policies = (Categorical(logits=value.transpose(-1, -2)) for value in (here, there))
            return squared_hellinger(*policies).sum(-1)
        difference = squared_error(here, there)
        return difference.sum(0) if self.is_ensemble(network) else difference

    def _penalty(self, difference: Tensor, near: Neighbors, tensordict: TensorDictBase) -> Tensor:
        gain = self.l2c2_neighborhood.gain(near.distance)
        penalty = l2c2_penalty(difference, gain, self.l2c2_over_neighbors)
        return self.reduce_term(penalty, tensordict, rows=near.rows, counts=near.counts)

    def _neighbors(self, tensordict: TensorDictBase) -> Neighbors:
        return self.made_once("l2c2_neighbors", lambda: self._make_neighbors(tensordict))

    def _make_neighbors(self, tensordict: TensorDictBase) -> Neighbors:
        rows = self.sample_rows("l2c2", tensordict, self.l2c2_fraction)
        neighbor = stored = tensordict.get(self.l2c2_neighbor_key, None)
        if stored is None:
            neighbor = self._draw(tensordict, rows)
        else:
            self._watch.see_neighbors(self, stored, tensordict, self.l2c2_neighborhood)
            neighbor = at_rows(stored, rows)
        states, distance = _read_neighbors(neighbor, self.l2c2_neighbor_key)
        if stored is not None and self.l2c2_neighborhood.max_step is not None:
            # The transform that drew the neighbors may have another bound, or none.
            distance = distance.masked_fill(self._too_long(tensordict, states, rows), math.inf)
        counts = distance[0].isfinite()
        self._watch.see_counts(self, counts, self.l2c2_neighborhood.max_step)
        if (ends := self._ends(tensordict)) is not None:
            counts = counts & ~(ends if rows is None else ends.flatten()[rows])
        return Neighbors(states, distance, counts, rows)

    def _too_long(
        self, tensordict: TensorDictBase, states: TensorDictBase, rows: Tensor | None
    ) -> Tensor:
        """The mask of transitions with a step longer than ``max_step``, ``[*B]``."""
        keys = list(states.keys(include_nested=True, leaves_only=True))
        batch = tensordict.select(*keys, *map(next_key, keys), strict=False).detach()
        batch = at_rows(batch, rows)
        steps = [(batch.get(key, None), batch.get(next_key(key), None)) for key in keys]
        lengths = [
            step_length(here, successor, batch.batch_dims)
            for here, successor in steps
            if here is not None and successor is not None
        ]
        bound = self.l2c2_neighborhood.max_step or math.inf
        too_long = [length > bound for length in lengths]
        none = torch.zeros(batch.batch_size, dtype=torch.bool, device=states.device)
        return functools.reduce(torch.logical_or, too_long, none)

    def _draw(self, tensordict: TensorDictBase, rows: Tensor | None) -> TensorDictBase:
        """Draws the entry that NeighborTransform would have written."""
        networks = [*self._l2c2_policies, *self._l2c2_values]
        keys = self.l2c2_moved_keys or list(self.transitions(tensordict, networks))
        states = at_rows(tensordict.select(*keys, *map(next_key, keys)).detach(), rows)
        return draw_neighbors(states, self.l2c2_neighborhood, keys, self.l2c2_num_samples)

    def _diagnostic(self, value: Tensor, near: Neighbors, tensordict: TensorDictBase) -> Tensor:
        mean = value.detach().mean(0)
        return self.reduce_diagnostic(mean, tensordict, rows=near.rows, counts=near.counts)

    def _neighborhood_diagnostics(
        self, near: Neighbors, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        return self.made_once(
            "l2c2_diagnostics", lambda: self._make_neighborhood_diagnostics(near, tensordict)
        )

    def _make_neighborhood_diagnostics(
        self, near: Neighbors, tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        coefficient = self.l2c2_coeff * self._buffers[GAIN]
        gain = coefficient * self.l2c2_neighborhood.gain(near.distance)
        counted = near.counts.to(near.distance.dtype)
        return {
            "l2c2_distance": self._diagnostic(near.distance, near, tensordict),
            "l2c2_gain": self._diagnostic(gain, near, tensordict),
            "l2c2_counted": self.reduce_diagnostic(counted, tensordict, rows=near.rows),
        }


def _value_term(network: str) -> str:
    return "loss_l2c2_" + network.removesuffix("_network")


def _read_neighbors(neighbor: TensorDictBase, key: NestedKey) -> tuple[TensorDictBase, Tensor]:
    """Splits a batch's entry ``[*B]`` into neighbors and distances, ``[K, *B]``."""
    if not isinstance(neighbor, TensorDictBase):
        raise KeyError(
            f"{key!r} is a tensor of the batch's own, and no neighbors of NeighborTransform: name "
            "another neighbor_key."
        )
    entries = {
        key: value.detach().movedim(neighbor.batch_dims, 0)
        for key, value in neighbor.items(include_nested=True, leaves_only=True)
    }
    if "distance" not in entries:
        raise KeyError(
            f"{key!r} holds {list(entries)}, but no 'distance': write it with NeighborTransform, "
            "or name another neighbor_key."
        )
    distance = entries.pop("distance")
    # Only padding has none: the gain would be infinite, and the gradient under a mask NaN.
    distance = distance.masked_fill(distance == 0.0, 1.0)
    return TensorDict(entries, batch_size=distance.shape), distance


def _check_terms(loss: str, policies: list[str], values: list[str], beta: float, own: bool) -> None:
    if not (policies or values):
        what = "trained value function" if beta else "value function to regularize, with beta=0,"
        raise TypeError(
            f"L2C2Loss finds nothing to regularize: {loss} has no actor_network, and no {what} "
            f"among {', '.join(VALUE_NETWORKS)}."
        )
    if not policies and own:
        usual = "policy_distance='hellinger' and hellinger_samples=None"
        raise TypeError(f"{loss} has no policy to compare: leave {usual}.")
    if not policies:
        warn(
            f"{loss} has no policy network: L2C2Loss leaves out the policy term and regularizes "
            f"only {', '.join(values)}."
        )
    if beta and not values:
        warn(
            f"{loss} trains no value function: L2C2Loss leaves out the value term and regularizes "
            "only the policy. Pass beta=0 to silence this warning."
        )
