from .analysis.diagnosis import diagnose, diagnose_actions, findings, write_page
from .collect.episodes import EpisodeCollector
from .envs.environments import make_env
from .run.evaluation import Evaluation, evaluate_policy
from .run.experiment import Experiment
from .run.policies import load_policy
from .settings.algorithms import PPOConfig, PPORPEConfig, SACConfig, TD3Config
from .settings.config import ExperimentConfig, LoggerConfig
from .settings.optimizers import AdamConfig, AdaTermConfig
from .settings.regularizers import (
    ASAPConfig,
    CAPSConfig,
    CATSConfig,
    GradCAPSConfig,
    L2C2Config,
    LCPConfig,
    NoRegularizerConfig,
    SR2LConfig,
)
from .settings.replay import PrioritizedReplayConfig, RolloutReplayConfig, UniformReplayConfig
from .settings.tasks import FIELD_TASKS, PAPER_TASKS, TASKS, TaskConfig

__all__ = [
    "FIELD_TASKS",
    "PAPER_TASKS",
    "TASKS",
    "ASAPConfig",
    "AdaTermConfig",
    "AdamConfig",
    "CAPSConfig",
    "CATSConfig",
    "EpisodeCollector",
    "Evaluation",
    "Experiment",
    "ExperimentConfig",
    "GradCAPSConfig",
    "L2C2Config",
    "LCPConfig",
    "LoggerConfig",
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
    "diagnose",
    "diagnose_actions",
    "evaluate_policy",
    "findings",
    "load_policy",
    "make_env",
    "write_page",
]
