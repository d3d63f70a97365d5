"""Checks of settings, such as a real number in a range, and of a regularizer's input."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor
from torch.compiler import is_compiling


def check_positive_int(name: str, value: Any) -> None:
    """Checks for an integer of at least 1, also NumPy's; ``True`` is no integer.

    Raises:
        TypeError: it is not an integer.
        ValueError: it is below 1.
    """
    if not isinstance(value, Integral) or isinstance(value, bool):
        raise TypeError(f"{name} must be an integer, got {value!r} ({type(value).__name__}).")
    if value < 1:
        raise ValueError(f"{name} must be at least 1, got {value!r}.")


def as_number(name: str, value: Any) -> Any:
    """Converts a tensor of one number to that number; returns everything else unchanged.

    Raises:
        TypeError: the tensor has several numbers, or a gradient, which would be lost.
    """
    if not isinstance(value, Tensor):
        return value
    if value.numel() != 1 or value.requires_grad:
        what = "one with a gradient: detach it" if value.numel() == 1 else tuple(value.shape)
        raise TypeError(f"{name} must be a single number, or a tensor of one, got {what}.")
    return value.item()


def check_real(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
    finite: bool = True,
    hint: str = "",
) -> None:
    """Checks for a real number within bounds; ``True`` is no number, NaN is never within.

    Args:
        name: the value's name in the message.
        value: the value to check.
        above: lower bound, exclusive.
        at_least: lower bound, inclusive.
        below: upper bound, exclusive.
        at_most: upper bound, inclusive.
        finite: whether infinity is an error.
        hint: advice, a sentence that ends the message.

    Raises:
        TypeError: it is not a real number.
        ValueError: it is not finite or not within the bounds.
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} must be a real number, got {value!r} ({type(value).__name__}).")
    number = float(value)
    inside = (
        (above is None or number > above)
        and (at_least is None or number >= at_least)
        and (below is None or number < below)
        and (at_most is None or number <= at_most)
        and not math.isnan(number)
        and (not finite or math.isfinite(number))
    )
    if not inside:
        allowed = _range(above, at_least, below, at_most, finite)
        raise ValueError(f"{name} must be {allowed}, got {value!r}.{hint and ' ' + hint}")


def check_bool(name: str, value: Any) -> None:
    """Checks for ``True`` or ``False``; ``"false"`` would count as true.

    Raises:
        TypeError: it is neither.
    """
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be True or False, got {value!r} ({type(value).__name__}).")


def check_choice(name: str, value: Any, allowed: Sequence[str], *, hint: str = "") -> None:
    """Checks for one of the allowed strings.

    Args:
        name: the value's name in the message.
        value: the value to check.
        allowed: the allowed strings.
        hint: advice, a sentence that ends the message.

    Raises:
        TypeError: it is not a string.
        ValueError: it is not an allowed string.
    """
    listed = " or ".join(map(repr, allowed))
    if not isinstance(value, str):
        raise TypeError(
            f"{name} must be {listed}, got {value!r} ({type(value).__name__}).{hint and ' ' + hint}"
        )
    if value not in allowed:
        raise ValueError(f"{name} must be {listed}, got {value!r}.{hint and ' ' + hint}")


def _range(
    above: float | None,
    at_least: float | None,
    below: float | None,
    at_most: float | None,
    finite: bool,
) -> str:
    low, high = (above if at_least is None else at_least), (below if at_most is None else at_most)
    if low is None:
        return "finite"
    if high is not None:
        brackets = "(" if at_least is None else "[", ")" if at_most is None else "]"
        return f"in {brackets[0]}{low:.4g}, {high:.4g}{brackets[1]}"
    bound = f"greater than {low:.4g}" if at_least is None else f"at least {low:.4g}"
    return f"finite and {bound}" if finite else bound


def read_key(name: str, key: NestedKey) -> NestedKey:
    """Flattens an entry's name.

    Raises:
        TypeError: it is not a name.
    """
    if isinstance(key, str) or (isinstance(key, tuple) and key):
        return unravel_key(key)
    raise TypeError(f"{name} must be a string or a tuple of strings, got {key!r}.")


def check_of_each(shape: Sequence[int], batch: Sequence[int]) -> None:
    """Checks that a network without a last dimension has not summed over the batch.

    Raises:
        ValueError: the shape does not begin with the batch's shape.
    """
    if tuple(shape[: len(batch)]) != tuple(batch):
        raise ValueError(
            f"a regularizer compares each of the {tuple(batch)} states by itself, got differences "
            f"of shape {tuple(shape)}: give what the network writes a last dimension, "
            "of 1 for a value or an action of one number."
        )


def check_takes_gradients(regularizer: str) -> None:
    """Checks that inference mode is off, for regularizers that take their own gradients.

    Raises:
        RuntimeError: torch keeps no gradients in this mode.
    """
    if not is_compiling() and torch.is_inference_mode_enabled():
        raise RuntimeError(
            f"{regularizer} takes gradients of its own, of which torch.inference_mode keeps "
            "none: validate under torch.no_grad()."
        )


def describe_no_loss(given: object) -> str:
    """Describes an argument that is no loss, and what to do.

    Examples:
        >>> from torchrl_l2c2._checks import describe_no_loss
        >>> describe_no_loss(dict), describe_no_loss(1)
        ('the class dict: make the loss first, dict(...)', 'a int')
    """
    if isinstance(given, type):
        return f"the class {given.__name__}: make the loss first, {given.__name__}(...)"
    hint = ""
    if isinstance(given, torch.nn.Module):
        is_compiled = type(given).__name__ == "OptimizedModule"
        compiled = ", before it is compiled" if is_compiled else ""
        hint = f". Regularize the loss, such as SACLoss(policy, ...){compiled}"
    return f"a {type(given).__name__}{hint}"
