"""Rows against other libraries, each in a process of its own, by the clock and by the processor."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from benchmarks.setups import Effort
from benchmarks.timing import Row
from torchrl_l2c2.experiment import PAPER_TASKS

HERE = Path(__file__).parent
CLOCKS = ("wall", "CPU")


def peer_rows(effort: Effort) -> Iterable[Row]:
    """Whole training by other libraries, on the same task, networks and batches."""
    steps = min(512, effort.steps)
    settings = {
        "env_id": PAPER_TASKS["swingup"].env_id,
        "frames": steps,
        "turn": 4 * steps,
        "compile": effort.compile,
    }
    how: dict[str, Any] = {"rounds": max(1, effort.rounds // 3), "python": effort.peer_python}
    for layer, batch in ((100, 32), (256, 256)):
        same = {**settings, "layers": [layer, layer], "batch": batch}
        what = f"SAC here / SBX SAC, layers of {layer}, batch {batch}"
        yield from against(what, "sac", "sbx sac", same, at_most=0.9, **how)
        what = f"TD3 here / SBX TD3, layers of {layer}, batch {batch}"
        yield from against(what, "td3", "sbx td3", same, **how)
    same = {**settings, "layers": [100, 100], "batch": 32}
    what = "L2C2 here / Stable-Baselines3 SAC without it, layers of 100, batch 32"
    yield from against(what, "paper", "sb3 sac", same, at_most=0.25, **how)
    same = {**settings, "layers": [64, 64], "batch": 64}
    what = "PPO here / Stable-Baselines3 PPO, layers of 64, batch 64"
    yield from against(what, "ppo", "sb3 ppo", same, at_most=0.4, **how)
    what = "PPO here / SBX PPO, layers of 64, batch 64"
    yield from against(what, "ppo", "sbx ppo", same, **how)


class Peer:
    """A process of ``benchmarks/peer.py``.

    Args:
        name (str): what trains.
        settings (dict): as the process takes them.
        python (str): the interpreter that can import the named library.

    Attributes:
        note: why it does not train; empty if it does.
    """

    def __init__(self, name: str, settings: dict[str, Any], python: str) -> None:
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(
            [python, str(HERE / "peer.py"), name, json.dumps(settings)],
            stdin=pipe,
            stdout=pipe,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=HERE.parent,
        )
        answer = self._answer()
        failed = f"not measured: benchmarks/peer.py {name!r} ended; run it by itself to see why"
        self.note = "" if answer == "ready" else answer or failed

    def turn(self) -> list[float]:
        """Seconds of one turn, by each of ``CLOCKS``."""
        assert self._process.stdin is not None
        print("go", file=self._process.stdin, flush=True)
        return json.loads(self._answer())

    def close(self) -> None:
        """Lets the process end."""
        self._process.communicate()

    def _answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()


def against(
    what: str,
    ours: str,
    peer: str,
    settings: dict[str, Any],
    *,
    rounds: int,
    at_most: float | None = None,
    python: str = sys.executable,
) -> Iterable[Row]:
    """Time per frame here by a peer's, in turns; a row for each clock.

    Args:
        what (str): name of the rows.
        ours (str): what trains here.
        peer (str): what trains there.
        settings (dict): Settings of both.

    Keyword Args:
        rounds (int): turns of each.
        at_most (float, optional): the limit; none by default.
        python (str): the peer's interpreter. Default: this one.
    """
    both = [Peer(ours, settings, sys.executable), Peer(peer, settings, python)]
    note = next((each.note for each in both if each.note), "")
    turns = [] if note else [[each.turn() for each in both] for _ in range(rounds)]
    for each in both:
        each.close()
    for column, clock in enumerate(CLOCKS):
        row = Row("peers", f"{what}, {clock} time per frame", at_most=at_most, note=note)
        if turns:
            us = [
                1e6 * statistics.median(turn[side][column] for turn in turns) / settings["turn"]
                for side in (0, 1)
            ]
            row.value, row.parts = us[0] / us[1], {"ours us": us[0], "theirs us": us[1]}
        yield row
