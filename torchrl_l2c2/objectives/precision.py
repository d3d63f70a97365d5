"""The precision in which a regularizer's networks are evaluated."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import torch
from tensordict import TensorDictBase


def autocast_at(tensordict: TensorDictBase) -> str | None:
    """The kind of device of these entries, such as ``"cuda"``, if autocast is on there."""
    kinds = {value.device.type for value in tensordict.values(True, True)}
    return next((kind for kind in kinds if torch.is_autocast_enabled(kind)), None)


def in_full_precision(tensordict: TensorDictBase) -> AbstractContextManager[object]:
    """A context without autocast on the device of these entries.

    A regularizer compares outputs at states that lie close together. bfloat16 keeps 8 bits of
    each, so that of a difference of 1 % little is left and of one of 0.1 % nothing but rounding,
    whose square is larger than that of the difference.
    """
    kind = autocast_at(tensordict)
    return nullcontext() if kind is None else torch.autocast(kind, enabled=False)
