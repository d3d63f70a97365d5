"""A TorchRL loss with further terms: what every regularizer of this package builds on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_of_each
from torchrl_l2c2.objectives.declarations import DeclaredTerms, listed_names
from torchrl_l2c2.objectives.evaluation import EvaluatedNetworks, Policy, is_ensemble
from torchrl_l2c2.objectives.shared_evaluation import SharedEvaluation
from torchrl_l2c2.objectives.specialization import SpecializedLoss
from torchrl_l2c2.objectives.transitions import (
    as_masked,
    check_evaluates_states,
    check_reads_next,
    find_states,
    find_transitions,
    next_key,
)
from torchrl_l2c2.objectives.wiring import POLICY_NETWORK, VALUE_NETWORKS

Made = TypeVar("Made")


class RegularizedLoss(DeclaredTerms, SpecializedLoss, SharedEvaluation):
    """A TorchRL loss with further terms: what every regularizer of this package builds on.

    ``Regularizer(loss, ...)`` returns an instance of ``Regularizer[type(loss)]``, a subclass of
    both classes that is made once for each pair. It is a full member of the loss's class: updaters,
    ``set_keys``, ``select_out_keys``, scheduled coefficients, ``deepcopy`` and checkpoints work as
    before, and its ``state_dict`` has the keys of the plain loss's (but for networks of a
    regularizer's own: :class:`ASAPLoss`). It holds the networks, parameters and buffers of ``loss``
    themselves, not copies, and ``loss`` stays the plain loss. From then on, move, cast or compile
    the regularized one.

    ``forward`` returns the loss's own terms, unchanged (compiled: to rounding), and the
    regularizer's. They share evaluations, so sum them before ``backward``. Loops that call
    ``actor_loss`` and ``value_loss`` add :meth:`policy_regularizer` and :meth:`value_regularizer`.

    A regularizer is a subclass that defines ``__init__`` and one or both of these methods. When its
    ``__init__`` runs, the object already is the loss: no other constructor is to be called.
    ``__init__`` declares what there is, with :meth:`declare_networks`, :meth:`declare_terms` and
    :meth:`register_coefficient`; the two methods compute it, with :meth:`policies_at`,
    :meth:`values_at`, :meth:`transitions` and :meth:`reduce_term`. Regularizers can be applied to
    one another's results.

    .. note:: Losses that are not trained on transitions, and recurrent policies, are refused.
        Networks are evaluated in the mode they are in, so dropout makes two evaluations of one
        state differ. Running statistics of normalization layers are left alone.

    Args:
        base_loss (LossModule): the loss.

    Attributes:
        policy_terms (frozenset of str): the ``loss_*`` keys of all regularizers applied that train
            the policy.
        auxiliary_terms (frozenset of str): those that train networks of the regularizers' own.
        added_terms (frozenset of str): all ``loss_*`` keys of all regularizers applied.

    Raises:
        TypeError: the loss cannot be regularized, or already is by this regularizer.

    Examples:
        >>> import torch
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import RegularizedLoss
        >>> class StillnessLoss(RegularizedLoss):
        ...     def __init__(self, base_loss, coeff):
        ...         self.register_coefficient("stillness_coeff", coeff)
        ...         self.declare_networks(["actor_network"])
        ...         self.declare_terms(policy=["loss_stillness"])
        ...
        ...     def policy_regularizer(self, tensordict):
        ...         terms = super().policy_regularizer(tensordict)
        ...         states = tensordict.select("observation")[None]
        ...         _, action = self.policies_at(tensordict, states)
        ...         cost = self.reduce_term(action.square().sum(-1).mean(0), tensordict)
        ...         return terms.set("loss_stillness", self.scaled(cost, "stillness_coeff"))
        >>> actor = Actor(torch.nn.Linear(3, 1))
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = StillnessLoss(DDPGLoss(actor, value), coeff=0.1)
        >>> type(loss).__name__, isinstance(loss, DDPGLoss), loss.out_keys[-1]
        ('StillnessLoss[DDPGLoss]', True, 'loss_stillness')
        >>> loss.policy_terms
        frozenset({'loss_stillness'})
    """

    _inputs: tuple[NestedKey, ...] = ()
    _followed: tuple[str, ...] = ()
    _evaluation = EvaluatedNetworks()  # Every loss has its own, made with it.

    def __new__(cls, base_loss: LossModule, *args: Any, **kwargs: Any) -> RegularizedLoss:
        self = super().__new__(cls, base_loss)
        check_evaluates_states(base_loss)
        regularized = isinstance(base_loss, RegularizedLoss)
        self._evaluation = EvaluatedNetworks(base_loss._evaluation.wiring if regularized else None)
        return self

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """As for the loss itself; what the regularizer reads follows."""
        super().set_keys(**kwargs)
        self._wire(self._evaluation.wiring)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss's own terms, then the regularizer's.

        Args:
            tensordict (TensorDictBase): the batch, as the loss itself takes it.

        Returns:
            TensorDict: the loss's own output with the regularizer's terms and diagnostics added.
        """
        outer = self._evaluation.begin_forward_pass()
        try:
            # The loss's own draws come first: at one seed its terms are those of the plain loss.
            terms = super().forward(tensordict)
            terms.update(self.policy_regularizer(tensordict))
            terms.update(self.value_regularizer(tensordict))
        finally:
            self._evaluation.end_forward_pass(outer)
        networks = (f"{name}_params" for name in self._evaluation.wiring)
        self._clear_weakrefs(tensordict, terms, *networks)
        return terms

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the policy, with their diagnostics; empty where there are none.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``actor_loss`` takes.
        """
        return TensorDict()

    def value_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the value functions, with their diagnostics.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``value_loss`` takes.
        """
        return TensorDict()

    # For who writes a regularizer: declarations, made in __init__.

    def declare_networks(self, networks: Iterable[str], *, successors: bool = True) -> None:
        """Declares which networks, by their names, are evaluated; with successors at next states.

        Raises:
            TypeError: one is recurrent, does not declare its keys, or has several distributions;
                the loss reads no successors; or a string in the place of a list.
            ValueError: the loss has no network of that name.
        """
        networks = listed_names(networks)
        there = [*self.policy_networks(), *self.value_networks()]
        for name in networks:
            if getattr(self, name, None) is None:
                raise ValueError(f"the loss has no network {name!r}, but {there}.")
        if successors:
            check_reads_next(self)
            self._followed = (*self._followed, *networks)
        self._wire([*self._evaluation.wiring, *networks])

    def declare_policy(self, *, successors: bool = True) -> None:
        """Declares that the policy is evaluated; with successors at next states.

        Raises:
            TypeError: the loss has none, or as :meth:`declare_networks`.
        """
        networks = self.policy_networks()
        if not networks:
            regularizer, *_, loss = (part.__name__ for part in self._parts)
            raise TypeError(f"{regularizer} needs a policy: {loss} has none.")
        self.declare_networks(networks, successors=successors)

    def declare_inputs(self, keys: Iterable[NestedKey]) -> None:
        """Declares entries of the batch that are read beside states and their successors."""
        self._inputs = (*self._inputs, *keys)
        self._wire(self._evaluation.wiring)

    def policy_networks(self) -> list[str]:
        """The name of the loss's policy, where it has one."""
        return [] if getattr(self, POLICY_NETWORK, None) is None else [POLICY_NETWORK]

    def value_networks(self) -> list[str]:
        """The names of the value functions that the loss trains."""
        untrained = "critic_network" if getattr(self, "critic_coeff", 1.0) is None else None
        return [
            name
            for name in VALUE_NETWORKS
            if name != untrained and getattr(self, name, None) is not None
        ]

    def has_stochastic_policy(self) -> bool:
        """Whether the policy, a declared network, is a distribution; otherwise it is an action."""
        return self._evaluation.wiring[POLICY_NETWORK].stochastic

    def is_ensemble(self, network: str) -> bool:
        """Whether the loss has expanded a network's parameters to those of several."""
        return is_ensemble(self, network)

    # For who writes a regularizer: computations, made in the two methods.

    def transitions(
        self, tensordict: TensorDictBase, networks: Iterable[str], *, labels: bool = False
    ) -> dict[NestedKey, tuple[Tensor, Tensor]]:
        """The states that networks read, with their successors: keys to pairs of ``[*B, *F]``.

        Neither has a gradient. Inputs without a successor (goals) are left out.

        Args:
            tensordict: the batch, ``[*B]``.
            networks: names of declared ones.
            labels: also inputs that are not floating point, such as masks.

        Raises:
            TypeError: a network reads no floating-point state.
            KeyError: no state that a network reads has a successor in the batch.
        """
        read = {name: self._evaluation.wiring[name].states for name in networks}
        return find_transitions(tensordict, read, labels=labels)

    def policy_states(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """The floating-point states that the policy reads, ``[*B, *F]`` by their keys.

        Unlike :meth:`transitions`, also those without a successor, such as goals.

        Args:
            tensordict: the batch, ``[*B]``.

        Raises:
            TypeError: it reads none.
        """
        read = self._evaluation.wiring[POLICY_NETWORK].states
        return find_states(tensordict, read, POLICY_NETWORK)

    def policies_at(
        self, tensordict: TensorDictBase, states: TensorDictBase, rows: Tensor | None = None
    ) -> tuple[Policy, Policy]:
        """The policy at the batch's states and at others, in one evaluation.

        Args:
            tensordict: the batch, ``[*B]``.
            states: entries that take the place of the batch's, ``[K, *B]``.
            rows: ``[M]``, of the batch as one row, if these states, ``[K, M]``, are theirs alone.

        Returns:
            The policy at the one and at the other: distributions ``[K, *B]`` or, where it is
            deterministic, actions ``[K, *B, A]``.
        """
        return self._evaluation.policies_at(self, tensordict, states, rows)

    def policy_at(self, tensordict: TensorDictBase, states: TensorDictBase) -> Policy:
        """The policy at other states alone.

        Its gradients are free of every other evaluation's, so that they may be taken at once, as by
        a search for states.

        Args:
            tensordict: the batch, ``[*B]``.
            states: as for :meth:`policies_at`; the batch's own where these are given.

        Returns:
            A distribution ``[K, *B]`` or, where it is deterministic, actions ``[K, *B, A]``.
        """
        return self._evaluation.policy_at(self, tensordict, states)

    def values_at(
        self,
        network: str,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        rows: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """A value function at the batch's states and at others, in one evaluation.

        Args:
            network: the name of a declared one.
            tensordict: the batch, ``[*B]``. Action values are taken at its actions.
            states: entries that take the place of the batch's, ``[K, *B]``.
            rows: as for :meth:`policies_at`.

        Returns:
            Values ``[1, *B, ...]`` and ``[K, *B, ...]``, with the ensemble's dimension in front of
            both where :meth:`is_ensemble`.
        """
        return self._evaluation.values_at(self, network, tensordict, states, rows)

    def known_states(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """Other states, ``[K, *B]``, that are in the batch; ``None`` if they are drawn later.

        A regularizer that returns here the object that it gives to :meth:`policies_at` and
        :meth:`values_at` has small batches evaluated in one pass when compiled.
        """
        return None

    def made_once(self, name: str, make: Callable[[], Made]) -> Made:
        """What ``make()`` gives: in a forward pass once for all who ask by a name, else anew."""
        if (shared := self._evaluation.forward_pass) is None:
            return make()
        if name not in shared.made:
            shared.made[name] = make()
        return shared.made[name]

    def reduce_term(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduces as the loss does its own terms: its reduction, masks and priority weights.

        Losses that ignore priority weights, ignore them here too. Weights make it TorchRL's
        weighted mean, whose strength does not depend on them, or its weighted sum, whose strength
        does, as the loss's own. :class:`PPORPELoss` scales its own terms down by them, and gives
        those of a regularizer a mean of 1: beside it a regularizer is at its full gain.

        Args:
            value: ``[*B, ...]``; the term is ``[]`` or, with ``reduction="none"``, like it.
            tensordict: the batch, ``[*B]``.
        """
        check_of_each(value.shape, tensordict.batch_size)
        weights = None
        if hasattr(self.tensor_keys, "priority_weight"):
            weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(value, tensordict, weights=weights, reduction=self._term_reduction)

    def reduce_diagnostic(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """The plain mean over the unmasked batch, detached; with reduction="none" the values."""
        reduction = "none" if self._term_reduction == "none" else "mean"
        value = as_masked(value, tensordict, self._loss_mask_keys())
        return self._reduce_loss(value.detach(), tensordict, reduction=reduction)

    # Internals.

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """As the loss does; kept until ``forward`` is done (see :class:`SharedEvaluation`)."""
        evaluate = super().evaluate_at_batch
        return self._evaluation.at_batch(self, network, tensordict, evaluate, self.known_states)

    @property
    def _term_reduction(self) -> str:
        return getattr(self, "reduction", "mean")

    def _wire(self, networks: Iterable[str]) -> None:
        self._evaluation.wire(self, networks)
        if self.in_keys:
            wirings = (self._evaluation.wiring[name] for name in self._followed)
            successors = (next_key(key) for wiring in wirings for key in wiring.states)
            self.in_keys = list(dict.fromkeys([*self.in_keys, *successors, *self._inputs]))
