"""A run's metrics: a CSV file with one line per episode and, on request, TensorBoard."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl.record.loggers.tensorboard import TensorboardLogger


class MetricsLog:
    """Writes rows of numbers; a killed process leaves no half of a line.

    Args:
        folder (Path, optional): where ``metrics.csv`` (and the ``tensorboard`` folder) go;
            ``None`` writes nothing.
        tensorboard (bool): whether to write TensorBoard events as well.
    """

    def __init__(self, folder: Path | None, *, tensorboard: bool) -> None:
        self.path = None if folder is None else folder / "metrics.csv"
        self.columns: list[str] | None = None
        self._tensorboard = None
        if folder is not None and tensorboard:
            self._tensorboard = TensorboardLogger("tensorboard", log_dir=str(folder))

    def write(self, row: Mapping[str, float]) -> None:
        """Adds one line; the first line fixes the columns.

        Raises:
            ValueError: the row's names differ from the first row's.
        """
        if self.path is None:
            return
        if self.columns is None:
            self.columns = list(row)
            self._write(self.columns, "wb")
        if list(row) != self.columns:
            raise ValueError(f"the metrics changed from {self.columns} to {list(row)}.")
        self._write(row.values(), "ab")
        if self._tensorboard is not None:
            for name, value in row.items():
                self._tensorboard.log_scalar(name, value, step=int(row["frames"]))

    def state_dict(self) -> dict[str, Any]:
        """How far the file goes."""
        size = self.path.stat().st_size if self.columns is not None else 0
        return {"columns": self.columns, "size": size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Cuts off what was written after the state was taken, so that no line comes twice.

        Raises:
            ValueError: the file is shorter than it was.
        """
        self.columns = state["columns"]
        if self.path is None or self.columns is None:
            return
        size = self.path.stat().st_size if self.path.exists() else 0
        if size < state["size"]:
            raise ValueError(
                f"{self.path} has {size} bytes, the checkpoint was taken at {state['size']}: it "
                "was changed since. Restore it, or choose another folder with outputs=FOLDER."
            )
        os.truncate(self.path, state["size"])

    def _write(self, cells: Any, mode: str) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow(cells)
        # Unbuffered: one call of the system writes the whole line.
        with open(self.path, mode, buffering=0) as file:
            file.write(line.getvalue().encode())
