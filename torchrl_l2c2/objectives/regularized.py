"""The base class of regularizers: a TorchRL loss with additional terms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from difflib import get_close_matches
from inspect import signature
from textwrap import indent
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torch.compiler import is_compiling
from torchrl.objectives import LossModule, REDQLoss

from torchrl_l2c2._checks import as_number, check_of_each, check_real
from torchrl_l2c2._warnings import warn
from torchrl_l2c2.objectives._batch import (
    as_masked,
    check_batch_size,
    check_evaluates_states,
    check_reads_next,
    draw_rows,
    find_recurrent,
    find_states,
    find_transitions,
    is_floating_point,
    next_key,
    spread_rows,
)
from torchrl_l2c2.objectives._evaluation import EvaluatedNetworks, Policy, SharedEvaluation
from torchrl_l2c2.objectives._fold import (
    PARTS,
    POLICY_LOSSES,
    add_penalty,
    find_policy_term,
    fold_targets,
    make_part,
    penalty_key,
)
from torchrl_l2c2.objectives._networks import (
    IMITATING,
    POLICY_NETWORK,
    VALUE_NETWORKS,
    NetworkSpec,
    is_ensemble,
)
from torchrl_l2c2.objectives._specialize import SpecializedLoss, find_selections
from torchrl_l2c2.objectives._watch import TermWatch
from torchrl_l2c2.presets import METHODS, NEIGHBORHOOD_FIELDS

Made = TypeVar("Made")

GAIN = "regularizer_gain"
"""Name of the coefficient that multiplies all added terms but the auxiliary ones."""

NOT_SETTINGS = ("fold", "ramp", "relative", "set_progress", "unfold")
"""Methods that could be taken for settings."""

PROGRESS = "regularizer_progress"
"""Name of the buffer with the completed share of training, for a ramp."""


KNOBS = {
    "strength": "the strength is 'strength'",
    "progress": "the progress of training is set by set_progress(...)",
}
"""Attributes that training loops set, with a hint for names that are nearly the same."""


class RegularizedLoss(SpecializedLoss, SharedEvaluation):
    r"""A TorchRL loss with additional terms: the base class of all regularizers.

    ``Regularizer(loss, ...)`` returns an instance of ``Regularizer[type(loss)]``, a subclass of
    both classes that is made once for each pair. Updaters, ``set_keys``, ``select_out_keys``,
    scheduled coefficients, ``deepcopy`` and checkpoints work as before. The ``state_dict`` has the
    keys of the base loss (plus the networks of a regularizer such as :class:`ASAPLoss`, and the
    progress of a ramp). The regularized loss shares networks, parameters and buffers with ``loss``,
    which stays unchanged. After wrapping, call ``set_keys``, ``make_value_estimator``, ``to`` and
    ``torch.compile`` on the regularized loss.

    ``forward`` returns the loss's own terms, unchanged (up to rounding if compiled), and the
    regularizer's terms, for the training loop to sum. After :meth:`fold`, which
    :func:`~torchrl_l2c2.smooth` calls, the penalty is part of the loss's own terms instead.

    A regularizer is a subclass that defines ``__init__`` and one or both of
    :meth:`policy_regularizer` and :meth:`value_regularizer`. When its ``__init__`` runs, the object
    already is the loss, and ``super().__init__()`` does nothing. ``__init__`` declares the terms
    with :meth:`declare_networks`, :meth:`declare_terms` and :meth:`register_coefficient`. The two
    methods compute the terms with :meth:`policies_at`, :meth:`values_at`, :meth:`transitions`,
    :meth:`reduce_term` and :meth:`scaled`. Regularizers can be nested.

    .. note:: Losses that are not trained on transitions are refused, as is a network that draws
        random numbers in its forward pass (at its first evaluation). Regularizers evaluate networks
        without dropout, and do not update running statistics of normalization layers. Recurrent
        networks, made with ``LSTMModule`` or ``GRUModule``, take a single step from the recurrent
        state in the batch; only the observation differs.

    Args:
        base_loss (LossModule): the loss.

    Attributes:
        strength (float): factor of all added terms but the auxiliary ones, at least 0; of a ramp,
            its final value. Larger values regularize more; 0 leaves the base loss's values and
            gradients unchanged, if the terms are finite. Assign to it at any time, also between
            calls of a compiled loss.
        regularizer_gain (Tensor): the factor at present, at least 0; initially 1. A ramp sets it at
            every :meth:`set_progress`. Without a ramp it is the strength.
        skip_ends (bool): whether transitions that end an episode are left out of comparisons with
            the next state. It describes the environment: ``True`` in one of nested regularizers
            holds for all. If each agent has its own end, one agent's end leaves out the transition.
        policy_terms (frozenset of str): the added ``loss_*`` keys that train the policy.
        auxiliary_terms (frozenset of str): the added ``loss_*`` keys that train networks of a
            regularizer, such as a predictor.
        added_terms (frozenset of str): all added ``loss_*`` keys.

    Raises:
        TypeError: the loss cannot be regularized, or has this regularizer already.

    Warns:
        UserWarning: in eager use, once each: an added term is never differentiated; observations
            are not finite, or several steps ahead; the progress of a ramp is never set, or stays 0;
            keys or the value estimator of the base loss change after the wrapping; or a setting is
            assigned that is only read when the loss is made.

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
    _evaluation = EvaluatedNetworks()  # Replaced for each loss in __new__.
    # The last values, as tensors: shared memory then covers both them and the gains.
    _coefficients: Mapping[str, Tensor] = MappingProxyType({})
    _diagnostics: tuple[str, ...] = ()
    _folded: bool = False
    _ramp: tuple[float, float] | None = None  # last gain, length
    _relative: bool = False
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
        """Makes the methods that loops may call instead of ``forward``, such as ``actor_loss``."""
        return {
            name: make_part(getattr(original, name), kind, targets)
            for name, (kind, targets) in PARTS.items()
            if callable(getattr(original, name, None))
        }

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """Sets keys as for the base loss, and updates the regularizer's inputs."""
        super().set_keys(**kwargs)
        self._inspect(self._evaluation.specs)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss's own terms and the regularizer's.

        Args:
            tensordict (TensorDictBase): the batch, as for the base loss.

        Returns:
            TensorDict: the base loss's output with the regularizer's terms and diagnostics. A
            folded penalty is part of the loss's own terms and is reported as ``penalty_*`` instead
            of ``loss_*``. Under ``torch.no_grad()`` a folded penalty is not computed: the terms are
            the base loss's terms, and the regularizer's entries are NaN. If the base loss leaves
            out its policy's term in a call, as with delayed updates of the policy, the terms that
            train the policy are left out, too.

        Raises:
            ValueError: the regularizer returns other ``loss_*`` keys than it declared, or the batch
                has no batch size.
            RuntimeError: the penalty is relative, and the loss has no term that trains the policy.
        """
        if self._folded and not torch.is_grad_enabled():
            terms = super().forward(tensordict)
            unknown = torch.full(terms.batch_size, math.nan, device=self._buffers[GAIN].device)
            for key in (*map(penalty_key, sorted(self.added_terms)), *self._diagnostics):
                terms.set(key, unknown.clone())
            return terms
        given = self._evaluation.kept(tensordict)
        outer = self._evaluation.begin_forward_pass()
        try:
            # The base loss draws its random numbers first: with one seed its terms stay the same.
            terms, size = self._forward_and_size(super().forward, tensordict)
            found = find_policy_term(terms.keys())
            # Updates of the policy may be delayed: its term is missing in some calls.
            delayed = found is None and find_policy_term(self.out_keys_source) is not None
            added = TensorDict() if delayed else self._terms_of("policy", given)
            own = None if found is None else terms.get(found)
            if self._relative and not delayed:
                self._make_relative(added, size, own, given)
            added.update(self._terms_of("value", given))
        finally:
            self._evaluation.end_forward_pass(outer)
        declared = self.added_terms - self._policy_side if delayed else self.added_terms
        self._check_declared(added, declared)
        if self._folded:
            self._add_penalties(terms, added)
        else:
            terms.update(added)
        if not is_compiling() and self.training and torch.is_grad_enabled():
            self._watch.see_added(self, added, own)
            self._watch.see_call(self, tensordict)
            self._watch.see_forward(self, terms)
            self._warn_of_changed_base()
        networks = (f"{name}_params" for name in self._evaluation.specs)
        self._clear_weakrefs(tensordict, terms, *networks)
        return terms

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms that train the policy, and their diagnostics.

        They are not yet multiplied by the size of the action values (:meth:`relative`).

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``actor_loss`` takes.

        Warns:
            UserWarning: once, in a direct call, if the penalty is relative.
        """
        self._check_batch_size(tensordict)
        self._watch.see_regularizer(self, of_policy=True)
        return TensorDict()

    def value_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the terms that train the value functions, and their diagnostics.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``value_loss`` takes.
        """
        self._check_batch_size(tensordict)
        self._watch.see_regularizer(self)
        return TensorDict()

    def _terms_of(self, kind: str, tensordict: TensorDictBase) -> TensorDictBase:
        """The result of :meth:`policy_regularizer` or :meth:`value_regularizer`.

        Raises:
            TypeError: it is no TensorDict.
        """
        terms = getattr(self, f"{kind}_regularizer")(tensordict)
        if not isinstance(terms, TensorDictBase):
            raise TypeError(
                f"{kind}_regularizer of {type(self).__name__} must return a TensorDict with its "
                f"terms, got {terms!r}."
            )
        return terms

    # Folding and the gain.

    def fold(self) -> RegularizedLoss:
        """Makes the penalty part of the loss's own terms.

        Policy terms are added to ``loss_actor`` or ``loss_objective``, value terms to the loss of
        their value function (``loss_qvalue``, ``loss_critic``, ...). This applies to ``forward``
        and to methods such as ``actor_loss`` and ``value_loss``. Loops that sum terms by name, or
        sum all ``loss_*`` keys, then train with the regularizer. The penalty is reported as
        ``penalty_*``, without a gradient.

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
        """Renames entries of ``out_keys``, and keeps a selection of them."""
        selected = [names.get(key, key) for key in self.out_keys]
        self.reset_out_keys()
        self.out_keys = [names.get(key, key) for key in self.out_keys]
        if selected != self.out_keys:
            self.select_out_keys(*selected)

    @property
    def folded(self) -> bool:
        """``True`` if the penalty is part of the loss's own terms."""
        return self._folded

    def ramp(self, length: float = 1.0) -> RegularizedLoss:
        r"""Makes the gain rise linearly with the progress of training.

        .. math::
            \mathtt{regularizer\_gain} = \mathtt{strength} \cdot \min(1, x / \mathtt{length})

        :meth:`set_progress` sets the progress :math:`x`. Until its first call the gain is the
        :attr:`strength`. CATS (arXiv 2610.07910) has this schedule, with ``length=1``.

        Args:
            length (float): share of training after which the gain is the strength, in (0, 1].
                Smaller values smooth earlier. Defaults to ``1.0``.

        Returns:
            The loss itself.

        Raises:
            TypeError: the length is not a real number.
            ValueError: it is out of its range.
        """
        check_real("length", length, above=0, at_most=1)
        strength = self.strength
        self._ramp = strength, float(length)
        progress = torch.tensor(-1.0, device=self._buffers[GAIN].device)
        self.register_buffer(PROGRESS, progress)
        self.regularizer_gain = strength
        return self

    def relative(self) -> RegularizedLoss:
        r"""Makes the policy terms relative to the size of the loss's own policy term.

        .. math::
            \ell_\mathrm{added} \cdot \frac1B \sum_b \lvert \ell_{\mathrm{actor}, b} \rvert

        The second factor is detached. For SAC, TD3 and DDPG it is about the mean size of the action
        values. The same gains then suit rewards of any size, and the penalty is small while the
        action values are. Without it, rewards that are ten times as large need gains ten times as
        large. TD3+BC (Fujimoto and Gu 2021, equation 5) divides the values by the same mean. It
        applies to the policy terms of all nested regularizers, and is a setting: the ``state_dict``
        does not keep it.

        While all values are 0, as before the first reward, so is the penalty. Terms of value
        functions and predictors stay as they are: the loss of a value function grows with the
        values, too. A direct call of :meth:`policy_regularizer` returns its terms before the
        multiplication. If the ``actor_loss`` of a subclass reduces several terms, the largest size
        counts.

        Returns:
            The loss itself.

        Raises:
            TypeError: the loss has no action value that trains a policy, as PPO and IQL.
            RuntimeError: in use, a method such as ``actor_loss`` is called by itself, and the
                penalty is not folded.

        Examples:
            >>> import torch
            >>> from torchrl.modules import Actor, ValueOperator
            >>> from torchrl.objectives import DDPGLoss
            >>> from torchrl_l2c2 import CATSLoss
            >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
            >>> loss = DDPGLoss(Actor(torch.nn.Linear(3, 1)), value)
            >>> loss = CATSLoss(loss, lambda_temporal=0.04).relative()
        """
        values = set(self.value_networks()) - {"critic_network"}
        if not self.policy_networks() or not values or isinstance(self, IMITATING):
            raise TypeError(
                "a penalty can be relative to action values that train a policy, as in SAC, TD3 "
                f"and DDPG, and {type(self).__name__} has none: leave relative out."
            )
        self._relative = True
        return self

    def _forward_and_size(
        self, forward: Callable[[TensorDictBase], TensorDictBase], tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, Tensor | None]:
        """The loss's own terms, and the size of its policy term if it was measured."""
        if self._relative and isinstance(self, REDQLoss):
            # It has no method for this term, which is the first that it reduces.
            terms, sizes = self._evaluation.measure(lambda: forward(tensordict))
            return terms, sizes[0]
        terms = forward(tensordict)
        assert self._evaluation.forward_pass is not None
        return terms, self._evaluation.forward_pass.policy_size

    def _make_relative(
        self,
        added: TensorDictBase,
        size: Tensor | None,
        own: Tensor | None,
        tensordict: TensorDictBase,
    ) -> None:
        """Multiplies policy terms by the size of the loss's own policy term."""
        if size is None:  # A loss that does not reduce it by _reduce_loss.
            if own is None:
                raise RuntimeError(
                    f"the penalty is relative to {', '.join(POLICY_LOSSES)}, and "
                    f"{type(self).__name__} returns none of these: give its policy's term such a "
                    "name, or make the loss with relative=False and a gain."
                )
            size = own.detach().abs().mean()
            size = size / tensordict.numel() if self._term_reduction == "sum" else size
        for key in self.policy_terms:
            if key in added.keys():
                added.set(key, added.get(key) * size)

    @property
    def strength(self) -> float:
        """Factor of all added terms but the auxiliary ones; of a ramp, its final value."""
        return self._buffers[GAIN].item() if self._ramp is None else self._ramp[0]

    @strength.setter
    def strength(self, strength: float) -> None:
        strength = as_number("strength", strength)
        check_real("strength", strength, at_least=0)
        if self._ramp is None:
            self.regularizer_gain = strength
        else:
            self._ramp = float(strength), self._ramp[1]
            self._follow_progress()

    def set_progress(self, progress: float) -> None:
        """Sets the progress of training, which sets the gain of a :meth:`ramp`.

        Call it before the updates on every rollout or episode. It has no effect on a loss without a
        ramp. It works between calls of a compiled loss. The ``state_dict`` contains the progress.

        Args:
            progress (float): completed share of training, from 0 to 1. Larger values count as 1,
                because the last rollout may exceed the total.

        Raises:
            TypeError: the progress is not a number.
            ValueError: the progress is below 0, or above 2 before any progress was made (such as a
                number of frames).

        Warns:
            UserWarning: once, if a ramp's progress rises further after it has exceeded 1.

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
        hint = "It is frames / total_frames; above 1 only if the last rollout exceeds the total."
        # An error in the middle of a training would cost more than a wrong unit.
        runs = self._watch.progress > 0 or (self._ramp is not None and self._buffers[PROGRESS] > 0)
        check_real("progress", progress, at_least=0, at_most=None if runs else 2, hint=hint)
        self._watch.see_progress(self, progress)
        if self._ramp is None:
            return
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
        if self._ramp is None:  # The checkpoint may be of a loss with a ramp.
            state_dict.pop(prefix + PROGRESS, None)
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
        """Keys of terms that train the policy or a predictor."""
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

    def _check_declared(self, added: TensorDictBase, declared: Set[str]) -> None:
        """Refuses other terms than the declared ones, which would not be trained."""
        returned = {key for key in added.keys() if key.startswith("loss_")}
        if returned != declared:
            raise ValueError(
                f"Expected the declared terms {sorted(declared)} of {type(self).__name__}, "
                f"got {sorted(returned)}. Give them the same names in declare_terms, and in "
                "policy_regularizer or value_regularizer."
            )

    def _check_batch_size(self, tensordict: TensorDictBase) -> None:
        if not tensordict.batch_dims:
            keys = (getattr(self.tensor_keys, name, name) for name in ("reward", "done"))
            check_batch_size(tensordict, keys)

    def _folded_value(self, key: str, term: Tensor) -> Tensor:
        """A term as it is added to another: an auxiliary term adds its gradient but no value."""
        return term - term.detach() if key in self.auxiliary_terms else term

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._coefficients:
            if name in NOT_SETTINGS and not callable(value):
                raise TypeError(f"{name} is a method: call loss.{name}(...) instead.")
            self._warn_of_typo(name, value)
            super().__setattr__(name, value)
            return
        try:
            number = as_number(name, value)
            check_real(name, number, at_least=0)
        except (TypeError, ValueError):
            if value is self._buffers.get(name):  # ``-=`` has already changed the buffer.
                value.detach_().copy_(self._coefficients[name])
            raise
        if name not in self._buffers:
            raise ValueError(
                f"{name} has nothing to scale: this {type(self).__name__} was made without "
                "the term. Make it with a gain above 0, which can be set to 0 later."
            )
        self._buffers[name].fill_(number)
        self._coefficients[name].fill_(number)

    def _warn_of_typo(self, name: str, value: Any) -> None:
        """Warns of a new attribute with the name of a setting, or nearly the name of a gain.

        Also of a setting of another method.
        """
        if name.startswith("_") or hasattr(self, name):
            return
        setting = name.removeprefix("l2c2_")  # Other settings with this prefix are attributes.
        setting = setting if setting in NEIGHBORHOOD_FIELDS else name
        if knobs := get_close_matches(name.lower(), KNOBS, 1, cutoff=0.85):
            warn(f"{name!r} has no effect on a {type(self).__name__}: {KNOBS[knobs[0]]}.")
            return
        gains = [gain for gain in self._coefficients if gain.endswith(f"_{name}")]
        gains = gains or get_close_matches(name, self._coefficients, 1, cutoff=0.85)
        if gains:
            warn(f"{name!r} scales nothing in a {type(self).__name__}: the gain is {gains[0]!r}.")
        elif setting in self._made_with():
            warn(
                f"{setting!r} is read when a {type(self).__name__} is made: assigning to it has no "
                f"effect. Make the loss with {setting}={value!r}."
            )
        elif absent := self._absent_method(name):
            warn(f"{name!r} has no effect on a {type(self).__name__}: it is a setting of {absent}.")

    def _absent_method(self, name: str) -> str | None:
        """The class of this package that an attribute's prefix names, if the loss is none."""
        parts = {part.__name__ for part in type(self).__mro__}
        named = (kind for method, kind in METHODS.items() if name.startswith(f"{method}_"))
        return next((kind for kind in named if kind not in parts), None)

    def _made_with(self) -> set[str]:
        """Names of the settings with which this package's regularizers are made."""
        own = (part for part in self._parts if part.__module__.startswith(__package__))
        names = {name for part in own for name in signature(part).parameters}
        return (names | NEIGHBORHOOD_FIELDS | {"method"}) - {"base_loss"}

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
        lines.append(
            f"folded={self._folded}, skip_ends={self.skip_ends}, ramp={self._ramp}, "
            f"relative={self._relative}"
        )
        return "\n".join(lines)

    # Declarations, for the __init__ of a regularizer.

    def declare_networks(self, networks: Iterable[str], *, successors: bool = True) -> None:
        """Declares the networks that the regularizer evaluates.

        Args:
            networks: names of the networks.

        Keyword Args:
            successors: whether they are also evaluated at next states.

        Raises:
            TypeError: a network is recurrent in another way than TorchRL's modules, does not
                declare its keys, or has several distributions; the loss reads no next states; or
                ``networks`` is a string.
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
        """Declares that the regularizer evaluates the policy.

        Keyword Args:
            successors: whether the policy is also evaluated at next states.

        Raises:
            TypeError: the loss has no policy, or as for :meth:`declare_networks`.
        """
        networks = self.policy_networks()
        if not networks:
            regularizer, *_, loss = (part.__name__ for part in self._parts)
            raise TypeError(f"{regularizer} needs a policy: {loss} has none.")
        self.declare_networks(networks, successors=successors)

    def declare_inputs(self, keys: Iterable[NestedKey]) -> None:
        """Declares further entries of the batch that the regularizer reads."""
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
        """Declares the keys that the two methods return, and appends them to ``out_keys``.

        Keyword Args:
            policy: ``loss_*`` keys of terms that train the policy, for ``policy_terms``.
            value: ``loss_*`` keys of terms that train only value functions.
            auxiliary: ``loss_*`` keys of terms that train networks of the regularizer, for
                ``auxiliary_terms``.
            diagnostics: keys of other entries, without the prefix ``loss_``.

        Raises:
            TypeError: an argument is a string instead of a list.
            ValueError: a key has the wrong prefix, or the loss has the key already.
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
        added, selected = [*policy, *others, *diagnostics], list(self.out_keys)
        # The base's selection of keys stays, with the added ones.
        is_selection = bool(find_selections(self))
        self.reset_out_keys()
        self.out_keys = [*self.out_keys, *added]
        if is_selection:
            self.select_out_keys(*selected, *added)
        self._diagnostics = (*self._diagnostics, *diagnostics)
        self.policy_terms = self.policy_terms.union(policy)
        self.auxiliary_terms = self.auxiliary_terms.union(auxiliary)
        self.added_terms = self.added_terms.union(policy, others)

    def register_coefficient(self, name: str, value: float, used: bool = True) -> None:
        """Registers a gain, a buffer of shape ``[]`` that can be assigned to later.

        The buffer is not persistent: the ``state_dict`` keeps the keys of the base loss.

        Args:
            name: name of the attribute.
            value: a finite number of at least 0, or a tensor with a single such number. Later
                assignments have the same range.
            used: whether the gain scales a term. If not, assigning to it is an error.

        Raises:
            TypeError: the value is not a number.
            ValueError: the value is negative or not finite, or the loss has an attribute of that
                name.
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
        """Multiplies a term by its gains and ``regularizer_gain``.

        The gains may change before ``backward``.

        Args:
            term: a reduced term.
            *names: names of registered coefficients.
            auxiliary: whether the term is auxiliary. ``regularizer_gain`` does not apply to it.
        """
        # Autograd keeps the factor, and an assignment would change it in place.
        for name in (*names, *(() if auxiliary else (GAIN,))):
            term = term * self._buffers[name].clone()
        return term

    @property
    def networks(self) -> dict[str, NetworkSpec]:
        """The inputs and outputs of the declared networks, by the network's name."""
        return self._evaluation.specs

    def policy_networks(self) -> list[str]:
        """The name of the loss's policy in a list; empty without a policy."""
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
        """Checks whether the policy is a distribution. The policy must be declared."""
        return self.networks[POLICY_NETWORK].stochastic

    def is_ensemble(self, network: str) -> bool:
        """Checks whether the loss has expanded a network to an ensemble."""
        return is_ensemble(self, network)

    # Computations, for the two methods of a regularizer.

    def transitions(
        self,
        tensordict: TensorDictBase,
        networks: Iterable[str],
        *,
        all_inputs: bool = False,
        moved_keys: Sequence[NestedKey] | None = None,
    ) -> dict[NestedKey, tuple[Tensor, Tensor]]:
        """Finds the states that networks read, and their successors.

        Inputs without a successor, such as goals, are left out.

        Args:
            tensordict: the batch, ``[*B]``.
            networks: names of declared networks.
            all_inputs: whether to include all inputs that an evaluation at the next step needs:
                also masks, other inputs that are not floating point, and recurrent states.
            moved_keys: observations to which the result is limited; recurrent states are kept.

        Returns:
            Pairs of state and successor by key, ``[*B, *F]`` each, detached.

        Raises:
            TypeError: a network reads no floating-point state.
            KeyError: no state that a network reads has a successor in the batch, or a recurrent
                state has none.
        """
        specs = {name: self.networks[name] for name in networks}
        read = {name: spec.states for name, spec in specs.items()}
        found = find_transitions(tensordict, read, all_inputs=all_inputs)
        if moved_keys is not None:
            found = {key: found[key] for key in moved_keys if key in found}
            if not any(is_floating_point(state) for state, _ in found.values()):
                raise TypeError(
                    f"moved_keys names {list(moved_keys)}, and the batch has no floating-point "
                    "observation with a successor among them: name one, or cast it."
                )
        recurrent = dict.fromkeys(key for spec in specs.values() for key in spec.recurrent)
        return {**found, **find_recurrent(tensordict, recurrent)} if all_inputs else found

    def policy_states(self, tensordict: TensorDictBase) -> dict[NestedKey, Tensor]:
        """Finds the floating-point states that the policy reads, ``[*B, *F]`` by key.

        Unlike :meth:`transitions`, it includes states without a successor, such as goals.

        Args:
            tensordict: the batch, ``[*B]``.

        Raises:
            TypeError: the policy reads no floating-point state.
        """
        read = self.networks[POLICY_NETWORK].states
        return find_states(tensordict, read, POLICY_NETWORK)

    def policies_at(
        self, tensordict: TensorDictBase, states: TensorDictBase, rows: Tensor | None = None
    ) -> tuple[Policy, Policy]:
        """Evaluates the policy at the batch's states and at other states, in one pass.

        Args:
            tensordict: the batch, ``[*B]``.
            states: the other states, ``[K, *B]``. Entries missing here are read from the batch.
            rows: indices in the flattened batch, ``[M]``, if ``states`` has only these rows,
                ``[K, M]``.

        Returns:
            The policy at the batch's states and at the other states: distributions ``[K, *B]``
            or, for a deterministic policy, actions ``[K, *B, A]``.
        """
        return self._evaluation.policies_at(self, tensordict, states, rows)

    def policy_at(
        self,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        network: str = POLICY_NETWORK,
    ) -> Policy:
        """Evaluates the policy at other states only.

        The evaluation shares no graph with any other, so its gradients can be taken immediately,
        for example in a search for states.

        Args:
            tensordict: the batch, ``[*B]``.
            states: as for :meth:`policies_at`.
            network: name of the policy, or of a copy with separate parameters.

        Returns:
            A distribution ``[K, *B]`` or, for a deterministic policy, actions ``[K, *B, A]``.
        """
        return self._evaluation.policy_at(self, tensordict, states, network)

    def values_at(
        self,
        network: str,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        rows: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Evaluates a value function at the batch's states and at other states, in one pass.

        Args:
            network: name of a declared network.
            tensordict: the batch, ``[*B]``. Action values are taken at its actions.
            states: as for :meth:`policies_at`.
            rows: as for :meth:`policies_at`.

        Returns:
            Values ``[1, *B, ...]`` and ``[K, *B, ...]``. An ensemble (:meth:`is_ensemble`) adds a
            first dimension to both.
        """
        return self._evaluation.values_at(self, network, tensordict, states, rows)

    def known_states(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """The other states, ``[K, *B]``, if the batch has them; ``None`` if they are drawn later.

        If this is the object that the regularizer passes to :meth:`policies_at` and
        :meth:`values_at`, compiled losses evaluate small batches in one pass.
        """
        return None

    def made_once(self, name: str, make: Callable[[], Made]) -> Made:
        """Caches the result of ``make()`` under a name for the forward pass."""
        if (shared := self._evaluation.forward_pass) is None:
            return make()
        if name not in shared.made:
            shared.made[name] = make()
        return shared.made[name]

    def sample_rows(self, name: str, tensordict: TensorDictBase, fraction: float) -> Tensor | None:
        """Draws a random share of a batch's rows, once per forward pass and name.

        Rows are drawn uniformly without replacement, with torch's global generator.

        Args:
            name: name of the regularizer, such as ``"caps"``.
            tensordict: the batch, ``[*B]``.
            fraction: share of the rows, in (0, 1]; rounded to whole rows, at least one.

        Returns:
            Indices ``[M]`` in the flattened batch; ``None`` for all rows.
        """
        device = self._buffers[GAIN].device
        return self.made_once(f"{name}_rows", lambda: draw_rows(tensordict, fraction, device))

    def counted(
        self,
        tensordict: TensorDictBase,
        transitions: Mapping[NestedKey, tuple[Tensor, Tensor]],
    ) -> Tensor:
        """Computes the mask of transitions that count: transitions with a known next observation.

        A next observation is unknown if an entry has no finite coordinate. With ``skip_ends``, it
        is also unknown if the transition ends an episode (for environments whose ``next`` is the
        reset state).

        Args:
            tensordict: the batch, ``[*B]``.
            transitions: states and successors of the batch, as :meth:`transitions` returns them.

        Returns:
            Booleans, ``[*B]``.
        """
        ndim, counts = tensordict.batch_dims, None
        for _, successor in transitions.values():
            if successor.is_floating_point():
                # Not flatten, which refuses entries [*B].
                size = successor.shape[ndim:].numel()
                finite = successor.isfinite().reshape(*tensordict.batch_size, size).any(-1)
                counts = finite if counts is None else counts & finite
        assert counts is not None
        self._watch.see_counts(self, counts)
        done = self._ends(tensordict)
        return counts if done is None else counts & ~done

    def _ends(self, tensordict: TensorDictBase) -> Tensor | None:
        """The mask of transitions that end an episode, ``[*B]``; ``None`` unless ``skip_ends``."""
        if not self.skip_ends:
            return None
        key = next_key(getattr(self.tensor_keys, "done", "done"))
        done = tensordict.get(key, None)
        if done is None:
            raise KeyError(f"skip_ends=True needs {key!r}, and the batch has none: keep it.")
        return done.reshape(*tensordict.batch_size, -1).any(-1)

    def reduce_term(
        self,
        value: Tensor,
        tensordict: TensorDictBase,
        *,
        rows: Tensor | None = None,
        counts: Tensor | None = None,
    ) -> Tensor:
        """Reduces a term like the loss's own terms: same reduction, masks and priority weights.

        Losses that ignore priority weights also ignore them here. ``"mean"`` is TorchRL's weighted
        mean, which does not scale with the weights; ``"sum"`` is its weighted sum.
        :class:`PPORPELoss` scales its own terms down by the weights; added terms use weights with a
        mean of 1 and keep their full gain.

        Args:
            value: the term before the reduction, ``[*B, ...]``.
            tensordict: the batch, ``[*B]``.
            rows: indices in the flattened batch, ``[M]``, if ``value`` has only these rows,
                ``[M, ...]``. They represent all rows: the expectation of the term does not change.
            counts: mask of the values that count, ``[*B]`` or ``[M]``. A mean is over these values;
                in a sum or without a reduction the others are 0.

        Returns:
            The term, ``[]``; with ``reduction="none"`` in the shape of ``value``.
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
        """The unweighted mean over the unmasked batch, detached.

        With ``reduction="none"`` these are the values; with ``rows``, the values of these rows
        multiplied by the batch's size divided by their number, and 0 in the other rows.

        The arguments are the same as for :meth:`reduce_term`.
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
            each_weight = weights
            if weights is not None and weights.shape != each.shape:  # [*B, 1], or several agents
                more = (1,) * (each.ndim - len(shape))
                each_weight = weights.reshape(*shape, *more).expand_as(each)
            mask = self._not_padded(tensordict, each.ndim)
            return self._reduce_loss(
                each, tensordict, mask=mask, weights=each_weight, reduction=reduction
            )

        if counts is None:
            return reduce(value)
        check_of_each(value.shape, counts.shape)
        counted = counts.reshape(counts.shape + (1,) * (value.ndim - counts.ndim))
        total = reduce(torch.where(counted, value, 0.0))
        if reduction != "mean":
            return total
        share = reduce(counted.expand_as(value).to(value.dtype))
        # If all count, division would change the term by rounding; by 0, its gradient is NaN.
        return total / torch.where(counts.all() | (share == 0), 1.0, share)

    def _not_padded(self, tensordict: TensorDictBase, ndim: int) -> Tensor | None:
        """``BCLoss``'s mask of actions that are no padding, or of states with such an action."""
        key = getattr(self.tensor_keys, "pad_mask", None)
        pad = None if key is None else tensordict.get(key, None)
        if pad is None:
            return None
        return ~(pad if pad.ndim <= ndim else pad.flatten(ndim).all(-1))

    def _reduce_loss(
        self, loss: Tensor, tensordict: TensorDictBase | None = None, **kwargs: Any
    ) -> Tensor:
        """As for the base loss; measures the term's size if this is asked for."""
        if (sizes := self._evaluation.sizes) is not None:
            mean = {**kwargs, "reduction": "mean"}
            size = super()._reduce_loss(loss.detach().abs(), tensordict, **mean)
            if self._term_reduction == "sum" and tensordict is not None:
                by_row = loss.shape[: tensordict.ndim] == tensordict.shape
                # Agents have a penalty each. An ensemble's networks, in front, share one.
                if not by_row or isinstance(self, REDQLoss):
                    size = size * (loss.numel() / tensordict.numel())
            sizes.append(size)
        return super()._reduce_loss(loss, tensordict, **kwargs)

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluates a network as the loss does, and caches the result for the forward pass."""
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


def listed_names(names: Iterable[str]) -> list[str]:
    """Copies names to a list; refuses a string, which would become its letters.

    Raises:
        TypeError: the names are a string.
    """
    if isinstance(names, str):
        raise TypeError(f"a list of names is wanted, got the string {names!r}: [{names!r}] is one.")
    return list(names)
