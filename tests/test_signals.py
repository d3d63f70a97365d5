"""What a signal does to what is being done."""

import os
import signal
import subprocess
import sys

import pytest

from torchrl_l2c2.experiment.errors import CompilerError, SimulatorError
from torchrl_l2c2.experiment.run.signals import Terminated, stop_on_signals


@pytest.mark.parametrize(
    ("number", "ended"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)]
)
def test_what_fails_after_a_signal_to_all_processes_was_ended_by_it(number, ended):
    """A compiler that received it as well: the run can be continued, and a sweep ends."""
    before, error = signal.getsignal(number), CompilerError("g++ was killed")
    with pytest.raises(KeyboardInterrupt) as raised, stop_on_signals() as received:
        os.kill(os.getpid(), number)
        assert received == [number]
        raise error
    assert type(raised.value) is ended and raised.value.__cause__ is error
    assert signal.getsignal(number) == before


@pytest.mark.parametrize(
    "error",
    [
        OSError("no space left"),
        FloatingPointError("NaN"),
        RuntimeError("a bug"),
        SimulatorError("the task's own"),
    ],
)
def test_other_failures_stay_what_they_are_after_a_signal(error):
    """A bug, or a checkpoint that could not be written, is not the signal's doing."""
    with pytest.raises(type(error), match=str(error)), stop_on_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        raise error


def test_a_compiler_that_fails_without_a_signal_is_told():
    """Nobody wanted the run to end."""
    with pytest.raises(CompilerError, match="no compiler"), stop_on_signals():
        raise CompilerError("no compiler")


CTRL_C = """
import os, signal, time
from torchrl_l2c2.experiment.run.signals import keep_ctrl_c_from_children
keep_ctrl_c_from_children()
received = []
signal.signal(signal.SIGUSR1, lambda *_: received.append(time.monotonic()))
for pause in (0.2, 0.2, 2.5, 0.5):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(pause)
print(len(received))
"""


def test_ctrl_c_that_is_repeated_within_a_second_is_one():
    """As of a program that sends it to a process and to its group; the fourth is another one."""
    command = [sys.executable, "-c", CTRL_C]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=100)
    assert done.stdout == "2\n"
