"""Agents from the settings of a run."""

from __future__ import annotations

import warnings
from functools import singledispatch
from typing import Any

import torch
from torchrl.envs import EnvBase

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.ppo import make_ppo
from torchrl_l2c2.experiment.agents.ppo_rpe import make_ppo_rpe
from torchrl_l2c2.experiment.agents.sac import make_sac
from torchrl_l2c2.experiment.agents.td3 import make_td3
from torchrl_l2c2.experiment.settings.algorithms import (
    PPOConfig,
    PPORPEConfig,
    SACConfig,
    TD3Config,
)
from torchrl_l2c2.experiment.settings.config import ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig


def make_agent(config: ExperimentConfig, env: EnvBase) -> Agent:
    """Builds the agent of a run on the device of the settings.

    Args:
        config (ExperimentConfig): Settings of the run.
        env (EnvBase): Environment with the task's observations and actions.

    Returns:
        Agent: Agent with new networks.

    Raises:
        SettingError: If PyTorch does not find the device, or the regularizer does not work with the
            algorithm.
        UserError: If the algorithm does not support the task's actions.
    """
    check_device_found(config.device)
    device = torch.device(config.device)
    with device, warnings.catch_warnings():
        # This package adds the target networks' updaters later.
        warnings.filterwarnings("ignore", "No target network updater")
        agent = make_algorithm(config.algorithm, env, config.regularizer, config.optimizer)
    if device.type != "cpu":
        agent.act_on_cpu()
    return agent


@singledispatch
def make_algorithm(
    config: Any, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds the agent of an algorithm.

    ``make_algorithm.register(MyConfig, function)`` adds an algorithm.

    Args:
        config: Settings of the algorithm.
        env (EnvBase): Environment with the task's observations and actions.
        regularizer (RegularizerConfig): Settings of the regularizer.
        optimizer (AdaTermConfig or AdamConfig): Settings of the optimizer.

    Returns:
        Agent: Agent with new networks.

    Raises:
        TypeError: If no function is registered for these settings.
    """
    raise TypeError(
        f"make_algorithm has no function for {type(config).__name__}. Add it with "
        f"make_algorithm.register({type(config).__name__}, function)."
    )


make_algorithm.register(PPORPEConfig, make_ppo_rpe)
make_algorithm.register(SACConfig, make_sac)
make_algorithm.register(TD3Config, make_td3)
make_algorithm.register(PPOConfig, make_ppo)


def check_device_found(device: str) -> None:
    """Checks that PyTorch finds a device.

    Raises:
        SettingError: If PyTorch does not find the device.
    """
    found = torch.cuda.device_count()
    if device != "cpu" and (torch.device(device).index or 0) >= found:
        raise SettingError(
            "device",
            f"must be a device of this machine, where PyTorch finds {found} CUDA devices, got "
            f"{device!r}: use device=cpu.",
        )
