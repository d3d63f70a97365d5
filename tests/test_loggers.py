"""Weights & Biases and MLflow get the metrics of every episode, without a network."""

import math
from importlib.util import find_spec

import pytest

from torchrl_l2c2.experiment import Experiment, ExperimentConfig, TaskConfig
from torchrl_l2c2.experiment.settings.config import GROUPS
from torchrl_l2c2.experiment.settings.fields import SettingError

TASK = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=40)


def trained(folder, logger):
    config = ExperimentConfig(task=TASK, compile=False, logger=GROUPS["logger"][logger])
    experiment = Experiment(config, folder)
    experiment.train()
    experiment.close()
    return experiment.metrics


def test_mlflow_has_every_episode(tmp_path, monkeypatch):
    """With the number of frames as the step; a second run in the process is one of its own."""
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setattr("torchrl_l2c2.experiment.run.metrics_log.TRACKING_URI", None)
    trained(tmp_path / "other", "mlflow")
    rows = trained(tmp_path / "run", "mlflow")
    client = mlflow.MlflowClient((tmp_path / "run" / "mlruns").as_uri())
    (experiment,) = (e for e in client.search_experiments() if e.name != "Default")
    (run,) = client.search_runs([experiment.experiment_id])
    history = client.get_metric_history(run.info.run_id, "return")
    assert [(m.step, m.value) for m in history] == [(r["frames"], r["return"]) for r in rows]


def test_wandb_has_every_episode(tmp_path, monkeypatch):
    """Offline, in files of the run's folder."""
    wandb = pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    logged = []
    finished = wandb.sdk.wandb_run.Run.log
    monkeypatch.setattr(
        wandb.sdk.wandb_run.Run,
        "log",
        lambda run, data, *rest, **more: (logged.append(data), finished(run, data, *rest, **more)),
    )
    rows = trained(tmp_path, "wandb")
    returns = [value for data in logged for name, value in data.items() if name == "return"]
    assert returns == [row["return"] for row in rows] and not any(map(math.isnan, returns))
    assert list(tmp_path.rglob("*.wandb"))


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_refused_with_what_to_do(tmp_path, monkeypatch, name):
    """Before there is a folder."""
    monkeypatch.setattr(
        "torchrl_l2c2.experiment.run.metrics_log.find_spec",
        lambda package: None if package == name else find_spec(package),
    )
    with pytest.raises(SettingError, match=rf"logger.name '{name}' needs .*\.\[{name}\]"):
        trained(tmp_path / "run", name)
    assert not list(tmp_path.iterdir())
