"""Optimizers from settings, and the decay of their learning rates."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch.nn import Parameter
from torch.optim import Optimizer

from torchrl_l2c2.experiment.settings.optimizers import AdaTermConfig, OptimizerConfig
from torchrl_l2c2.optim import AdaTerm


def make_optimizer(config: OptimizerConfig, parameters: Iterable[Parameter]) -> Optimizer:
    """Builds an optimizer of the parameters."""
    if isinstance(config, AdaTermConfig):
        return AdaTerm(
            parameters, lr=config.lr, beta=config.beta, eps=config.eps, nu_min=config.nu_min
        )
    return torch.optim.Adam(parameters, lr=config.lr, betas=config.betas, eps=config.eps)


def anneal(config: OptimizerConfig, optimizer: Optimizer, done: float) -> None:
    """Sets the learning rate for the progress of training, if it decays linearly.

    Args:
        config (AdaTermConfig or AdamConfig): Settings of the optimizer.
        optimizer (Optimizer): Optimizer whose learning rates are set; tensors are set in place.
        done (float): Completed share of training. The rate is 0 from 1 on.
    """
    if not config.linear:
        return
    rate = config.lr * max(0.0, 1.0 - done)
    for group in optimizer.param_groups:
        if isinstance(group["lr"], torch.Tensor):  # A compiled step reads this tensor.
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate
