"""Proximal policy optimization with a clipped ratio."""

from __future__ import annotations

from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ValueOperator
from torchrl.objectives.value import GAE

from torchrl_l2c2.experiment.agents._torchrl_internals import TraceableClipPPOLoss
from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.networks import (
    check_bounds,
    clip_bounds,
    normal_actor,
    observation_size,
    orthogonal,
    perceptron,
    shared_copy,
)
from torchrl_l2c2.experiment.agents.normalization import ActingPolicy, Normalization
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer
from torchrl_l2c2.experiment.settings.algorithms import PPOConfig
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig


def make_ppo(
    config: PPOConfig, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds PPO, with the arguments of :func:`~.build.make_algorithm`."""
    if not config.clip_actions:
        check_bounds(env, config.name)
    activation = {"tanh": nn.Tanh, "relu": nn.ReLU}[config.activation]
    actor = normal_actor(
        env, config.hidden, activation, squash=not config.clip_actions, log_scale=config.log_scale
    )
    critic = ValueOperator(perceptron(env, 1, config.hidden, activation))
    if config.orthogonal:
        orthogonal(actor, last=0.01)
        orthogonal(critic, last=1.0)
    loss = TraceableClipPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        entropy_bonus=config.entropy_coeff > 0,
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    loss = add_regularizer(loss, regularizer)
    advantage = GAE(
        gamma=config.gamma,
        lmbda=config.gae_lambda,
        value_network=shared_copy(critic, loss.critic_network_params),
    )
    normalization = _normalization(config, env)
    return Agent(
        loss,
        policy=_acting(config, shared_copy(actor, loss.actor_network_params), normalization, env),
        optimizer=make_optimizer(optimizer, loss.parameters()),
        advantage=advantage,
        max_grad_norm=config.max_grad_norm,
        policy_terms=frozenset({"loss_objective", "loss_entropy"}),
        normalization=normalization,
    )


def _normalization(config: PPOConfig, env: EnvBase) -> Normalization | None:
    if not (config.normalize_observations or config.normalize_rewards):
        return None
    return Normalization(
        observation_size(env),
        observations=config.normalize_observations,
        rewards=config.normalize_rewards,
        gamma=config.gamma,
        streams=config.num_envs or 1,
    )


def _acting(
    config: PPOConfig, policy: TensorDictModule, normalization: Normalization | None, env: EnvBase
) -> TensorDictModule:
    """Returns the acting policy, with normalization and clipping as in the settings."""
    if normalization is None and not config.clip_actions:
        return policy
    bounds = clip_bounds(env) if config.clip_actions else ()
    return ActingPolicy(policy, normalization, *bounds)
