"""What a run shows while it trains."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Sequence
from types import TracebackType

from tqdm import tqdm


class Progress:
    """A bar over the episodes or frames of a run, with what episodes were like lately.

    Args:
        total (int): episodes or frames in all.
        done (int): those of an earlier call.
        frames (int): frames of an earlier call.

    Keyword Args:
        shown (bool): whether there is a bar.
        compiles (bool): whether the first updates wait for a compiler.
        unit (str): what is counted, ``"episode"`` or ``"frame"``. Default ``"episode"``.
    """

    def __init__(
        self,
        total: int,
        done: int,
        frames: int,
        *,
        shown: bool,
        compiles: bool,
        unit: str = "episode",
    ) -> None:
        self._started, self._first_frame = time.monotonic(), frames
        self._waiting = shown and compiles
        self._bar = tqdm(total=total, initial=done, unit=unit, disable=not shown)
        self._column = {"episode": "episode", "frame": "frames"}[unit]
        self._done: float = done
        if self._waiting:
            self._bar.set_postfix_str("compiling at the first updates, up to two minutes")

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
        self._bar.update(rows[-1][self._column] - self._done)
        self._done = rows[-1][self._column]
        if self._waiting and first_update_seconds is not None:
            self._waiting = False
            self._bar.write(f"compiled within {first_update_seconds:.0f} s", sys.stderr)
        lately = rows[-10:]
        means = [statistics.fmean(r[key] for r in lately) for key in ("return", "action_variation")]
        self._bar.set_postfix_str(
            f"return {means[0]:.1f}, action variation {means[1]:.3f}, "
            f"{rows[-1]['frames_per_second']:.0f} frames/s"
        )
