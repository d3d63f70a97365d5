"""The protocol for regularizers: a TorchRL loss with further terms."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from textwrap import indent
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torch.compiler import is_compiling
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import as_number, check_of_each, check_real
from torchrl_l2c2.objectives._batch import (
    as_masked,
    check_evaluates_states,
    check_reads_next,
    draw_rows,
    find_states,
    find_transitions,
    next_key,
    spread_rows,
)
from torchrl_l2c2.objectives._fold import PARTS, TermWatch, add_penalty, fold_targets, make_part
from torchrl_l2c2.objectives._networks import (
    POLICY_NETWORK,
    VALUE_NETWORKS,
    EvaluatedNetworks,
    NetworkSpec,
    Policy,
    SharedEvaluation,
    is_ensemble,
)
from torchrl_l2c2.objectives._specialize import SpecializedLoss

Made = TypeVar("Made")

GAIN = "regularizer_gain"
"""The coefficient of every regularized loss that multiplies all its added terms."""

PROGRESS = "regularizer_progress"
"""The share of training that is over, where the gain follows it."""


class RegularizedLoss(SpecializedLoss, SharedEvaluation):
    r"""A TorchRL loss with further terms: the base class of every regularizer of this package.

    ``Regularizer(loss, ...)`` returns an instance of ``Regularizer[type(loss)]``, a subclass of
    both classes that is made once for each pair. It is a full member of the loss's class: updaters,
    ``set_keys``, ``select_out_keys``, scheduled coefficients, ``deepcopy`` and checkpoints work as
    before, and its ``state_dict`` has the keys of the base loss (plus the networks of a regularizer
    such as :class:`ASAPLoss`, and the progress of a ramp). It holds the networks, parameters and
    buffers of ``loss`` themselves, not copies, and ``loss`` stays the base loss. From then on,
    rename keys, choose value estimators, move, cast or compile the regularized loss.

    ``forward`` returns the loss's own terms, unchanged (compiled: up to rounding), and the terms of
    the regularizer, for the training loop to sum. After :meth:`fold`, which
    :func:`~torchrl_l2c2.smooth` calls, they are part of the loss's own terms instead.

    A regularizer is a subclass that defines ``__init__`` and one or both of
    :meth:`policy_regularizer` and :meth:`value_regularizer`. When its ``__init__`` runs, the object
    already is the loss: no other constructor is called. ``__init__`` declares what is added, with
    :meth:`declare_networks`, :meth:`declare_terms` and :meth:`register_coefficient`; the two
    methods compute it, with :meth:`policies_at`, :meth:`values_at`, :meth:`transitions`,
    :meth:`reduce_term` and :meth:`scaled`. Regularizers can be applied to one another's results.

    .. note:: Losses that are not trained on transitions, and recurrent policies, are refused.
        Regularizers evaluate networks without dropout. A network that draws random numbers in its
        forward pass is refused at its first evaluation. Running statistics of normalization layers
        are left alone.

    Args:
        base_loss (LossModule): the loss.

    Attributes:
        regularizer_gain (Tensor): multiplies all added terms, at least 0; 1 unless assigned to.
            Larger values regularize more; 0 leaves the base loss's values and gradients. It can be
            assigned to at any time, also between calls of a compiled loss.
        policy_terms (frozenset of str): the ``loss_*`` keys of all regularizers applied that train
            the policy.
        auxiliary_terms (frozenset of str): the keys of terms that train networks of the
            regularizers' own.
        added_terms (frozenset of str): all ``loss_*`` keys of all regularizers applied.

    Raises:
        TypeError: the loss cannot be regularized, or already is by this regularizer.

    Warns:
        UserWarning: in use, once each: an added term that is never differentiated; next
            observations that are not finite; a ramp that :meth:`set_progress` never moved; keys or
            a value estimator of the base loss that changed after the wrapping.

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

    policy_terms: frozenset[str] = frozenset()
    auxiliary_terms: frozenset[str] = frozenset()
    added_terms: frozenset[str] = frozenset()
    skip_ends: bool = False
    out_keys: list[str]

    _inputs: tuple[NestedKey, ...] = ()
    _followed: tuple[str, ...] = ()
    _evaluation = EvaluatedNetworks()  # Every loss has its own, made with it.
    # The last values; tensors, as they are shared where the gains are.
    _coefficients: Mapping[str, Tensor] = MappingProxyType({})
    _diagnostics: tuple[str, ...] = ()
    _folded: bool = False
    _ramp: tuple[float, float] | None = None  # last gain, length
    _watch: TermWatch = TermWatch()
    _settings: ClassVar[tuple[str, ...]] = ()  # attributes that print() shows

    def __new__(cls, base_loss: LossModule, *args: Any, **kwargs: Any) -> RegularizedLoss:
        self = super().__new__(cls, base_loss)
        check_evaluates_states(base_loss)
        regularized = isinstance(base_loss, RegularizedLoss)
        if regularized and base_loss._folded:
            raise TypeError(
                f"{type(base_loss).__name__} has its penalty folded into its own terms: combine "
                "regularizers first, and call fold() on the outermost."
            )
        self._evaluation = EvaluatedNetworks(base_loss._evaluation.specs if regularized else None)
        self._watch = TermWatch()
        if not regularized:
            self.register_coefficient(GAIN, 1.0)
        return self

    @classmethod
    def _made_methods(cls, original: type[LossModule]) -> dict[str, Any]:
        """Methods such as ``actor_loss`` that loops may call instead of ``forward``."""
        return {
            name: make_part(getattr(original, name), kind, targets)
            for name, (kind, targets) in PARTS.items()
            if callable(getattr(original, name, None))
        }

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """As for the loss itself; the inputs of the regularizer follow."""
        super().set_keys(**kwargs)
        self._inspect(self._evaluation.specs)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss's own terms and the regularizer's.

        Args:
            tensordict (TensorDictBase): the batch, as the loss itself takes it.

        Returns:
            TensorDict: the loss's own output with the regularizer's terms and diagnostics added. If
            the penalty is folded, it is part of the loss's own terms, and is reported under
            ``penalty_*`` instead of ``loss_*``; without gradients (``torch.no_grad()``) it is then
            not computed: the own terms are the base loss's, and the regularizer's entries are NaN.
        """
        if self._folded and not torch.is_grad_enabled():
            terms = super().forward(tensordict)
            unknown = torch.full(terms.batch_size, math.nan, device=self._buffers[GAIN].device)
            for key in (*map(penalty_key, sorted(self.added_terms)), *self._diagnostics):
                terms.set(key, unknown.clone())
            return terms
        outer = self._evaluation.begin_forward_pass()
        try:
            # The loss's own draws come first: at one seed its terms are those of the base loss.
            terms = super().forward(tensordict)
            added = self.policy_regularizer(tensordict)
            added.update(self.value_regularizer(tensordict))
        finally:
            self._evaluation.end_forward_pass(outer)
        if self._folded:
            self._add_penalties(terms, added)
        else:
            terms.update(added)
        if not is_compiling() and self.training and torch.is_grad_enabled():
            self._watch.see_forward(self, terms)
            self._warn_of_changed_base()
        networks = (f"{name}_params" for name in self._evaluation.specs)
        self._clear_weakrefs(tensordict, terms, *networks)
        return terms

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the policy, with their diagnostics; empty if there are none.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``actor_loss`` takes.
        """
        self._watch.see_regularizer(self)
        return TensorDict()

    def value_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the value functions, with their diagnostics.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``value_loss`` takes.
        """
        self._watch.see_regularizer(self)
        return TensorDict()

    # Folding and the gain.

    def fold(self) -> RegularizedLoss:
        """Makes the penalty part of the loss's own terms.

        A term that trains the policy is added to ``loss_actor`` or ``loss_objective``, a term that
        trains a value function to the loss of that function (``loss_qvalue``, ``loss_critic``,
        ...), in ``forward`` and in methods such as ``actor_loss`` and ``value_loss``. Loops that
        sum terms by name, and loops that sum every ``loss_*`` key, then train with the regularizer.
        The penalty is reported as ``penalty_*``, without a gradient.

        Returns:
            The loss itself.

        Raises:
            TypeError: the loss has no term that a penalty can be added to.
        """
        added = {*self.added_terms, *self._diagnostics}
        own = [key for key in self.out_keys_source if key not in added]
        if own:  # Some losses list none.
            for term in sorted(self.added_terms):
                fold_targets(term, term in self._policy_side, own)
        self._folded = True
        self._rename_out_keys({term: penalty_key(term) for term in self.added_terms})
        return self

    def unfold(self) -> RegularizedLoss:
        """Undoes :meth:`fold`: the regularizer's terms are separate again.

        Returns:
            The loss itself.
        """
        self._folded = False
        self._rename_out_keys({penalty_key(term): term for term in self.added_terms})
        return self

    def _rename_out_keys(self, names: Mapping[str, str]) -> None:
        """Renames entries of ``out_keys``; a selection of them stays one."""
        selected = [names.get(key, key) for key in self.out_keys]
        self.reset_out_keys()
        self.out_keys = [names.get(key, key) for key in self.out_keys]
        if selected != self.out_keys:
            self.select_out_keys(*selected)

    @property
    def folded(self) -> bool:
        """Whether the penalty is part of the loss's own terms."""
        return self._folded

    def ramp(self, length: float = 1.0, *, end: float = 1.0) -> RegularizedLoss:
        r"""Has the gain rise with the progress of training, which :meth:`set_progress` sets.

        .. math::
            \mathtt{regularizer\_gain} = \mathtt{end} \cdot \min(1, x / \mathtt{length})

        Until the first call of :meth:`set_progress` the gain is ``end``.

        Args:
            length (float): the share of training after which the gain is ``end``, in (0, 1].
                Smaller values smooth earlier. Defaults to ``1.0``.

        Keyword Args:
            end (float): the last gain, at least 0. Larger values regularize more. Defaults to
                ``1.0``.

        Returns:
            The loss itself.

        Raises:
            TypeError: a value is not a real number.
            ValueError: a value is out of its range.
        """
        check_real("length", length, above=0, at_most=1)
        check_real("end", end, at_least=0)
        self._ramp = float(end), float(length)
        progress = torch.tensor(-1.0, device=self._buffers[GAIN].device)
        self.register_buffer(PROGRESS, progress)
        self.regularizer_gain = end
        return self

    def set_progress(self, progress: float) -> None:
        """Says how much of training is over; moves the gain of a ramp.

        Call it after every rollout or episode. It does nothing for a loss without a :meth:`ramp`.
        It works between calls of a compiled loss, and the ``state_dict`` of the loss keeps it.

        Args:
            progress (float): the share of training that is over, from 0 to 1. The last batch may go
                beyond: values up to 2 count as 1.

        Raises:
            TypeError: it is not a number.
            ValueError: it is below 0, or above 2: a number of frames instead of a share.

        Examples:
            >>> import torch
            >>> from torchrl.modules import Actor, ValueOperator
            >>> from torchrl.objectives import DDPGLoss
            >>> from torchrl_l2c2 import CATSLoss
            >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
            >>> loss = CATSLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value)).ramp()
            >>> loss.set_progress(0.25)
            >>> loss.regularizer_gain.item()
            0.25
        """
        progress = as_number("progress", progress)
        hint = "It is the share of training that is over: frames / total_frames."
        check_real("progress", progress, at_least=0, at_most=2, hint=hint)
        if self._ramp is None:
            return
        self._watch.progress_set = True
        self._buffers[PROGRESS].fill_(min(1.0, progress))
        self._follow_progress()

    def _follow_progress(self) -> None:
        if self._ramp is not None:
            end, length = self._ramp
            progress = self._buffers[PROGRESS].item()  # -1 before the first call
            self.regularizer_gain = end * min(1.0, progress / length) if progress >= 0 else end

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        if self._ramp is None:
            super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
            return
        saved = prefix + PROGRESS in state_dict
        if not saved:  # A checkpoint of the base loss: the progress stays.
            state_dict[prefix + PROGRESS] = self._buffers[PROGRESS].clone()
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        if saved:
            self._follow_progress()

    @property
    def _policy_side(self) -> frozenset[str]:
        """Terms that train the policy, or a predictor of the regularizer's own."""
        return self.policy_terms | self.auxiliary_terms

    def _add_penalties(self, terms: TensorDictBase, added: TensorDictBase) -> None:
        """Adds penalties to the loss's own terms, and reports them."""
        own = [key for key in terms.keys() if key not in self.added_terms]
        for key, value in list(added.items()):
            if key not in self.added_terms:
                terms.set(key, value)
                continue
            for target in fold_targets(key, key in self._policy_side, own):
                folded = self._folded_value(key, value)
                terms.set(target, add_penalty(terms.get(target), folded, target))
            terms.set(penalty_key(key), value.detach())

    def _folded_value(self, key: str, term: Tensor) -> Tensor:
        """A term as it is added: only its gradient, if it trains the regularizer's own network."""
        return term - term.detach() if key in self.auxiliary_terms else term

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._coefficients:
            self._warn_of_typo(name)
            super().__setattr__(name, value)
            return
        try:
            number = as_number(name, value)
            check_real(name, number, at_least=0)
        except (TypeError, ValueError):
            if value is self._buffers.get(name):  # ``-=`` has written it by now.
                value.detach_().copy_(self._coefficients[name])
            raise
        if name not in self._buffers:
            raise ValueError(
                f"{name} has nothing to scale: this {type(self).__name__} was made without "
                "the term. Make it with a gain above 0, which can be set to 0 later."
            )
        self._buffers[name].fill_(number)
        self._coefficients[name].fill_(number)

    def _warn_of_typo(self, name: str) -> None:
        """Warns of a new attribute whose name is nearly the name of a gain."""
        if name.startswith("_") or hasattr(self, name):
            return
        gains = [gain for gain in self._coefficients if gain.endswith(f"_{name}")]
        gains = gains or get_close_matches(name, self._coefficients, 1, cutoff=0.85)
        if gains:
            warnings.warn(
                f"{name!r} scales nothing in a {type(self).__name__}: the gain is {gains[0]!r}.",
                stacklevel=3,
            )

    def __repr__(self) -> str:
        # TensorDict's modules leave extra_repr out.
        start = f"{type(self).__name__}("
        rest = super().__repr__().removeprefix(start).lstrip("\n")
        return f"{start}\n{indent(self.extra_repr(), 4 * ' ')}\n{rest}"

    def extra_repr(self) -> str:
        """The settings of the regularizers, the first lines of ``print(loss)``."""
        lines = []
        for part in (p for p in getattr(self, "_parts", ()) if issubclass(p, RegularizedLoss)):
            settings = {name: getattr(self, name) for name in part._settings}
            shown = ", ".join(f"{name}={value!r}" for name, value in settings.items())
            lines.append(f"{part.__name__}: {shown}")
        gains = {name: self._buffers[name] for name in self._coefficients if name in self._buffers}
        lines.append(", ".join(f"{name}={gain.item():g}" for name, gain in gains.items()))
        lines.append(f"folded={self._folded}, skip_ends={self.skip_ends}, ramp={self._ramp}")
        return "\n".join(lines)

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
        self._inspect([*self._evaluation.specs, *networks])

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
        self._inspect(self._evaluation.specs)

    def declare_terms(
        self,
        *,
        policy: Iterable[str] = (),
        value: Iterable[str] = (),
        auxiliary: Iterable[str] = (),
        diagnostics: Iterable[str] = (),
    ) -> None:
        """Declares what the two methods return; adds it to ``out_keys``, in the order given.

        Keyword Args:
            policy: ``loss_*`` keys of terms that train the policy, for ``policy_terms``.
            value: ``loss_*`` keys of terms that train value functions alone.
            auxiliary: ``loss_*`` keys of terms that train networks of the regularizer's own, for
                ``auxiliary_terms``.
            diagnostics: other keys, of entries that train nothing.

        Raises:
            TypeError: a string in the place of a list of them.
            ValueError: a key has the beginning of another kind, or is one of the loss's.
        """
        policy, value, auxiliary, diagnostics = map(
            listed_names, (policy, value, auxiliary, diagnostics)
        )
        others = [*value, *auxiliary]
        if taken := set(self.out_keys) & {*policy, *others, *diagnostics}:
            raise ValueError(f"the loss has {sorted(taken)} already: choose other names.")
        for keys, trains in ((policy, True), (others, True), (diagnostics, False)):
            for key in keys:
                if key.startswith("loss_") != trains:
                    kind = "a term must start" if trains else "a diagnostic must not start"
                    raise ValueError(f"{kind} with 'loss_', got {key!r}: rename it.")
        self.out_keys = [*self.out_keys, *policy, *others, *diagnostics]
        self._diagnostics = (*self._diagnostics, *diagnostics)
        self.policy_terms = self.policy_terms.union(policy)
        self.auxiliary_terms = self.auxiliary_terms.union(auxiliary)
        self.added_terms = self.added_terms.union(policy, others)

    def register_coefficient(self, name: str, value: float, used: bool = True) -> None:
        """Makes a gain, a buffer of shape ``[]`` that can be assigned to later on.

        Not persistent: the ``state_dict`` is to keep the keys of the plain loss's.

        Args:
            name: the attribute.
            value: a finite number of at least 0, or a tensor of one, now and whenever it is
                assigned to.
            used: whether there is a term that it scales. If not, assigning to it is an error.

        Raises:
            TypeError: the value is no number.
            ValueError: it is negative or not finite, or the loss has something of that name.
        """
        if name in self._coefficients or hasattr(self, name):
            raise ValueError(f"the loss has {name!r} already: choose another name.")
        value = as_number(name, value)
        check_real(name, value, at_least=0)
        self._coefficients = {**self._coefficients, name: torch.tensor(float(value))}
        if used:
            gain = torch.tensor(float(value), device=self._default_device)
            self.register_buffer(name, gain, persistent=False)

    def scaled(self, term: Tensor, *names: str, auxiliary: bool = False) -> Tensor:
        """A term times its gains and ``regularizer_gain``; these may change before ``backward``.

        Args:
            term: a reduced term.
            *names: registered coefficients.
            auxiliary: whether the term trains a network of the regularizer's own, which
                ``regularizer_gain`` leaves alone.
        """
        # Autograd keeps the factor, and an assignment writes into the gain itself.
        for name in (*names, *(() if auxiliary else (GAIN,))):
            term = term * self._buffers[name].clone()
        return term

    @property
    def networks(self) -> dict[str, NetworkSpec]:
        """The declared networks by name, with the keys of their inputs and outputs."""
        return self._evaluation.specs

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
        return self.networks[POLICY_NETWORK].stochastic

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
        read = {name: self.networks[name].states for name in networks}
        return find_transitions(tensordict, read, labels=labels)

    def policy_states(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """The floating-point states that the policy reads, ``[*B, *F]`` by their keys.

        Unlike :meth:`transitions`, also those without a successor, such as goals.

        Args:
            tensordict: the batch, ``[*B]``.

        Raises:
            TypeError: it reads none.
        """
        read = self.networks[POLICY_NETWORK].states
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

    def policy_at(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        network: str = POLICY_NETWORK,
    ) -> Policy:
        """The policy at other states alone.

        Its gradients are free of every other evaluation's, so that they may be taken at once, as by
        a search for states.

        Args:
            tensordict: the batch, ``[*B]``.
            states: as for :meth:`policies_at`; the batch's own where these are given.
            network: the policy, or the name of a copy of it with parameters of its own.

        Returns:
            A distribution ``[K, *B]`` or, where it is deterministic, actions ``[K, *B, A]``.
        """
        return self._evaluation.policy_at(self, tensordict, states, network)

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

    def sample_rows(self, name: str, tensordict: TensorDictBase, fraction: float) -> Tensor | None:
        """A random share of the rows of a batch, the same in one forward pass for one name.

        Drawn with torch's global generator, no row twice and each as likely.

        Args:
            name: who asks, such as ``"caps"``.
            tensordict: the batch, ``[*B]``.
            fraction: its share, in (0, 1]; rounded to whole rows, at least one.

        Returns:
            Row numbers ``[M]`` in the batch written as one row; ``None`` stands for all rows.
        """
        device = self._buffers[GAIN].device
        return self.made_once(f"{name}_rows", lambda: draw_rows(tensordict, fraction, device))

    def counted(
        self,
        tensordict: TensorDictBase,
        transitions: Mapping[NestedKey, tuple[Tensor, Tensor]],
    ) -> Tensor:
        """Which transitions count: their next observation is known.

        A next observation that is not finite in any coordinate of an entry is not known. With
        ``skip_ends``, the next observation of a transition at which an episode ends is not known
        either (for environments whose ``next`` is the reset state).

        Args:
            tensordict: the batch, ``[*B]``.
            transitions: states and successors of the batch, as :meth:`transitions` returns them.

        Returns:
            Booleans, ``[*B]``.
        """
        ndim, counts = tensordict.batch_dims, None
        for _, successor in transitions.values():
            if successor.is_floating_point():
                finite = successor.isfinite().flatten(ndim).any(-1)
                counts = finite if counts is None else counts & finite
        assert counts is not None
        self.warn_uncounted(counts)
        done = self._ends(tensordict)
        return counts if done is None else counts & ~done

    def _ends(self, tensordict: TensorDictBase) -> Tensor | None:
        """Which transitions end an episode, ``[*B]``, if these are left out."""
        if not self.skip_ends:
            return None
        key = next_key(getattr(self.tensor_keys, "done", "done"))
        done = tensordict.get(key, None)
        if done is None:
            raise KeyError(f"skip_ends=True needs {key!r}, and the batch has none: keep it.")
        return done.reshape(*tensordict.batch_size, -1).any(-1)

    def warn_uncounted(self, counts: Tensor) -> None:
        """Warns once if next observations of the batch are not finite; eager only.

        On a GPU only some batches are looked at, as it would have to be waited for.
        """
        if not is_compiling():
            self._watch.see_counts(type(self).__name__, counts)

    def reduce_term(
        self,
        value: Tensor,
        tensordict: TensorDictBase,
        *,
        rows: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Reduces as the loss does its own terms: its reduction, masks and priority weights.

        Losses that ignore priority weights ignore them here, too. A mean is TorchRL's weighted
        mean, whose strength does not depend on the weights; a sum is its weighted sum.
        :class:`PPORPELoss` scales its own terms down by the weights; the terms of a regularizer
        around it get weights with a mean of 1, and so keep their full gain.

        Args:
            value: ``[*B, ...]``; the term is ``[]`` or, with ``reduction="none"``, like it.
            tensordict: the batch, ``[*B]``.
            rows: ``[M]``, if ``value`` is ``[M, ...]``, of these rows of the batch written as one
                row. They stand for all rows: the expectation of the term does not change.
            counts: which values count, ``[*B]`` or ``[M]``. A mean is taken over these only;
                others are 0 in a sum or without a reduction.
        """
        weights = None
        if hasattr(self.tensor_keys, "priority_weight"):
            weights = self._maybe_get_priority_weight(tensordict)
        return self._reduced(value, tensordict, rows, counts, self._term_reduction, weights)

    def reduce_diagnostic(
        self,
        value: Tensor,
        tensordict: TensorDictBase,
        *,
        rows: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """The unweighted mean over the unmasked batch, detached; with reduction="none" the values.

        Arguments are those of :meth:`reduce_term`.
        """
        reduction = "none" if self._term_reduction == "none" else "mean"
        return self._reduced(value.detach(), tensordict, rows, counts, reduction, None, masked=True)

    # Internals.

    def _reduced(
        self,
        value: Tensor,
        tensordict: TensorDictBase,
        rows: Tensor | None,
        counts: Tensor | None,
        reduction: str,
        weights: Tensor | None,
        masked: bool = False,
    ) -> Tensor:
        shape = tensordict.batch_size

        def reduce(each: Tensor) -> Tensor:
            each = each if rows is None else spread_rows(each, rows, shape)
            check_of_each(each.shape, shape)
            each = as_masked(each, tensordict, self._loss_mask_keys()) if masked else each
            return self._reduce_loss(each, tensordict, weights=weights, reduction=reduction)

        if counts is None:
            return reduce(value)
        check_of_each(value.shape, counts.shape)
        counted = counts.reshape(counts.shape + (1,) * (value.ndim - counts.ndim))
        total = reduce(torch.where(counted, value, 0.0))
        if reduction != "mean":
            return total
        share = reduce(counted.expand_as(value).to(value.dtype))
        # Not divided where all count: rounding would change the term.
        return torch.where(counts.all() | (share == 0), total, total / share)

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """As the loss does; kept until ``forward`` is done (see :class:`SharedEvaluation`)."""
        evaluate = super().evaluate_at_batch
        return self._evaluation.at_batch(self, network, tensordict, evaluate, self.known_states)

    @property
    def _term_reduction(self) -> str:
        return getattr(self, "reduction", "mean")

    def _inspect(self, networks: Iterable[str]) -> None:
        self._evaluation.inspect(self, networks)
        if self.in_keys:
            specs = (self._evaluation.specs[name] for name in self._followed)
            successors = (next_key(key) for spec in specs for key in spec.states)
            self.in_keys = list(dict.fromkeys([*self.in_keys, *successors, *self._inputs]))


def penalty_key(term: str) -> str:
    """The key under which a folded term is reported.

    Examples:
        >>> penalty_key("loss_l2c2_actor")
        'penalty_l2c2_actor'
    """
    return "penalty_" + term.removeprefix("loss_")


def listed_names(names: Iterable[str]) -> list[str]:
    """A list of names; a string alone would be its letters.

    Raises:
        TypeError: it is a string.
    """
    if isinstance(names, str):
        raise TypeError(f"a list of names is wanted, got the string {names!r}: [{names!r}] is one.")
    return list(names)
