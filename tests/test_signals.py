"""What a signal does to what is being done."""

import os
import signal

import pytest

from torchrl_l2c2.experiment.errors import ChildFailedError, SimulatorError
from torchrl_l2c2.experiment.run.signals import Terminated, stop_on_signals


@pytest.mark.parametrize(
    ("number", "ended"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)]
)
def test_what_fails_after_a_signal_to_all_processes_was_ended_by_it(number, ended):
    """A compiler, or a worker, that heard it as well: the run can go on, and a sweep ends."""
    before = signal.getsignal(number)
    killed = ChildFailedError("g++ was killed")
    played = SimulatorError("after frame 3")
    played.__cause__ = killed  # a worker, while episodes were played
    for error in (killed, played):
        with pytest.raises(KeyboardInterrupt) as told, stop_on_signals() as received:
            os.kill(os.getpid(), number)
            assert received == [number]
            raise error
        assert type(told.value) is ended and told.value.__cause__ is error
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
    with pytest.raises(ChildFailedError, match="no compiler"), stop_on_signals():
        raise ChildFailedError("no compiler")
