"""Ctrl-C and SIGTERM: the first finishes the episode and saves, the second ends at once."""

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

# Terminals and launchers may send the same signal to a process and to its group.
SAME_SIGNAL_SECONDS = 1.0
# Signals before training: some libraries swallow the exception that should end the process.
_early_signals: list[int] = []
FINISHING = "finishing the episode, then saving"


class Interrupted(Exception):
    """A signal ended the training after an episode, with a checkpoint if there is a folder."""

    def __init__(self, signal_number: int, episode: int, folder: Path | None) -> None:
        name = signal.Signals(signal_number).name
        then = f"the same command continues it from {folder}."
        if folder is None:
            then = "nothing was saved, because the experiment has no folder. train() continues it."
        super().__init__(f"{name} ended the training after episode {episode}; {then}")
        self.signal_number = signal_number


class Terminated(KeyboardInterrupt):
    """SIGTERM, with the effect of Ctrl-C."""


def terminate(number: int, frame: Any) -> NoReturn:
    """Signal handler that ends the process in order, with an exception."""
    _early_signals.append(number)
    raise Terminated


@contextlib.contextmanager
def stop_on_signals(*, saves: bool = True) -> Iterator[list[int]]:
    """Collects SIGTERM and SIGINT in a list; a second signal has its usual effect.

    A signal to all processes of a job also ends compilers. Their failures after a signal count as
    an interruption.

    Keyword Args:
        saves (bool): Whether the message promises a checkpoint. Default ``True``.

    Yields:
        list: Numbers of the received signals.

    Raises:
        KeyboardInterrupt: If a compiler fails after a signal.
    """
    received = list(_early_signals)
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    first = 0.0

    def receive(number: int, frame: Any) -> None:
        nonlocal first
        if not received:
            first = time.monotonic()
            received.append(number)
            told = FINISHING if saves else "finishing the episode"
            print(f"\n{told}; a second signal ends at once", file=sys.stderr, flush=True)
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
    """Blocks Ctrl-C in all later child processes: only this process receives it.

    Terminals send Ctrl-C to all processes. Compilers and jobs then finish their work, and this
    process ends them. Call it first, before other threads start.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return
    main = threading.main_thread().ident
    assert main is not None

    def as_ctrl_c(number: int, frame: Any) -> None:
        handler = signal.getsignal(signal.SIGINT)
        if handler is signal.default_int_handler:
            _early_signals.append(signal.SIGINT)
        if callable(handler):
            handler(signal.SIGINT, frame)

    def listen() -> None:
        while True:
            signal.sigwait({signal.SIGINT})
            # Another signal wakes the main thread even while it waits for a compiler.
            signal.pthread_kill(main, signal.SIGUSR1)
            # Repetitions, such as to a process and to its group, are dropped here: the main thread
            # may handle them much later.
            time.sleep(SAME_SIGNAL_SECONDS)
            if signal.SIGINT in signal.sigpending():
                signal.sigwait({signal.SIGINT})

    signal.signal(signal.SIGUSR1, as_ctrl_c)
    # All later threads and processes inherit the blocked signal.
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    threading.Thread(target=listen, daemon=True).start()
