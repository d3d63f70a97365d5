"""The errors that a command shows in one line, and how a command ends with one.

Every other error is a bug, of this package or of a user's own code, and shows its traceback.
"""

from __future__ import annotations

import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any


class UserError(ValueError):
    """A mistake of the user; the text says what to do."""


class OtherRunError(UserError):
    """A checkpoint is of a run with other settings."""


class MissingPackageError(UserError, ImportError):
    """A package of an extra is not installed."""


class SimulatorError(RuntimeError):
    """The environment or the policy in it raised an error; the cause is chained."""


class CompilerError(RuntimeError):
    """The compiler failed, perhaps because a signal ended it; the text has its reason."""


# What fails outside of the program: a simulator, a process, the numbers of a training, a disk.
OUTSIDE = (SimulatorError, CompilerError, FloatingPointError, OSError)
# PyTorch has no class for a lack of CPU memory.
NO_MEMORY = ("DefaultCPUAllocator: can't allocate memory", "Storage size calculation overflowed")


def is_lack_of_memory(error: BaseException) -> bool:
    """Recognizes a lack of memory, on the CPU or on a GPU."""
    torch = sys.modules.get("torch")  # Without it, nothing of its kind can be raised.
    if isinstance(error, (MemoryError, torch.OutOfMemoryError) if torch else MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(text in str(error) for text in NO_MEMORY)


def is_told_in_a_line(error: BaseException) -> bool:
    """Tells mistakes of the user and failures from outside from bugs."""
    return isinstance(error, (UserError, *OUTSIDE)) or is_lack_of_memory(error)


def raised_by_component(error: BaseException) -> bool:
    """Tells a refusal by a component of this package from an error in other code."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    module = frame.f_globals.get("__name__", "")
    experiment = __name__.rpartition(".")[0]
    package = experiment.partition(".")[0]
    return module.startswith(f"{package}.") and not module.startswith(f"{experiment}.")


def show_cause(error: Exception) -> None:
    """Prints where a user's own environment or policy failed; nothing for other errors."""
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
    except Exception as error:
        if not is_told_in_a_line(error):
            raise
        show_cause(error)
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        print("interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
