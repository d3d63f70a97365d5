"""What learns: networks, loss, regularizer, optimizer and target networks, wired from settings."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_l2c2.experiment.compilation import compiled
from torchrl_l2c2.experiment.config import (
    AdamConfig,
    AdaTermConfig,
    CAPSConfig,
    ExperimentConfig,
    L2C2Config,
    OptimizerConfig,
    PPORPEConfig,
    RegularizerConfig,
)
from torchrl_l2c2.modules import make_actor, make_critic
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import CAPSLoss, L2C2Loss, PPORPELoss
from torchrl_l2c2.optim import AdaTerm
from torchrl_l2c2.updaters import TSoftUpdate


@dataclass
class Agent:
    """Everything that learns in a run.

    Attributes:
        loss: the algorithm's loss, regularized.
        policy: acts; shares its parameters with ``loss``, so it is always the current one.
        optimizer: of all of the loss's parameters.
        target_updater: moves the target networks after every update.
    """

    loss: LossModule
    policy: TensorDictModule
    optimizer: torch.optim.Optimizer
    target_updater: TargetNetUpdater


def make_agent(config: ExperimentConfig, env: EnvBase) -> Agent:
    """Builds the agent for an environment's observation and action.

    Raises:
        ValueError: a setting outside its range, or an action that the algorithm cannot take.
    """
    loss, policy = _make_ppo_rpe(config.algorithm, env)
    loss = regularize(loss, config.regularizer)
    return Agent(
        loss=loss,
        policy=policy,
        optimizer=_make_optimizer(config.optimizer, loss),
        target_updater=TSoftUpdate(loss, tau=config.algorithm.tau, nu=config.algorithm.nu),
    )


def regularize(loss: LossModule, regularizer: RegularizerConfig) -> LossModule:
    """Wraps a loss with the chosen regularizer; ``none`` gives the loss itself."""
    if isinstance(regularizer, L2C2Config):
        near = Neighborhood(regularizer.sigma, regularizer.lambda_min, regularizer.lambda_max)
        return L2C2Loss(
            loss, neighborhood=near, beta=regularizer.beta, num_samples=regularizer.num_samples
        )
    if isinstance(regularizer, CAPSConfig):
        return CAPSLoss(
            loss, regularizer.sigma, regularizer.lambda_temporal, regularizer.lambda_spatial
        )
    return loss


def _make_ppo_rpe(algorithm: PPORPEConfig, env: EnvBase) -> tuple[LossModule, TensorDictModule]:
    size = env.observation_spec["observation"].shape[-1]
    if not env.action_spec.dtype.is_floating_point:
        raise ValueError(
            f"algorithm=ppo_rpe needs continuous actions, this task's are {env.action_spec}."
        )
    actor = make_actor(
        size,
        env.action_spec,
        hidden=algorithm.hidden,
        squash=algorithm.squash,
        squish_b=algorithm.squish_b,
    )
    critic = make_critic(
        size, num_heads=algorithm.num_heads, hidden=algorithm.hidden, squish_b=algorithm.squish_b
    )
    loss = PPORPELoss(
        actor,
        critic,
        gamma=algorithm.gamma,
        kappa=algorithm.kappa,
        beta=algorithm.beta,
        decay=algorithm.decay,
        delta_min=algorithm.delta_min,
        threshold=algorithm.threshold,
        critic_weighting=algorithm.critic_weighting,
        baseline=algorithm.baseline,
    )
    acts = (
        loss.target_actor_network_params
        if algorithm.acting_policy == "target"
        else loss.actor_network_params
    )
    return loss, sharing(actor, acts)


def sharing(network: TensorDictModule, parameters: TensorDictParams) -> TensorDictModule:
    """A copy of a network on a loss's own parameters: it changes as they do."""
    copy = deepcopy(network)
    parameters.data.to_module(copy)
    return copy


def _make_optimizer(optimizer: OptimizerConfig, loss: LossModule) -> torch.optim.Optimizer:
    if isinstance(optimizer, AdaTermConfig):
        return AdaTerm(
            loss.parameters(),
            lr=optimizer.lr,
            beta=optimizer.beta,
            eps=optimizer.eps,
            nu_min=optimizer.nu_min,
        )
    assert isinstance(optimizer, AdamConfig)
    return torch.optim.Adam(
        loss.parameters(), lr=optimizer.lr, betas=optimizer.betas, eps=optimizer.eps
    )


def make_update(
    agent: Agent, *, compile: bool, skip_nonfinite: bool = False
) -> Callable[[TensorDictBase], Tensor | None]:
    """One gradient step as a function of a batch: loss, gradients, optimizer, target networks.

    Args:
        agent (Agent): what is updated, in place.
        compile (bool): whether to compile: the whole step is one graph then.
        skip_nonfinite (bool): whether a batch with a loss or gradient that is NaN or infinite
            changes nothing and gives ``None``. The step is two graphs then.

    Returns:
        Callable: takes a batch, writes the new priorities into it and returns the values of
        ``agent.loss.out_keys``, in their order, as one tensor.
    """
    parameters = [p for group in agent.optimizer.param_groups for p in group["params"]]

    def differentiate(batch: TensorDictBase) -> tuple[Tensor, tuple[Tensor, ...]]:
        terms = agent.loss(batch)
        total = sum(terms[key] for key in agent.loss.out_keys if key.startswith("loss_"))
        gradients = torch.autograd.grad(total, parameters)
        return torch.stack([terms[key].detach() for key in agent.loss.out_keys]), gradients

    def apply(gradients: tuple[Tensor, ...]) -> None:
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        agent.optimizer.step()
        agent.target_updater.step()

    def update(batch: TensorDictBase) -> Tensor:
        values, gradients = differentiate(batch)
        apply(gradients)
        return values

    if not skip_nonfinite:
        return compiled(update) if compile else update
    if compile:
        differentiate, apply = compiled(differentiate), compiled(apply)

    def checked_update(batch: TensorDictBase) -> Tensor | None:
        values, gradients = differentiate(batch)
        if not all(bool(tensor.isfinite().all()) for tensor in (values, *gradients)):
            return None
        apply(gradients)
        return values

    return checked_update
