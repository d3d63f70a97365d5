"""What a loss can inherit beside the class of a loss, without losing that class's ``forward``."""

from __future__ import annotations

from typing import Any

from torchrl.objectives import LossModule


class _WithoutCopies(type(LossModule)):  # type: ignore[misc]
    """TorchRL's metaclass gives every class a forward of its own, which would hide the loss's."""

    def __init__(cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any]) -> None:
        super().__init__(name, bases, namespace)
        if "forward" not in namespace:
            del cls.forward


class LossMixin(LossModule, metaclass=_WithoutCopies):
    """A part of losses: ``forward`` is that of the first class that defines one."""
