"""Folding of penalties into a loss's own terms."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Container, Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.compiler import is_compiling

from torchrl_l2c2.gains import ALTERNATIVE_LOSSES

POLICY_LOSSES = ("loss_actor", "loss_objective", "loss_bc")
"""Keys of the term that trains the policy."""

# The loss of a value function, by the name of its network; longer names first.
VALUE_LOSSES = {
    "local_value": ("loss",),
    "qvalue": ("loss_qvalue",),
    "critic": ("loss_critic", "loss_value"),
    "value": ("loss_value", "loss", "loss_qvalue"),
}

# Methods that loops call instead of forward: the network they train, and the key of their result.
PARTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "actor_loss": ("policy", POLICY_LOSSES),
    "loss_actor": ("policy", POLICY_LOSSES),
    "actor_bc_loss": ("policy", ALTERNATIVE_LOSSES),
    "value_loss": ("value", ("loss_value", "loss_qvalue")),
    "loss_value": ("value", ("loss_value",)),
    "loss_critic": ("value", ("loss_critic", "loss_value")),
    "qvalue_loss": ("value", ("loss_qvalue",)),
    "qvalue_v1_loss": ("value", ("loss_qvalue",)),
    "qvalue_v2_loss": ("value", ("loss_qvalue",)),
    "q_loss": ("value", ("loss_qvalue",)),
}


def find_policy_term(keys: Container[str]) -> str | None:
    """Finds the term that trains the policy among a loss's keys; ``None``: there is none.

    Examples:
        >>> from torchrl_l2c2.objectives._fold import find_policy_term
        >>> find_policy_term(["loss_qvalue", "loss_actor"])
        'loss_actor'
    """
    return next((key for key in (*POLICY_LOSSES, *ALTERNATIVE_LOSSES) if key in keys), None)


def fold_targets(term: str, trains_policy: bool, own: Iterable[str]) -> list[str]:
    """Finds the loss's own terms to which a penalty is added.

    Args:
        term: key of the penalty, such as ``"loss_l2c2_qvalue"``, which ends with its network.
        trains_policy: whether the penalty trains the policy.
        own: keys of the loss's own output.

    Raises:
        TypeError: there is no such term, or the choice is ambiguous.

    Examples:
        >>> from torchrl_l2c2.objectives._fold import fold_targets
        >>> fold_targets("loss_caps_spatial", True, ["loss_objective", "loss_critic"])
        ['loss_objective']
        >>> fold_targets("loss_l2c2_critic", False, ["loss_objective", "loss_critic"])
        ['loss_critic']
    """
    own = [key for key in own if isinstance(key, str)]
    if trains_policy:
        found = [key for key in own if key in POLICY_LOSSES][:1]
        found += [key for key in own if key in ALTERNATIVE_LOSSES]
    else:
        network = next((name for name in VALUE_LOSSES if term.endswith(f"_{name}")), None)
        every = dict.fromkeys(key for keys in VALUE_LOSSES.values() for key in keys)
        wanted = every if network is None else VALUE_LOSSES[network]
        found = [key for key in wanted if key in own]
        found = found if network is None else found[:1]
        if network is None and len(found) > 1:
            raise TypeError(
                f"{term!r} may belong to {found}: end its name with the network's name, such as "
                f"{term}_qvalue, or use fold=False and add it in the training loop."
            )
    if not found:
        losses = [key for key in own if key.startswith("loss")]
        raise TypeError(
            f"the loss has no term that {term!r} can be added to, but {losses}: use fold=False, "
            "and add it in the training loop."
        )
    return found


def add_penalty(own: Tensor, penalty: Tensor, key: str) -> Tensor:
    """Adds a penalty to a loss's own term.

    Raises:
        ValueError: without a reduction, the shapes differ.
    """
    if own.ndim == penalty.ndim + 1 and own.shape[-1] == 1 and penalty.ndim:
        penalty = penalty.unsqueeze(-1)
    if penalty.ndim and own.shape != penalty.shape:
        raise ValueError(
            f"{key} has the shape {tuple(own.shape)} and its penalty {tuple(penalty.shape)}: use a "
            "loss with reduction='mean', or fold=False."
        )
    return own + penalty.to(own.dtype)


def make_part(
    method: Callable[..., Any], kind: str, targets: tuple[str, ...]
) -> Callable[..., Any]:
    """Wraps a method such as ``actor_loss`` to include a folded penalty.

    Args:
        method: method of the loss's class.
        kind: ``"policy"`` or ``"value"``.
        targets: possible keys of the term that the method returns; the first key that the loss has
            is used.
    """
    is_measured = targets is POLICY_LOSSES  # Dynamo would compare copies.
    name = list(inspect.signature(method).parameters)[1]

    def measured(self: Any, *args: Any, **kwargs: Any) -> tuple[Any, Tensor | None]:
        """The method's result, and the size of the action values if the penalty is relative."""
        if not (self._relative and is_measured):
            return method(self, *args, **kwargs), None
        out, sizes = self._evaluation.measure(lambda: method(self, *args, **kwargs))
        # A subclass may reduce other terms than the action values, before or after these.
        return out, functools.reduce(torch.maximum, sizes) if sizes else None

    def with_penalty(self: Any, out: Any, size: Tensor | None, tensordict: TensorDictBase) -> Any:
        value, *rest = out if isinstance(out, tuple) else (out,)
        metadata = rest[0] if rest and hasattr(rest[0], "update") else {}
        own = [key for key in self.out_keys_source if key.startswith("loss")] or list(targets)
        returned = next((key for key in targets if key in own), None)
        if self._relative and kind == "policy" and not is_measured:
            raise RuntimeError(
                f"{method.__name__} has no action values to which the penalty is relative: call "
                "loss(batch) instead, or make the loss with relative=False and a gain."
            )
        added = self._terms_of(kind, tensordict)
        if kind == "policy" and not is_compiling() and self.training:
            self._watch.see_added(self, added, value)
        if self._relative and kind == "policy":
            self._make_relative(added, size, value, tensordict)
        for key, term in list(added.items()):
            if key not in self.added_terms:
                metadata[key] = term
            elif returned in fold_targets(key, kind == "policy", own):
                if value.ndim and not term.ndim and self._term_reduction == "sum":
                    term = term / value.numel()  # The loop sums the unreduced values.
                value = add_penalty(value, self._folded_value(key, term), str(returned))
                metadata[penalty_key(key)] = term.detach()
        return (value, *rest) if isinstance(out, tuple) else value

    @functools.wraps(method)
    def part(self: Any, *args: Any, **kwargs: Any) -> Any:
        # Within forward, or another part, the penalty is added there.
        if (shared := self._evaluation.forward_pass) is not None:
            out, size = measured(self, *args, **kwargs)
            if self._relative and is_measured and size is None and shared.policy_size is None:
                # The mean of absolute values, as where the method is called by itself.
                value = out[0] if isinstance(out, tuple) else out
                size = value.detach().abs().mean() if value.ndim else None
            shared.policy_size = shared.policy_size if size is None else size
            return out
        if not torch.is_grad_enabled():
            return method(self, *args, **kwargs)
        given = args[0] if args else kwargs.get(name)
        if given is None:
            raise TypeError(f"{method.__name__} takes a batch as {name!r}, and none was given.")
        tensordict = self._evaluation.kept(given)
        self._evaluation.begin_forward_pass()
        try:
            out, size = measured(self, *args, **kwargs)
            if kind == "policy" and not is_compiling() and self.training:
                self._watch.see_call(self, given)
                self._warn_of_changed_base()
            if self.folded:
                return with_penalty(self, out, size, tensordict)
            if size is not None:
                raise RuntimeError(
                    f"{method.__name__} leaves out the penalty, and policy_regularizer would not "
                    "make it relative to this term: call loss.fold() first, or call loss(batch), "
                    "which returns the penalty as a term of its own."
                )
            self._watch.see_part(self, kind)
            return out
        finally:
            self._evaluation.end_forward_pass(None)

    return part


def penalty_key(term: str) -> str:
    """The key under which a folded term is reported.

    Examples:
        >>> from torchrl_l2c2.objectives._fold import penalty_key
        >>> penalty_key("loss_l2c2_actor")
        'penalty_l2c2_actor'
    """
    return "penalty_" + term.removeprefix("loss_")
