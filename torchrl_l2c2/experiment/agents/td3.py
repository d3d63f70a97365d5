"""Twin delayed DDPG."""

from __future__ import annotations

import warnings

import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import Actor, AdditiveGaussianModule, TanhModule
from torchrl.objectives import SoftUpdate, TD3Loss

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.networks import (
    action_value,
    check_bounds,
    perceptron,
    shared_copy,
)
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer
from torchrl_l2c2.experiment.settings.algorithms import TD3Config
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig


def make_td3(
    config: TD3Config, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds TD3, with the arguments of :func:`~.build.make_algorithm`."""
    check_bounds(env, config.name, sampled=False)
    spec = env.action_spec
    network = perceptron(env, spec.shape[-1], config.hidden, nn.ReLU)
    bounds = spec.to(torch.get_default_device())
    squash = TanhModule(in_keys=["action"], out_keys=["action"], spec=bounds)
    actor = TensorDictSequential(Actor(network, out_keys=["action"]), squash)
    half_range = _half_range(spec)
    loss = TD3Loss(
        actor,
        action_value(env, config.hidden),
        action_spec=spec,
        num_qvalue_nets=2,
        loss_function="l2",
        policy_noise=config.policy_noise * half_range,
        noise_clip=config.noise_clip * half_range,
    )
    loss.make_value_estimator(gamma=config.gamma)
    loss = add_regularizer(loss, regularizer)
    sigma = config.exploration_noise * half_range
    noise = AdditiveGaussianModule(spec, sigma_init=sigma, sigma_end=sigma)
    return Agent(
        loss,
        policy=TensorDictSequential(shared_copy(actor, loss.actor_network_params), noise),
        optimizer=make_optimizer(optimizer, loss.parameters()),
        target_updater=SoftUpdate(loss, tau=config.tau),
        policy_terms=frozenset({"loss_actor"}),
        policy_delay=config.policy_delay,
    )


def _half_range(spec: TensorSpec) -> float:
    """Returns half the largest range of the actions, the unit of TD3's noise.

    Warns:
        UserWarning: If the ranges of the actions differ.
    """
    half_ranges = (spec.space.high - spec.space.low) / 2
    half_range: float = half_ranges.max().item()
    if half_ranges.min() < half_range:
        warnings.warn(
            "td3 uses the same noise for every action, relative to the largest half range, got "
            f"half ranges {half_ranges.tolist()}: the noise is too large for narrow actions. Scale "
            "the task's actions to one range (gymnasium.wrappers.RescaleAction), or use "
            "algorithm=sac.",
            stacklevel=3,
        )
    return half_range
