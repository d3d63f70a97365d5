"""Steps of optimizers and target networks inside compiled functions."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer
from torch.optim.adam import adam
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import TargetNetUpdater

from torchrl_l2c2.optim import AdaTerm
from torchrl_l2c2.updaters import TSoftUpdate


def traceable_step(optimizer: Optimizer) -> Callable[[], object] | None:
    """Returns the optimizer's step as a function that compiles, or ``None`` if it does not.

    Learning rates become tensors: in-place changes, such as by torch's schedulers, also affect
    the compiled step.

    Args:
        optimizer (Optimizer): :class:`~torchrl_l2c2.AdaTerm` or ``torch.optim.Adam``.
    """
    if type(optimizer) not in (AdaTerm, Adam):  # A subclass may have another step.
        return None
    for group in optimizer.param_groups:
        if not isinstance(group["lr"], Tensor):
            # float64 keeps the exact number, in case the run continues without compilation.
            group["lr"] = torch.tensor(group["lr"], dtype=torch.float64)
    if isinstance(optimizer, Adam):
        _initialize_state(optimizer)
        return partial(adam_step, optimizer)
    return optimizer.step


def traceable_targets(updater: TargetNetUpdater | None) -> bool:
    """Checks whether the target networks' step compiles: it must not count in Python."""
    return updater is None or type(updater) in (SoftUpdate, TSoftUpdate)


@torch.no_grad()
def adam_step(optimizer: Adam) -> None:
    """Does ``optimizer.step()`` with gradients that the same compiled function computes.

    When traced, Adam's own step would read the earlier gradients. Both use the same state, which
    must exist.

    Args:
        optimizer (Adam): Optimizer with an initialized state.
    """
    for group in optimizer.param_groups:
        params = [p for p in group["params"] if p.grad is not None]
        states = [optimizer.state[p] for p in params]
        beta1, beta2 = group["betas"]
        adam(
            params,
            [p.grad for p in params],
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [state["max_exp_avg_sq"] for state in states] if group["amsgrad"] else [],
            [state["step"] for state in states],
            foreach=True,
            capturable=True,
            fused=False,
            amsgrad=group["amsgrad"],
            beta1=beta1,
            beta2=beta2,
            lr=group["lr"],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            maximize=group["maximize"],
            decoupled_weight_decay=group["decoupled_weight_decay"],
        )


def _initialize_state(optimizer: Adam) -> None:
    """Initializes the state of each parameter as in Adam's first step."""
    for group in optimizer.param_groups:
        for p in group["params"]:
            if optimizer.state[p]:
                continue
            moments = ["exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] if group["amsgrad"] else [])]
            optimizer.state[p].update(
                step=torch.zeros((), dtype=torch.float32, device=p.device),
                **{name: torch.zeros_like(p) for name in moments},
            )
