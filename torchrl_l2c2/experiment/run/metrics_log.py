"""A run's metrics while it is trained: metrics.csv, and what a logger writes."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_l2c2.experiment.errors import OtherRunError, UserError
from torchrl_l2c2.experiment.run.files import append_line, write_atomically
from torchrl_l2c2.experiment.settings.fields import SettingError

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger

PROJECT = "torchrl_l2c2"
# The user's value: MLflow itself changes the variable later.
TRACKING_URI = os.environ.get("MLFLOW_TRACKING_URI")
# Packages that are not part of the experiment extra.
PACKAGES = {"wandb": "wandb", "mlflow": "mlflow"}


class MetricsLog:
    """Writes rows of numbers; a killed process leaves no half of a line.

    Args:
        folder (Path, optional): where ``metrics.csv`` goes, and what the logger writes; ``None``
            writes nothing.
        logger (str): one of :func:`~torchrl_l2c2.experiment.run.metrics_log.make_logger`.
    """

    def __init__(self, folder: Path | None, *, logger: str = "csv") -> None:
        self.path = None if folder is None else folder / "metrics.csv"
        self.columns: list[str] | None = None
        self._size = 0  # of the file, as it was left here
        self._name = logger
        self._logger = None if folder is None else make_logger(logger, folder)

    def close(self) -> None:
        """Ends what the logger has open."""
        if self._logger is not None:
            self._logger = None
            close_logger(self._name)

    def write(self, row: Mapping[str, float]) -> None:
        """Adds one line; the first line fixes the columns.

        Raises:
            ValueError: the row's names differ from the first row's.
        """
        if self.path is None:
            return
        if self.columns is None:
            self.columns = list(row)
            write_atomically(self.path, _line(self.columns).encode())
            self._size = self.path.stat().st_size
        if list(row) != self.columns:
            raise ValueError(f"the metrics changed from {self.columns} to {list(row)}.")
        append_line(self.path, _line(row.values()))
        self._size = self.path.stat().st_size
        if self._logger is not None:
            for name, value in row.items():
                self._logger.log_scalar(name, value, step=int(row["frames"]))

    def check_unchanged(self) -> None:
        """Refuses to continue if another object has written to the file.

        Raises:
            OtherRunError: the file is not as long as it was left.
        """
        size = self.path.stat().st_size if self.path is not None and self.path.exists() else 0
        if size != self._size:
            raise OtherRunError(
                f"{self.path} has {size} bytes, and had {self._size} when this run last wrote to "
                "it: another Experiment has written to its folder. Make a new one, which "
                "continues from there."
            )

    def state_dict(self) -> dict[str, Any]:
        """Columns and size of the file."""
        return {"columns": self.columns, "size": self._size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Removes lines that were written after the state was taken; no line appears twice.

        Raises:
            ValueError: the file is shorter than it was, or another.
        """
        self.columns = state["columns"]
        if self.path is None or self.columns is None:
            return
        content = self.path.read_bytes() if self.path.exists() else b""
        written = content[: state["size"]]
        # Programs for tables write the lines' ends, or the numbers, in a way of their own.
        whole = written.startswith(_line(self.columns).encode()) and written.endswith(b"\n")
        if len(written) < state["size"] or not whole:
            raise UserError(
                f"{self.path} has {len(content)} bytes and is not what the checkpoint was taken "
                f"with, of {state['size']}: it was changed since. Restore it, or choose another "
                "folder."
            )
        os.truncate(self.path, state["size"])
        self._size = state["size"]


def _line(cells: Iterable[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def check_installed(name: str) -> None:
    """Refuses a logger whose package is missing.

    Raises:
        SettingError: says how to install it.
    """
    package = PACKAGES.get(name)
    if package is not None and find_spec(package) is None:
        raise SettingError(
            "logger.name",
            f"{name!r} needs the package {package}, which is not installed: "
            f'pip install "torchrl-l2c2[{name}]", or use csv or tensorboard.',
        )


def make_logger(name: str, folder: Path) -> Logger | None:
    """TorchRL's logger of a name; ``None`` for ``csv``, which every run writes by itself.

    Weights & Biases and MLflow read their own environment variables, such as ``WANDB_MODE=offline``
    and ``MLFLOW_TRACKING_URI``. Without one, MLflow writes into the folder.

    Args:
        name (str): ``"csv"``, ``"tensorboard"``, ``"wandb"`` or ``"mlflow"``.
        folder (Path): The run's folder; its last parts are the run's name in the logger.
    """
    run = "/".join(folder.absolute().parts[-5:])
    if name == "tensorboard":
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        return TensorboardLogger("tensorboard", log_dir=str(folder))
    if name == "wandb":
        from torchrl.record.loggers.wandb import WandbLogger

        # The same for the same folder: a continued run is continued there.
        identity = hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:16]
        return WandbLogger(
            run, project=PROJECT, save_dir=str(folder), id=identity, log_env_packages=False
        )
    if name == "mlflow":
        from torchrl.record.loggers.mlflow import MLFlowLogger

        # MLflow asks for this before it writes files that need no database.
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        inside = (folder.absolute() / "mlruns").as_uri()
        return MLFlowLogger(run, TRACKING_URI or inside)
    return None


def close_logger(name: str) -> None:
    """Closes the logger's package in this process, for the next run."""
    if name == "wandb":
        import wandb

        wandb.finish()
    if name == "mlflow":
        import mlflow

        mlflow.end_run()
