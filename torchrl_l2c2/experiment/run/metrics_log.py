"""Logging of training metrics to metrics.csv and other loggers."""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_l2c2.experiment.errors import OtherRunError, UserError, how_to_install
from torchrl_l2c2.experiment.run.files import append_line, write_atomically
from torchrl_l2c2.experiment.settings.fields import SettingError

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger

PROJECT = "torchrl_l2c2"
# The user's value, read early: MLflow changes the variable later.
TRACKING_URI = os.environ.get("MLFLOW_TRACKING_URI")
# Packages that are not part of the experiment extra.
PACKAGES = {"wandb": "wandb", "mlflow": "mlflow"}


class MetricsLog:
    """Writes metrics to ``metrics.csv`` and another logger. Lines are complete if killed.

    Args:
        folder (Path, optional): Folder of ``metrics.csv`` and the logger's files. ``None``: nothing
            is written.

    Keyword Args:
        logger (str): Name of the logger, as for
            :func:`~torchrl_l2c2.experiment.run.metrics_log.make_logger`. Default ``"csv"``.
    """

    def __init__(self, folder: Path | None, *, logger: str = "csv") -> None:
        self.path = None if folder is None else folder / "metrics.csv"
        self.columns: list[str] | None = None
        self._size = 0  # Size of the file after the last write.
        self._name = logger
        self._logger = None if folder is None else make_logger(logger, folder)

    def close(self) -> None:
        """Closes the logger."""
        if self._logger is not None:
            self._logger = None
            close_logger(self._name)

    def write(self, row: Mapping[str, float]) -> None:
        """Appends a row. The first row determines the columns.

        Args:
            row (Mapping): Metrics by name, including ``"frames"``, the step of other loggers.

        Raises:
            ValueError: If the names differ from the first row's.
        """
        if self.path is None:
            return
        if self.columns is None:
            self.columns = list(row)
            write_atomically(self.path, _line(self.columns).encode())
            self._size = self.path.stat().st_size
        if list(row) != self.columns:
            raise ValueError(f"expected the metrics {self.columns}, got {list(row)}.")
        append_line(self.path, _line(row.values()))
        self._size = self.path.stat().st_size
        if self._logger is not None:
            for name, value in row.items():
                self._logger.log_scalar(name, value, step=int(row["frames"]))

    def check_unchanged(self) -> None:
        """Checks that no other object has written to the file.

        Raises:
            OtherRunError: If the file is missing, or its size has changed.
        """
        if self.path is None:
            return
        if self._size and not self.path.exists():
            raise OtherRunError(
                f"{self.path}, which this run has written, is missing: restore the folder, or "
                "create a new Experiment, which starts again."
            )
        size = self.path.stat().st_size if self.path.exists() else 0
        if size != self._size:
            raise OtherRunError(
                f"{self.path} has {size} bytes, but {self._size} after this run's last write: "
                "another Experiment has written to the folder. Create a new Experiment, which "
                "continues from there."
            )

    def state_dict(self) -> dict[str, Any]:
        """Returns the columns, and the size and the hash of the file."""
        content = b"" if self.path is None or self.columns is None else self.path.read_bytes()
        found = _sha256(content[: self._size])
        return {"columns": self.columns, "size": self._size, "sha256": found}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a state and removes later lines from the file.

        Raises:
            ValueError: If the file is shorter than in the state, or its content has changed.
        """
        self.columns = state["columns"]
        if self.path is None or self.columns is None:
            return
        content = self.path.read_bytes() if self.path.exists() else b""
        written = content[: state["size"]]
        # Spreadsheet programs may change line ends or the format of numbers.
        found = _sha256(written)
        # Older checkpoints have no hash.
        if len(written) < state["size"] or found != state.get("sha256", found):
            raise UserError(
                f"the beginning of {self.path} ({state['size']} bytes) is not as it was at the "
                "checkpoint. Restore it, or choose another folder."
            )
        os.truncate(self.path, state["size"])
        self._size = state["size"]


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _line(cells: Iterable[object]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow(cells)
    return line.getvalue()


def check_installed(name: str) -> None:
    """Checks that the package of a logger is installed.

    Raises:
        SettingError: If the package is missing.
    """
    package = PACKAGES.get(name)
    if package is not None and find_spec(package) is None:
        raise SettingError(
            "logger.name",
            f"{name!r} needs the package {package}, which is not installed. Use csv or "
            f"tensorboard, or install it. {how_to_install(name)}",
        )


def make_logger(name: str, folder: Path) -> Logger | None:
    """Creates a TorchRL logger.

    Weights & Biases and MLflow read environment variables such as ``WANDB_MODE=offline`` and
    ``MLFLOW_TRACKING_URI``. Without the latter, MLflow writes to the run folder.

    Args:
        name (str): ``"csv"``, ``"tensorboard"``, ``"wandb"`` or ``"mlflow"``.
        folder (Path): Run folder. The last five parts of its path are the run's name.

    Returns:
        Logger: TorchRL's logger; ``None`` for ``"csv"``, which every run writes anyway.
    """
    run = "/".join(folder.absolute().parts[-5:])
    if name == "tensorboard":
        from torchrl.record.loggers.tensorboard import TensorboardLogger

        return TensorboardLogger("tensorboard", log_dir=str(folder))
    if name == "wandb":
        from torchrl.record.loggers.wandb import WandbLogger

        # The same id for the same folder: a continued run also continues in W&B.
        identity = hashlib.sha256(str(folder.absolute()).encode()).hexdigest()[:16]
        return WandbLogger(
            run, project=PROJECT, save_dir=str(folder), id=identity, log_env_packages=False
        )
    if name == "mlflow":
        from torchrl.record.loggers.mlflow import MLFlowLogger

        # MLflow requires this for files without a database.
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
        local = (folder.absolute() / "mlruns").as_uri()
        return MLFlowLogger(run, TRACKING_URI or local)
    return None


def close_logger(name: str) -> None:
    """Ends the logger's run in this process, before the next run."""
    if name == "wandb":
        import wandb

        wandb.finish()
    if name == "mlflow":
        import mlflow

        mlflow.end_run()
