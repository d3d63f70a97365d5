"""The precision in which a regularizer's networks are evaluated."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext

import torch
from tensordict import TensorDictBase
from torch import Tensor


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


def as_parameters(rows: TensorDictBase, parameters: Iterable[Tensor]) -> TensorDictBase:
    """Inputs in the precision of the parameters, where autocast would have brought both to one."""
    if autocast_at(rows) is None:
        return rows
    # A list: a generator that is left halfway does not compile.
    dtypes = [p.dtype for p in parameters if p.is_floating_point()]
    # Autocast leaves double precision alone, too.
    wanted = {torch.float16, torch.bfloat16, torch.float32}
    return rows.apply(lambda v: v.to(dtypes[0]) if dtypes and v.dtype in wanted else v)
