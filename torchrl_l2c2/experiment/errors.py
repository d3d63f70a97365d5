"""Errors that say by themselves what was wrong, and how a command ends with one."""

from __future__ import annotations

import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


class OtherRunError(ValueError):
    """A checkpoint is of a run with other settings."""


class SimulatorError(RuntimeError):
    """The environment or the policy in it raised an error; the cause is chained."""


# Anything else is a fault of the program.
EXPECTED = (
    ValueError, OSError, RuntimeError, FloatingPointError, OverflowError, ImportError, MemoryError,
)  # fmt: skip


def show_cause(error: Exception) -> None:
    """Prints where a user's own environment failed; of other errors nothing."""
    if isinstance(error, SimulatorError) and error.__cause__ is not None:
        traceback.print_exception(error.__cause__)


@contextmanager
def warnings_told(tell: Callable[[str], Any]) -> Iterator[None]:
    """Warnings are lines like others, without where in the program they come from.

    Args:
        tell (callable): what a line is given to.
    """

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        tell(f"warning: {message}")

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


@contextmanager
def told_in_a_line() -> Iterator[None]:
    """Ends a command with one line where what went wrong says so by itself, or Ctrl-C ends it.

    Warnings are lines, too.

    Raises:
        SystemExit: with that line.
    """
    try:
        with warnings_told(partial(print, file=sys.stderr)):
            yield
    except EXPECTED as error:
        show_cause(error)
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
