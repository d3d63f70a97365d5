"""Soft actor-critic."""

from __future__ import annotations

from torch import nn
from torchrl.envs import EnvBase
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.networks import (
    action_value,
    check_bounds,
    normal_actor,
    shared_copy,
)
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer
from torchrl_l2c2.experiment.settings.algorithms import SACConfig
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig


def make_sac(
    config: SACConfig, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds SAC, with the arguments of :func:`~.build.make_algorithm`."""
    check_bounds(env, config.name)
    actor = normal_actor(env, config.hidden, nn.ReLU, exponential=config.scale_mapping == "exp")
    loss = SACLoss(
        actor,
        action_value(env, config.hidden),
        num_qvalue_nets=2,
        loss_function="l2",
        alpha_init=config.alpha_init,
        action_spec=env.action_spec,
        target_entropy=_target_entropy(config, env),
    )
    loss.make_value_estimator(gamma=config.gamma)
    # The first read creates this buffer; inside a compiled function it would be lost.
    loss.target_entropy  # noqa: B018
    loss = add_regularizer(loss, regularizer)
    return Agent(
        loss,
        policy=shared_copy(actor, loss.actor_network_params),
        optimizer=make_optimizer(optimizer, loss.parameters()),
        target_updater=SoftUpdate(loss, tau=config.tau),
        policy_terms=frozenset({"loss_actor"}),
    )


def _target_entropy(config: SACConfig, env: EnvBase) -> float | str:
    if config.target_entropy is None:
        return "auto"
    if config.target_entropy != "scaled":
        return config.target_entropy
    space = env.action_spec.space
    half_range = (space.high - space.low) / 2
    return float(half_range.log().sum()) - half_range.numel()
