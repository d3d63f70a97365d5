"""TorchRL's loggers, each with what it needs to write a run's metrics."""

from __future__ import annotations

import hashlib
import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_l2c2.experiment.settings import SettingError

if TYPE_CHECKING:
    from torchrl.record.loggers import Logger

PROJECT = "torchrl_l2c2"
# As the user has it: MLflow itself sets the variable to what it was told last.
TRACKING_URI = os.environ.get("MLFLOW_TRACKING_URI")
# What is no part of the experiment extra.
PACKAGES = {"wandb": "wandb", "mlflow": "mlflow"}


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

    Weights & Biases and MLflow are told where to by their own environment variables, such as
    ``WANDB_MODE=offline`` and ``MLFLOW_TRACKING_URI``; MLflow without one writes into the folder.

    Args:
        name (str): ``"csv"``, ``"tensorboard"``, ``"wandb"`` or ``"mlflow"``.
        folder (Path): of the run, whose last parts are the run's name there.
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
    """Ends what the logger's package keeps open in the process, so that another run can begin."""
    if name == "wandb":
        import wandb

        wandb.finish()
    if name == "mlflow":
        import mlflow

        mlflow.end_run()
