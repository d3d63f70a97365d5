"""PPO-RPE, the paper's algorithm."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.networks import (
    check_bounds,
    observation_size,
    shared_copy,
)
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer
from torchrl_l2c2.experiment.settings.algorithms import PPORPEConfig
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig
from torchrl_l2c2.modules import make_actor, make_critic
from torchrl_l2c2.objectives import PPORPELoss
from torchrl_l2c2.updaters import TSoftUpdate


def make_ppo_rpe(
    config: PPORPEConfig, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds PPO-RPE, with the arguments of :func:`~.build.make_algorithm`."""
    if config.squash != "none":
        check_bounds(env, config.name)
    size = observation_size(env)
    actor = make_actor(
        size,
        env.action_spec.to(torch.get_default_device()),
        hidden=config.hidden,
        squash=config.squash,
        scale_mapping=f"biased_softplus_{config.initial_scale}",
        squish_b=config.squish_b,
    )
    critic = make_critic(
        size,
        num_heads=config.num_heads,
        hidden=config.hidden,
        squish_b=config.squish_b,
    )
    loss = PPORPELoss(
        actor,
        critic,
        gamma=config.gamma,
        kappa=config.kappa,
        beta=config.beta,
        decay=config.decay,
        delta_min=config.delta_min,
        threshold=config.threshold,
        critic_weighting=config.critic_weighting,
        baseline=config.baseline,
        importance=config.importance,
        reduction=config.reduction,
    )
    if config.time_limit == "terminated":
        loss.set_keys(terminated="done")
    loss = add_regularizer(loss, regularizer)
    acting = "target_actor_network" if config.acting_policy == "target" else "actor_network"
    return Agent(
        loss,
        policy=shared_copy(loss.actor_network, getattr(loss, f"{acting}_params")),
        optimizer=make_optimizer(optimizer, loss.parameters()),
        target_updater=TSoftUpdate(loss, tau=config.tau, nu=config.nu),
        policy_terms=frozenset({"loss_actor"}),
    )
