"""The terms and gains that regularizers say they add to a loss."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from torchrl_l2c2._checks import as_number, check_real
from torchrl_l2c2.objectives.mixin import LossMixin


def listed_names(names: Iterable[str]) -> list[str]:
    """A list of names; a string alone would be its letters.

    Raises:
        TypeError: it is a string.
    """
    if isinstance(names, str):
        raise TypeError(f"a list of names is wanted, got the string {names!r}: [{names!r}] is one.")
    return list(names)


class DeclaredTerms(LossMixin):
    """Knows which of a loss's terms were added to it, and the gains that scale these.

    Attributes:
        policy_terms (frozenset of str): the ``loss_*`` keys of all regularizers applied that train
            the policy.
        auxiliary_terms (frozenset of str): those that train networks of the regularizers' own.
        added_terms (frozenset of str): all ``loss_*`` keys of all regularizers applied.
    """

    policy_terms: frozenset[str] = frozenset()
    auxiliary_terms: frozenset[str] = frozenset()
    added_terms: frozenset[str] = frozenset()
    # Their last values; tensors, as they are shared where the gains are.
    _coefficients: Mapping[str, Tensor] = MappingProxyType({})
    out_keys: list[str]

    def __setattr__(self, name: str, value: Any) -> None:
        if name not in self._coefficients:
            self._tell_gains_like(name)
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

    def _tell_gains_like(self, name: str) -> None:
        """Warns of a new attribute that has the end of a gain's name, as constructors do."""
        gains = [gain for gain in self._coefficients if gain.endswith(f"_{name}")]
        if gains and not hasattr(self, name):
            warnings.warn(
                f"{name!r} scales nothing in a {type(self).__name__}: the gain is {gains[0]!r}.",
                stacklevel=3,
            )

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

    def scaled(self, term: Tensor, name: str) -> Tensor:
        """A term times a gain, which may be assigned to before the term's backward pass.

        Args:
            term: what is scaled.
            name: of a registered coefficient.
        """
        # Autograd keeps the factor, and an assignment writes into the gain itself.
        return term * self._buffers[name].clone()
