"""Optimizers from settings, and their learning rates over a training."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch.nn import Parameter
from torch.optim import Optimizer

from torchrl_l2c2.experiment.settings.optimizers import AdaTermConfig, OptimizerConfig
from torchrl_l2c2.optim import AdaTerm


def make_optimizer(config: OptimizerConfig, parameters: Iterable[Parameter]) -> Optimizer:
    """Builds the optimizer of these parameters."""
    if isinstance(config, AdaTermConfig):
        return AdaTerm(
            parameters, lr=config.lr, beta=config.beta, eps=config.eps, nu_min=config.nu_min
        )
    return torch.optim.Adam(parameters, lr=config.lr, betas=config.betas, eps=config.eps)


def anneal(config: OptimizerConfig, optimizer: Optimizer, done: float) -> None:
    """Sets the learning rate after a share of the training, if it changes.

    Args:
        config (AdaTermConfig or AdamConfig): the settings that made the optimizer.
        optimizer (Optimizer): its learning rates are set, in place where they are tensors.
        done (float): share of the training that is over; beyond 1 the rate stays at 0.
    """
    if not config.linear:
        return
    rate = config.lr * max(0.0, 1.0 - done)
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):  # A compiled step reads it.
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
