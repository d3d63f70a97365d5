"""What learns: a file for each algorithm, and a line here for each choice."""

from torchrl_l2c2.experiment.algorithms.base import AlgorithmConfig
from torchrl_l2c2.experiment.algorithms.dqn import DQNConfig
from torchrl_l2c2.experiment.algorithms.ppo import PPOConfig
from torchrl_l2c2.experiment.algorithms.ppo_rpe import PPORPEConfig
from torchrl_l2c2.experiment.algorithms.sac import SACConfig
from torchrl_l2c2.experiment.algorithms.td3 import TD3Config

__all__ = [
    "ALGORITHMS",
    "AlgorithmConfig",
    "DQNConfig",
    "PPOConfig",
    "PPORPEConfig",
    "SACConfig",
    "TD3Config",
]

ALGORITHMS: dict[str, AlgorithmConfig] = {
    "ppo_rpe": PPORPEConfig(),
    "sac": SACConfig(),
    "td3": TD3Config(),
    "ppo": PPOConfig(),
    "dqn": DQNConfig(),
}
