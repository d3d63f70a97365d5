"""The paper's experiment, built from the components: needs the ``experiment`` extra."""

from torchrl_l2c2.experiment.config import (
    AdamConfig,
    AdaTermConfig,
    CAPSConfig,
    DQNConfig,
    ExperimentConfig,
    L2C2Config,
    LoggerConfig,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.environments import make_env
from torchrl_l2c2.experiment.evaluate import Evaluation, evaluate_policy
from torchrl_l2c2.experiment.training import Experiment

__all__ = [
    "AdaTermConfig",
    "AdamConfig",
    "CAPSConfig",
    "DQNConfig",
    "Evaluation",
    "Experiment",
    "ExperimentConfig",
    "L2C2Config",
    "LoggerConfig",
    "NoRegularizerConfig",
    "PPOConfig",
    "PPORPEConfig",
    "PrioritizedReplayConfig",
    "RolloutReplayConfig",
    "SACConfig",
    "TD3Config",
    "TaskConfig",
    "UniformReplayConfig",
    "evaluate_policy",
    "make_env",
]
