"""Warnings that point to the user's code."""

from __future__ import annotations

import inspect
import warnings

_INNER = {"contextlib", "tensordict", "torch", "torchrl", "torchrl_l2c2"}


def warn(message: str) -> None:
    """Warns at the innermost line outside torch, TensorDict, TorchRL and this package."""
    frame, level = inspect.currentframe(), 1
    while frame is not None and _package(frame.f_globals) in _INNER:
        frame, level = frame.f_back, level + 1
    # A thread of TorchRL's has no frame of the user's.
    warnings.warn(message, stacklevel=2 if frame is None else level)


def _package(names: dict[str, object]) -> str:
    return str(names.get("__name__", "")).partition(".")[0]
