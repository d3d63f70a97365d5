"""Ctrl-C and SIGTERM: the first lets the episode end and is saved, a second one acts at once."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class Interrupted(Exception):
    """A signal ended the training; a checkpoint was written."""

    def __init__(self, signal_number: int, episode: int, folder: Path | None) -> None:
        name = signal.Signals(signal_number).name
        super().__init__(
            f"{name} ended the training after episode {episode}; the same command continues it "
            f"from {folder}."
        )
        self.exit_status = 128 + signal_number


@contextlib.contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list instead of dying; a second one acts as usual."""
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def receive(number: int, frame: Any) -> None:
        received.append(number)
        restore()

    previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    for number in previous:
        signal.signal(number, receive)
    try:
        yield received
    finally:
        restore()
