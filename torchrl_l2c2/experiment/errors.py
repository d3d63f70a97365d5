"""Errors that a command shows in one line.

Every other error is a bug in this package or in a user's own code, and is shown with its traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


class UserError(ValueError):
    """A mistake of the user. The message states what to do."""


class OtherRunError(UserError):
    """A checkpoint belongs to a run with other settings."""


class MissingPackageError(UserError, ImportError):
    """A package of an optional extra is not installed."""


def how_to_install(extra: str) -> str:
    """Tells how to install an extra of this package, which is not on PyPI.

    Examples:
        >>> how_to_install("video")
        'In a clone of the repository, run: pip install -e ".[video]"'
    """
    return f'In a clone of the repository, run: pip install -e ".[{extra}]"'


class SimulatorError(RuntimeError):
    """An error in the environment or its policy. The original error is chained."""


class CompilerError(RuntimeError):
    """The compiler failed or was ended by a signal. The message states the reason."""


# Failures outside of the program: a simulator, a compiler, non-finite numbers, a disk.
OUTSIDE = (SimulatorError, CompilerError, FloatingPointError, OSError)
# PyTorch has no class for a lack of CPU memory.
NO_MEMORY = ("DefaultCPUAllocator: can't allocate memory", "Storage size calculation overflowed")


def is_lack_of_memory(error: BaseException) -> bool:
    """Checks whether memory ran out, on the CPU or on a GPU."""
    torch = sys.modules.get("torch")  # Its errors exist only if it has been imported.
    if isinstance(error, (MemoryError, torch.OutOfMemoryError) if torch else MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in NO_MEMORY)


def is_one_line_error(error: BaseException) -> bool:
    """Checks whether an error is a user's mistake or an outside failure, not a bug."""
    return isinstance(error, (UserError, *OUTSIDE)) or is_lack_of_memory(error)


def show_cause(error: Exception) -> None:
    """Prints the traceback of a user's own environment or policy. Ignores other errors."""
    if isinstance(error, SimulatorError) and error.__cause__ is not None:
        traceback.print_exception(error.__cause__)


@contextmanager
def warnings_as_lines(log: Callable[[str], Any]) -> Iterator[None]:
    """Passes warnings to a function as plain lines, without file and line number, each once.

    Args:
        log (callable): Function that receives each line.
    """
    shown: set[str] = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        # Python shows a warning again after every change of its filters.
        if (line := f"warning: {message}") not in shown:
            shown.add(line)
            log(line)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def allow_closed_output() -> Iterator[None]:
    """Exits without a traceback if the output is closed, as in ``--help | head``."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        # Python flushes the output again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


@contextmanager
def one_line_errors() -> Iterator[None]:
    """Ends a command with one line after a user's mistake, an outside failure or Ctrl-C.

    Warnings are also shown in one line. Bugs keep their traceback.

    Raises:
        SystemExit: With the error's line, or with status 130 after Ctrl-C.
    """
    try:
        with allow_closed_output(), warnings_as_lines(partial(print, file=sys.stderr)):
            yield
    except Exception as error:
        if not is_one_line_error(error):
            raise
        show_cause(error)
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
