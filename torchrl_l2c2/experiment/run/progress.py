"""What a run shows while it trains, and keeps in ``train.log``."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from tqdm import tqdm

from torchrl_l2c2.experiment.run.files import append_line

LINE_SECONDS = 60.0


def log(folder: Path | None, line: str) -> None:
    """Adds a line, with the time, to the ``train.log`` of a run's folder.

    Raises:
        OSError: names the file.
    """
    if folder is not None and folder.is_dir():
        append_line(folder / "train.log", f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n")


def say(folder: Path | None, line: str) -> None:
    """Shows a line, above a bar where there is one, and logs it."""
    tqdm.write(line, file=sys.stderr)
    sys.stderr.flush()
    log(folder, line)


class Progress:
    """A bar over the episodes or frames of a run, with what episodes were like lately.

    Where there is no terminal it is lines, at each tenth of the run or a minute after the last one;
    ``train.log`` has them in any case.

    Args:
        total (int): episodes or frames in all.
        done (int): those of an earlier call.
        frames (int): frames of an earlier call.

    Keyword Args:
        shown (bool or str): whether there is a bar, or lines; a text goes before them.
        compiles (bool): whether the first updates wait for a compiler.
        unit (str): what is counted, ``"episode"`` or ``"frame"``. Default ``"episode"``.
        folder (Path, optional): of the run.
    """

    def __init__(
        self,
        total: int,
        done: int,
        frames: int,
        *,
        shown: bool | str,
        compiles: bool,
        unit: str = "episode",
        folder: Path | None = None,
    ) -> None:
        self._total, self._folder, self._shown, self._unit = total, folder, bool(shown), unit
        name = shown if isinstance(shown, str) else ""
        self._started, self._first_frame = time.monotonic(), frames
        self._last_line = self._started
        self._waiting = compiles
        # tqdm leaves the bar out where there is no terminal.
        disable = None if shown else True
        self._bar = tqdm(desc=name, total=total, initial=done, unit=unit, disable=disable)
        self._name = f"{name}; " if name else ""
        self._column = {"episode": "episode", "frame": "frames"}[unit]
        self._done: float = done
        if self._waiting:
            self._say("compiling at the first updates, up to two minutes")

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.close()

    def frames_per_second(self, frames: int) -> float:
        """Frames a second since this call began."""
        return (frames - self._first_frame) / (time.monotonic() - self._started)

    def show(self, rows: Sequence[dict[str, float]], first_update_seconds: float | None) -> None:
        """Counts an episode; its metrics are the last row."""
        before, self._done = self._done, rows[-1][self._column]
        self._bar.update(self._done - before)
        if self._waiting and first_update_seconds is not None:
            self._waiting = False
            self._say(f"compiled within {first_update_seconds:.0f} s")
        lately = rows[-10:]
        means = [statistics.fmean(r[key] for r in lately) for key in ("return", "action_variation")]
        state = (
            f"mean of the last {len(lately)} episodes: return {means[0]:.1f}, "
            f"action variation {means[1]:.3f}, "
            f"{rows[-1]['frames_per_second']:.0f} frames/s"
        )
        self._bar.set_postfix_str(state)
        # A last rollout may go on far beyond the end.
        tenth = min(self._done * 10 // self._total, 10) > before * 10 // self._total
        if tenth or time.monotonic() - self._last_line > LINE_SECONDS:
            self._last_line = time.monotonic()
            line = f"{self._name}{self._unit} {self._done:g} of {self._total}: {state}"
            if self._bar.disable:
                self._say(line)
            else:
                log(self._folder, line)

    def _say(self, line: str) -> None:
        (say if self._shown else log)(self._folder, line)
