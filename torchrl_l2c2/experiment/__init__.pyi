from .algorithms import DQNConfig, PPOConfig, PPORPEConfig, SACConfig, TD3Config
from .collection import EpisodeCollector
from .config import ExperimentConfig, LoggerConfig
from .environments import make_env
from .evaluate import Evaluation, evaluate_policy
from .optimizers import AdamConfig, AdaTermConfig
from .regularizers import (
    ASAPConfig,
    CAPSConfig,
    CATSConfig,
    GradCAPSConfig,
    L2C2Config,
    LCPConfig,
    NoRegularizerConfig,
    SR2LConfig,
)
from .replay import PrioritizedReplayConfig, RolloutReplayConfig, UniformReplayConfig
from .tasks import FIELD_TASKS, PAPER_TASKS, TASKS, TaskConfig
from .trained import load_policy
from .training import Experiment
from .workers import MultiEpisodeCollector

__all__ = [
    "FIELD_TASKS",
    "PAPER_TASKS",
    "TASKS",
    "ASAPConfig",
    "AdaTermConfig",
    "AdamConfig",
    "CAPSConfig",
    "CATSConfig",
    "DQNConfig",
    "EpisodeCollector",
    "Evaluation",
    "Experiment",
    "ExperimentConfig",
    "GradCAPSConfig",
    "L2C2Config",
    "LCPConfig",
    "LoggerConfig",
    "MultiEpisodeCollector",
    "NoRegularizerConfig",
    "PPOConfig",
    "PPORPEConfig",
    "PrioritizedReplayConfig",
    "RolloutReplayConfig",
    "SACConfig",
    "SR2LConfig",
    "TD3Config",
    "TaskConfig",
    "UniformReplayConfig",
    "evaluate_policy",
    "load_policy",
    "make_env",
]
