"""The paper's experiment, built from the components: needs the ``experiment`` extra."""

import warnings

# `python -m` of a module that the package has imported itself is meant, and harmless here.
warnings.filterwarnings("ignore", ".*found in sys.modules after import of package", RuntimeWarning)

from torchrl_l2c2.experiment.config import (  # noqa: E402
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
from torchrl_l2c2.experiment.environments import make_env  # noqa: E402
from torchrl_l2c2.experiment.evaluate import Evaluation, evaluate_policy  # noqa: E402
from torchrl_l2c2.experiment.training import Experiment  # noqa: E402

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
