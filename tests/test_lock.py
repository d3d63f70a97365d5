"""One process writes a run's folder, another one is told who does."""

import re
import subprocess
import sys
import threading
import time

import pytest

from torchrl_l2c2.experiment.run.lock import FolderInUseError, lock_folder, wait_for_folder

CONTENDER = """
import sys
from pathlib import Path
from torchrl_l2c2.experiment.run.lock import FolderInUseError, lock_folder
class Run: pass
run, folder = Run(), Path(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
try:
    lock_folder(folder, run)
    print("taken", flush=True)
except FolderInUseError as error:
    print(error, flush=True)
sys.stdin.readline()
"""


class Run:
    pass


def contender(folder):
    pipe = subprocess.PIPE
    process = subprocess.Popen(
        [sys.executable, "-c", CONTENDER, folder], stdin=pipe, stdout=pipe, text=True
    )
    assert process.stdout.readline() == "ready\n"
    return process


def go(process):
    process.stdin.write("\n")
    process.stdin.flush()


@pytest.mark.parametrize("tries", [5, pytest.param(50, marks=pytest.mark.slow)])
def test_of_two_processes_one_has_the_folder_and_the_other_is_told_which(tmp_path, tries):
    """Started at the same time; what a killed one held is free for the next pair."""
    for _ in range(tries):
        pair = [contender(tmp_path) for _ in range(2)]
        for process in pair:
            go(process)
        said = {process.pid: process.stdout.readline() for process in pair}
        (holder,) = (pid for pid, line in said.items() if line == "taken\n")
        (refusal,) = (line for line in said.values() if line != "taken\n")
        assert re.search(
            rf"in use by process {holder} on \S+ since 20\d\d-\d\d-\d\d \d\d:", refusal
        )
        for process in pair:
            process.kill()
            process.communicate()


def test_a_folder_is_given_back_with_its_holder(tmp_path):
    """By a call or by being collected; the one process may have several."""
    first, second = Run(), Run()
    release = lock_folder(tmp_path, first)
    lock_folder(tmp_path, second)
    release()
    other = contender(tmp_path)
    go(other)
    assert "in use by process" in other.stdout.readline()
    other.communicate("\n")
    del second
    other = contender(tmp_path)
    go(other)
    assert other.stdout.readline() == "taken\n"
    with pytest.raises(FolderInUseError, match=f"process {other.pid} "):
        lock_folder(tmp_path, first)
    other.communicate("\n")


def test_a_folder_is_waited_for_till_its_process_ends(tmp_path):
    """And no longer than asked."""
    wait_for_folder(tmp_path / "none yet", 60)
    process = contender(tmp_path)
    go(process)
    assert process.stdout.readline() == "taken\n"
    begun = time.monotonic()
    wait_for_folder(tmp_path, 0.3)
    assert 0.3 <= time.monotonic() - begun < 10
    with pytest.raises(FolderInUseError):
        lock_folder(tmp_path, Run())
    threading.Timer(0.3, process.kill).start()
    wait_for_folder(tmp_path, 60)
    assert time.monotonic() - begun < 30
    run = Run()
    lock_folder(tmp_path, run)
    process.communicate()
