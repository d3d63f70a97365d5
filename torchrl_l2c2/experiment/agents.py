"""What learns: networks, loss, regularizer, optimizer and target networks, wired from settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_l2c2.experiment.algorithms import Parts, make_algorithm
from torchrl_l2c2.experiment.compilation import compiled
from torchrl_l2c2.experiment.config import (
    AdamConfig,
    AdaTermConfig,
    CAPSConfig,
    ExperimentConfig,
    L2C2Config,
    OptimizerConfig,
    RegularizerConfig,
)
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import CAPSLoss, L2C2Loss
from torchrl_l2c2.optim import AdaTerm
from torchrl_l2c2.updaters import TSoftUpdate


@dataclass
class Agent(Parts):
    """Everything that learns in a run: an algorithm's parts, their optimizer and its limits.

    Attributes:
        optimizer: of all of the loss's parameters.
        max_grad_norm: norm that gradients are scaled down to; ``None`` leaves them.
        policy_delay: updates of the values per update of the policy.
    """

    optimizer: torch.optim.Optimizer | None = None
    max_grad_norm: float | None = None
    policy_delay: int = 1


def make_agent(config: ExperimentConfig, env: EnvBase) -> Agent:
    """Builds the agent for an environment's observation and action.

    Raises:
        ValueError: a setting outside its range, or actions that the algorithm cannot take.
    """
    parts = make_algorithm(config.algorithm, env, partial(regularize, config.regularizer))
    return Agent(
        **vars(parts),
        optimizer=_make_optimizer(config.optimizer, parts.loss),
        max_grad_norm=getattr(config.algorithm, "max_grad_norm", None),
        policy_delay=getattr(config.algorithm, "policy_delay", 1),
    )


def regularize(regularizer: RegularizerConfig, loss: LossModule) -> LossModule:
    """Wraps a loss with the chosen regularizer; ``none`` gives the loss itself."""
    if isinstance(regularizer, L2C2Config):
        near = Neighborhood(regularizer.sigma, regularizer.lambda_min, regularizer.lambda_max)
        return L2C2Loss(
            loss, neighborhood=near, beta=regularizer.beta, num_samples=regularizer.num_samples
        )
    if isinstance(regularizer, CAPSConfig):
        return CAPSLoss(
            loss,
            regularizer.sigma,
            regularizer.lambda_temporal,
            regularizer.lambda_spatial,
            mean=regularizer.mean,
        )
    return loss


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
    agent: Agent,
    *,
    compile: bool,
    skip_nonfinite: bool = False,
    read: Callable[..., TensorDictBase] | None = None,
) -> Callable[..., tuple[Tensor, Tensor | None] | None]:
    """One gradient step as a function of a batch: loss, gradients, optimizer, target networks.

    Args:
        agent (Agent): what is updated, in place. Compiled, the step is made for the agent's tensors
            and settings as they are at its first call: make another after replacing any.
        compile (bool): whether to compile: with AdaTerm and the t-soft update the whole step is
            one graph; with others, loss and gradients are.
        skip_nonfinite (bool): whether a batch with a loss or gradient that is NaN or infinite
            changes nothing and gives ``None``. The step is two graphs then.
        read (Callable, optional): makes the batch of other things, as the first part of the graph.

    Returns:
        Callable: takes whether the policy is updated too, then the batch or what ``read`` makes it
        of. Returns the means of ``agent.loss.out_keys``, in their order, as one tensor, and the
        new priorities of the batch, if the loss gives any. Parameters have no ``grad`` after it.
    """
    parameters = [p for group in agent.optimizer.param_groups for p in group["params"]]
    keys = agent.loss.out_keys
    policy_terms = {"loss_actor", *getattr(agent.loss, "policy_terms", ())}

    def differentiate(
        with_policy: bool, *drawn: Any
    ) -> tuple[Tensor, Tensor | None, tuple[Tensor | None, ...]]:
        # A copy, as losses write into what they are given, some of it with a gradient.
        batch = drawn[0].copy() if read is None else read(*drawn)
        terms = agent.loss(batch)
        priority = batch.get("td_error", None)
        summed = keys if with_policy else [key for key in keys if key not in policy_terms]
        total = sum(terms[key] for key in summed if is_loss(key))
        gradients = torch.autograd.grad(total, parameters, allow_unused=True)
        values = torch.stack([terms[key].detach().float().mean() for key in keys])
        return values, None if priority is None else priority.detach(), gradients

    def apply(gradients: tuple[Tensor | None, ...]) -> None:
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        if agent.max_grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(parameters, agent.max_grad_norm)
        agent.optimizer.step()
        if agent.target_updater is not None:
            agent.target_updater.step()
        # Kept, they would be outputs of the graph, and each output takes time.
        for parameter in parameters:
            parameter.grad = None

    def update(with_policy: bool, *drawn: Any) -> tuple[Tensor, Tensor | None]:
        values, priority, gradients = differentiate(with_policy, *drawn)
        apply(gradients)
        return values, priority

    # torch's own optimizers and TorchRL's updaters break the graph.
    compile = compile and agent.compilable
    whole = isinstance(agent.optimizer, AdaTerm) and isinstance(agent.target_updater, TSoftUpdate)
    if compile and whole and not skip_nonfinite:
        return compiled(update, constant_closure=True)
    if compile:
        differentiate = compiled(differentiate, constant_closure=True)
        apply = compiled(apply, constant_closure=True) if whole else apply
    if not skip_nonfinite:
        return update

    def checked_update(with_policy: bool, *drawn: Any) -> tuple[Tensor, Tensor | None] | None:
        values, priority, gradients = differentiate(with_policy, *drawn)
        tensors = (values, *(g for g in gradients if g is not None))
        if not all(bool(tensor.isfinite().all()) for tensor in tensors):
            return None
        apply(gradients)
        return values, priority

    return checked_update


def is_loss(key: str) -> bool:
    """Whether an entry of a loss's output is one of the terms that are summed."""
    return key == "loss" or key.startswith("loss_")
