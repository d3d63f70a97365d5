"""What a signal does to what is being done."""

import os
import signal

import pytest

from torchrl_l2c2.experiment.command import _tell
from torchrl_l2c2.experiment.errors import EXPECTED
from torchrl_l2c2.experiment.signals import Terminated, stop_on_signals


@pytest.mark.parametrize(
    ("number", "ended"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)]
)
def test_what_fails_after_a_signal_to_all_processes_was_ended_by_it(number, ended):
    """A compiler, or a worker, that heard it as well: the run can go on, and a sweep ends."""
    before = signal.getsignal(number)
    with pytest.raises(KeyboardInterrupt) as told, stop_on_signals() as received:
        os.kill(os.getpid(), number)
        assert received == [number]
        raise RuntimeError("g++ was killed")
    assert type(told.value) is ended and "g++" in str(told.value.__cause__)
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("error", [OSError("no space left"), FloatingPointError("NaN")])
def test_other_failures_are_told_with_or_without_one(error):
    """A checkpoint that could not be written is not the signal's doing."""
    with pytest.raises(type(error), match=str(error)), stop_on_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        raise error
    with pytest.raises(RuntimeError, match="its own"), stop_on_signals():
        raise RuntimeError("its own")


@pytest.mark.parametrize("error", [MemoryError("std::bad_alloc"), RuntimeError("cannot allocate")])
def test_what_takes_too_much_memory_is_told_with_what_takes_less(error):
    """As 1e15 transitions do, which a component alone finds."""
    assert isinstance(error, EXPECTED) and "choose smaller algorithm.hidden, repl" in _tell(error)


def test_an_error_without_a_text_has_its_name():
    """Which a sweep keeps a line of."""
    assert _tell(AssertionError()) == "AssertionError"
