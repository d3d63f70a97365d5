"""Ctrl-C and SIGTERM: the first lets the episode end and is saved, a second one acts at once."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from torchrl_l2c2.experiment.errors import CompilerError

# Terminals and launchers send one signal to a process several times: to it, and to its group.
SAME_SIGNAL_SECONDS = 1.0
# What ended, or was to end, what went before a training: libraries swallow exceptions in places.
_heard: list[int] = []
FINISHING = "finishing the episode, then saving"


class Interrupted(Exception):
    """A signal ended the training; a checkpoint was written."""

    def __init__(self, signal_number: int, episode: int, folder: Path | None) -> None:
        name = signal.Signals(signal_number).name
        super().__init__(
            f"{name} ended the training after episode {episode}; the same command continues it "
            f"from {folder}."
        )
        self.signal_number = signal_number


class Terminated(KeyboardInterrupt):
    """SIGTERM, where it ends what is being done as Ctrl-C does."""


def terminate(number: int, frame: Any) -> NoReturn:
    """A handler that lets what is being done end in order."""
    _heard.append(number)
    raise Terminated


@contextlib.contextmanager
def stop_on_signals() -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list instead of dying; a second one acts as usual.

    A signal to all processes of a job also ends compilers.

    Raises:
        KeyboardInterrupt: a compiler failed after a signal.
    """
    received = list(_heard)
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    first = 0.0

    def receive(number: int, frame: Any) -> None:
        nonlocal first
        if not received:
            first = time.monotonic()
            received.append(number)
            print(f"\n{FINISHING}; once more: at once", file=sys.stderr, flush=True)
        elif time.monotonic() - first > SAME_SIGNAL_SECONDS:
            restore()
            signal.raise_signal(number)

    previous = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    for number in previous:
        signal.signal(number, receive)
    try:
        yield received
    except CompilerError as error:
        if not received:
            raise
        raise Terminated if received[0] == signal.SIGTERM else KeyboardInterrupt from error
    finally:
        restore()


def keep_ctrl_c_from_children() -> None:
    """Has this process alone hear Ctrl-C, which a terminal sends to all processes that it started.

    Compilers, workers and jobs that are born from now on are deaf to it: they end their work, and
    this process ends them. For a command's first lines, before there are other threads.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return
    main = threading.main_thread().ident
    assert main is not None

    def as_ctrl_c(number: int, frame: Any) -> None:
        handler = signal.getsignal(signal.SIGINT)
        if handler is signal.default_int_handler:
            _heard.append(signal.SIGINT)
        if callable(handler):
            handler(signal.SIGINT, frame)

    def listen() -> None:
        while True:
            signal.sigwait({signal.SIGINT})
            # Another signal, which wakes the main thread even while it waits for a compiler.
            signal.pthread_kill(main, signal.SIGUSR1)

    signal.signal(signal.SIGUSR1, as_ctrl_c)
    # What is blocked here is blocked in every thread and process that comes from here.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    threading.Thread(target=listen, daemon=True).start()
