"""Progress bar and log of a run."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from torchrl_l2c2.experiment.run.files import append_line

LINE_SECONDS = 60.0


def log(folder: Path | None, line: str) -> None:
    """Appends a line with the time to ``train.log`` in a run's folder.

    Raises:
        OSError: If the file cannot be written.
    """
    if folder is not None and folder.is_dir():
        append_line(folder / "train.log", f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n")


def show_and_log(folder: Path | None, line: str) -> None:
    """Shows a line on stderr, above a progress bar, and logs it."""
    tqdm.write(line, file=sys.stderr)
    sys.stderr.flush()
    log(folder, line)


class Progress:
    """Progress bar of a run, with the mean metrics of the last 10 episodes.

    Without a terminal, it shows a line at each tenth of the run, or a minute after the last line.
    ``train.log`` always has these lines.

    Args:
        total (int): Total number of episodes or frames.
        done (int): Number of episodes or frames of earlier calls.
        frames (int): Number of frames of earlier calls.

    Keyword Args:
        shown (bool or str): Whether to show the bar or lines; a text is shown before them.
        compiles (bool): Whether the first updates are compiled.
        unit (str): Unit of ``total`` and ``done``, ``"episode"`` or ``"frame"``.
        folder (Path, optional): Run folder, for ``train.log``. ``None``: nothing is logged.
    """

    def __init__(
        self,
        total: int,
        done: int,
        frames: int,
        *,
        shown: bool | str,
        compiles: bool,
        unit: str,
        folder: Path | None,
    ) -> None:
        self._total, self._folder, self._shown, self._unit = total, folder, bool(shown), unit
        name = shown if isinstance(shown, str) else ""
        self._started, self._first_frame = time.monotonic(), frames
        self._last_line = self._started
        self._waiting = compiles
        # None: tqdm shows no bar without a terminal.
        disable = None if shown else True
        self._bar = tqdm(desc=name, total=total, initial=done, unit=unit, disable=disable)
        self._name = f"{name}; " if name else ""
        self._column = {"episode": "episode", "frame": "frames"}[unit]
        self._done: float = done
        if self._waiting:
            self._report("compiling at the first updates, up to two minutes")

    def close(self) -> None:
        """Closes the bar."""
        self._bar.close()

    def frames_per_second(self, frames: int) -> float:
        """Returns the frames per second of this call."""
        return (frames - self._first_frame) / (time.monotonic() - self._started)

    def show(self, rows: Sequence[dict[str, float]], first_update_seconds: float | None) -> None:
        """Updates the progress after an episode.

        Args:
            rows (sequence of dict): Metrics of all episodes.
            first_update_seconds (float, optional): Duration of the first update, or ``None`` before
                it.
        """
        before, self._done = self._done, rows[-1][self._column]
        self._bar.update(self._done - before)
        if self._waiting and first_update_seconds is not None:
            self._waiting = False
            self._report(f"compiled within {first_update_seconds:.0f} s")
        last = rows[-10:]
        means = [statistics.fmean(r[key] for r in last) for key in ("return", "action_variation")]
        state = (
            f"mean of the last {len(last)} episodes: return {means[0]:.1f}, "
            f"action variation {means[1]:.3f}, "
            f"{rows[-1]['frames_per_second']:.0f} frames/s"
        )
        self._bar.set_postfix_str(state)
        # The last rollout may exceed the total.
        tenth = min(self._done * 10 // self._total, 10) > before * 10 // self._total
        if tenth or time.monotonic() - self._last_line > LINE_SECONDS:
            self._last_line = time.monotonic()
            line = f"{self._name}{self._unit} {self._done:g} of {self._total}: {state}"
            if self._bar.disable:
                self._report(line)
            else:
                log(self._folder, line)

    def _report(self, line: str) -> None:
        (show_and_log if self._shown else log)(self._folder, line)
