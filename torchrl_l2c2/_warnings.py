"""Warnings that point to the user's code."""

from __future__ import annotations

import sys
import warnings

_INNER = {"contextlib", "tensordict", "torch", "torchrl", "torchrl_l2c2"}


def warn(message: str) -> None:
    """Warns at the innermost line outside torch, TensorDict, TorchRL and this package."""
    frame, level = sys._getframe(1), 2
    while frame.f_globals.get("__name__", "").partition(".")[0] in _INNER:
        if frame.f_back is None:  # As in a thread of TorchRL's.
            level = 2
            break
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
