"""L2C2: policies and values that change little within the neighborhood of a transition."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Categorical
from torchrl.objectives import DistributionalDQNLoss, LossModule

from torchrl_l2c2._checks import (
    check_choice,
    check_of_each,
    check_positive_int,
    check_real,
    read_key,
)
from torchrl_l2c2.distances import squared_error, squared_hellinger
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives._batch import at_rows, next_key
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

    of a policy, equation (10), or a value function, equation (11), :math:`f` (Kobayashi, L2C2,
    2022).

    Args:
        difference: :math:`d_f`, at least 0; it may have more dimensions, those of agents.
        gain: :math:`\lambda / d`, as :meth:`Neighborhood.gain <torchrl_l2c2.Neighborhood.gain>`
            gives it.
        over_neighbors: ``"max"`` takes the largest of the ``K`` instead of their mean.

    Raises:
        ValueError: the differences are not of each transition.

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
    # Not amax: of some of PPO-RPE's graphs inductor makes no program with it.
    return penalty.mean(0) if over_neighbors == "mean" else penalty.max(0).values


class Neighbors(NamedTuple):
    """The neighbors of the states in a batch ``[*B]``, or of ``M`` of them.

    Attributes:
        states: the neighbors, ``[K, *B]``, or ``[K, M]``.
        distance: how far away they count, of the same shape; infinite if they do not count.
        counts: which transitions count, ``[*B]`` or ``[M]``.
        rows: whose neighbors they are, ``[M]``, in the batch written as one row; ``None``: all.
    """

    states: TensorDictBase
    distance: Tensor
    counts: Tensor
    rows: Tensor | None = None


class L2C2Loss(RegularizedLoss):
    r"""A loss under the locally Lipschitz continuous constraint (Kobayashi, L2C2, 2022).

    Adds to any TorchRL loss with a policy, a value function or both

    .. math::
        \lambda_\pi\, \mathbb E\left[\frac{d_\pi(\pi(\cdot|s), \pi(\cdot|\tilde s))}
        {d(s, \tilde s; s')}\right]
        + \lambda_V\, \mathbb E\left[\frac{d_V(V(s), V(\tilde s))}{d(s, \tilde s; s')}\right],
        \qquad \lambda_V = \beta\lambda_\pi,

    with the neighbors :math:`\tilde s`, their distances :math:`d` and :math:`\lambda_\pi` of a
    :class:`~torchrl_l2c2.Neighborhood`. :math:`d_\pi` is the squared Hellinger distance
    (:func:`~torchrl_l2c2.squared_hellinger`) or what ``policy_distance`` says; for deterministic
    policies half the squared distance of the actions.
    :math:`d_V = \tfrac12\lVert V(s) - V(\tilde s)\rVert_2^2` is taken over all heads or members of
    an ensemble; of action values over all (discrete) actions, or at the batch's action; of the
    value distributions of :class:`~torchrl.objectives.DistributionalDQNLoss`
    it is the squared Hellinger distance, summed over the actions.

    Gradients flow into the policy's parameters from the one term, into the value function's from
    the other, through both :math:`s` and :math:`\tilde s`, and nowhere else: not into targets, nor
    from a value into the policy except through a trunk that the plain loss trains so as well.
    Both terms are reduced as the loss reduces its own: with its ``reduction``, its masks and, where
    it uses them, the weights of prioritized replay, in TorchRL's weighted mean or sum. Beside
    :class:`PPORPELoss`, which scales its own terms down by the weights, theirs have a mean of 1, so
    that the terms keep their full gain [inferred: the paper weights neither or both].

    Neighbors are read from the batch where a transform has written them, such as
    :meth:`neighbor_transform` makes, and otherwise drawn from the observations and next
    observations with torch's global generator. Drawn here, those floating-point inputs of the
    regularized networks are moved that have a successor in the batch, or ``moved_keys``; the
    distance is their largest. A transition whose next observation is not finite, or which is longer
    than the neighborhood's ``max_step``, does not count: means are over the others.

    ``forward`` adds these entries to the loss's own:

    * ``loss_l2c2_actor``, the policy term, and one value term for each value function, named after
      its network: ``loss_l2c2_critic``, ``loss_l2c2_qvalue``, ``loss_l2c2_value``, ...
    * ``l2c2_distance``, the mean :math:`d`, and ``l2c2_gain``, the mean gain
      :math:`\lambda_\pi / d` times the coefficients;
    * ``l2c2_counted``, the share of the batch that counts, 1 unless next observations are not
      known or steps are too long;
    * the mean :math:`d_\pi`, named after the distance: ``l2c2_hellinger``,
      ``l2c2_mean_distance``, ``l2c2_mse``, ``l2c2_kl``, ``l2c2_policy_distance`` for a function of
      one's own, ``l2c2_action_distance`` for deterministic policies;
    * ``l2c2_value_distance``, the mean :math:`d_V`, summed over the value functions. With
      ``reduction="none"`` diagnostics are not averaged either.

    .. note:: The gains are buffers that can be assigned to, as in ``loss.l2c2_coeff = 0.5``, also
        between calls of a compiled loss. They are not part of the ``state_dict``.

    Args:
        base_loss (LossModule): the loss; see :class:`RegularizedLoss` for how it is wrapped.
        neighborhood (Neighborhood, optional): where neighbors are drawn and what they count.
            Defaults to the paper's, ``Neighborhood()``.
        beta (float): gain of the value terms relative to the policy term, at least 0. Larger values
            smooth the value functions more; 0 leaves their terms out altogether (the paper's
            ablation). Scheduled as ``l2c2_beta``. Defaults to ``0.1``.

    Keyword Args:
        coeff (float): multiplies all terms, at least 0; 0 leaves the plain loss's values and
            gradients. Scheduled as ``l2c2_coeff``. Defaults to ``1.0``.
        num_samples (int): neighbors per state, drawn here or by the transform, at least 1. More
            give a less noisy estimate at so many times the network evaluations. Defaults to ``1``.
        over_neighbors (str): ``"mean"``, the paper's, or ``"max"``: the largest penalty alone, an
            adversary of ``num_samples`` choices, larger at the same gain. Defaults to ``"mean"``.
        fraction (float): share of the batch, in (0, 1], whose states have neighbors, drawn anew
            each time with torch's global generator. Smaller ones cost less, pay in large batches,
            and are noisier; the terms' expectation stays: a drawn transition counts
            ``1 / fraction`` times and the others 0, also with ``reduction="none"``. Defaults to 1.
        moved_keys (str or sequence of NestedKey, optional): which observations neighbors drawn here
            differ in, such as those that carry noise. Defaults to ``None``, all that can.
        policy_distance (str or callable): :math:`d_\pi`. ``"hellinger"``, the paper's, is in [0, 1]
            and relative to how wide the policies are; ``"mean"``
            (:func:`~torchrl_l2c2.policy_distances.mean_distance`) is neither; nor is ``"mse"``
            (:func:`~torchrl_l2c2.policy_distances.mean_squared_error`), a mean over the action's
            dimensions; ``"kl"`` (:func:`~torchrl_l2c2.divergences.kl_divergence`), of the
            policy at :math:`s` from the other, is relative and unbounded. Each wants its own gains.
            A function takes two distributions ``[K, *B]`` and returns ``[K, *B]``; neither it nor
            ``"kl"`` takes deterministic policies. A module's parameters are not the loss's.
            Defaults to ``"hellinger"``.
        hellinger_samples (int, optional): actions drawn from each policy for the paper's Monte
            Carlo estimate of :math:`d_\pi`, at least 1. Defaults to ``None``, its closed form.
        neighbor_key (NestedKey): the entry that ``NeighborTransform`` writes. Defaults to
            ``"neighbor"``.
        skip_ends (bool): whether transitions at which an episode ends are left out: for
            environments whose next observation is the reset state there. Defaults to ``False``.

    Raises:
        TypeError: the loss has neither a policy nor a value function, cannot be regularized, has no
            policy for ``policy_distance``, or an argument has the wrong type.
        ValueError: an argument is out of its range; in use, an observation to be moved is called
            ``"distance"``.

    Warns:
        UserWarning: the loss lacks a policy or a trained value function, so that one term is left
            out; not with ``beta=0``. The gains are the paper's or smaller, around a loss with which
            these had no measurable effect.

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
        self.skip_ends = self.skip_ends or bool(skip_ends)
        self._l2c2_distance = choose_policy_distance(policy_distance, hellinger_samples)
        own_distance = not isinstance(policy_distance, str)  # Not a module: it is the caller's.
        self.l2c2_policy_distance = "a function" if own_distance else policy_distance
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
        self.l2c2_moved_keys = None if moved_keys is None else _read_moved_keys(moved_keys, read)
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
            warnings.warn(
                f"gains up to {neighborhood.lambda_max:g}, such as the paper's, had no measurable "
                f"effect with losses like {type(base_loss).__name__}. smooth(loss) takes settings "
                "that had one; or raise lambda_min and lambda_max.",
                stacklevel=2,
            )

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        if not self._l2c2_policies:
            return terms
        near = self._neighbors(tensordict)
        policies = self.policies_at(tensordict, near.states, near.rows)
        difference = compare_policies(self._l2c2_distance, *policies)
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
        """The transform that draws this loss's neighbors where the batch is drawn.

        Append it to a replay buffer, after transforms that change observations::

            replay.append_transform(loss.neighbor_transform())

        It has the loss's neighborhood, ``num_samples`` and ``neighbor_key``. Without it the loss
        draws neighbors itself; with it they are drawn where the batch is, with a generator of its
        own, such as in a process that prefetches.

        Args:
            generator (torch.Generator, optional): source of the randomness, as for
                :class:`~torchrl_l2c2.NeighborTransform`. Defaults to torch's global generator.
            in_keys (str or sequence of NestedKey, optional): the observations that move. Defaults
                to ``moved_keys`` of the loss or else all that the regularized networks read; name
                them if one of these has no successor in the batch, such as a goal.

        Returns:
            NeighborTransform: of this loss.
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
        neighbor = tensordict.get(self.l2c2_neighbor_key, None)
        if neighbor is None:
            neighbor = self._draw(tensordict, rows)
        elif rows is not None:
            neighbor = at_rows(neighbor, rows)
        states, distance = _read_neighbors(neighbor, self.l2c2_neighbor_key)
        counts = distance[0].isfinite()
        if self.l2c2_neighborhood.max_step is None:
            self.warn_uncounted(counts)
        if (ends := self._ends(tensordict)) is not None:
            counts = counts & ~(ends if rows is None else ends.flatten()[rows])
        return Neighbors(states, distance, counts, rows)

    def _draw(self, tensordict: TensorDictBase, rows: Tensor | None) -> TensorDictBase:
        """What NeighborTransform would have written."""
        networks = [*self._l2c2_policies, *self._l2c2_values]
        keys = self.l2c2_moved_keys or list(self.transitions(tensordict, networks))
        states = tensordict.select(*keys, *map(next_key, keys)).detach()
        states = states if rows is None else at_rows(states, rows)
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
    """The neighbors, ``[K, *B]``, and their distances, of an entry ``[*B]`` of a batch."""
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
    return TensorDict(entries, batch_size=distance.shape), distance


def _read_moved_keys(
    moved_keys: str | Sequence[NestedKey], read: Mapping[str, Sequence[NestedKey]]
) -> list[NestedKey]:
    """The entries that neighbors differ in; a string is one, as TorchRL's transforms have it.

    Args:
        moved_keys (str or sequence of NestedKey): their names.
        read (Mapping): those that each network reads, by its name.

    Raises:
        TypeError: they are no names.
        ValueError: there is none, one that no network reads, or a network reads none of them.
    """
    if not isinstance(moved_keys, Sequence):
        raise TypeError(f"moved_keys must be a list of entries, got {moved_keys!r}.")
    names = [moved_keys] if isinstance(moved_keys, str) else moved_keys
    keys = [read_key("an entry of moved_keys", key) for key in names]
    if not keys:
        raise ValueError(
            "moved_keys must name at least one observation, got none: leave it at None for all "
            "that can be moved, or pass coeff=0 for no regularization."
        )
    there = sorted({key for states in read.values() for key in states}, key=str)
    if unread := [key for key in keys if key not in there]:
        raise ValueError(
            f"moved_keys names {unread}, and the networks read {there}; what begins with '_' is "
            "TorchRL's own and no observation."
        )
    if still := [name for name, states in read.items() if not set(keys) & set(states)]:
        raise ValueError(
            f"moved_keys names {keys}, and {still[0]} reads {list(read[still[0]])} alone, which "
            "would not move: name one of these, too, or leave its term out (of value functions "
            "with beta=0)."
        )
    return keys


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
        warnings.warn(
            f"{loss} has no policy network: L2C2Loss leaves out the policy term and regularizes "
            f"{', '.join(values)} alone.",
            stacklevel=3,
        )
    if beta and not values:
        warnings.warn(
            f"{loss} trains no value function: L2C2Loss leaves out the value term and regularizes "
            "the policy alone. Pass beta=0 to say so.",
            stacklevel=3,
        )
