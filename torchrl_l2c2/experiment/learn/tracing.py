"""The steps of optimizers and target networks as parts of a compiled function."""

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
    """The optimizer's step as a function that compiles; ``None`` where there is none.

    Learning rates become tensors, so that a compiled step follows what is written into them, as
    torch's schedulers do.

    Args:
        optimizer (Optimizer): :class:`~torchrl_l2c2.AdaTerm` or ``torch.optim.Adam``.
    """
    if type(optimizer) not in (AdaTerm, Adam):  # A kind of Adam may step otherwise.
        return None
    for group in optimizer.param_groups:
        if not isinstance(group["lr"], Tensor):
            # As precise as the number: a run that is continued uncompiled goes on with the same.
            group["lr"] = torch.tensor(group["lr"], dtype=torch.float64)
    if isinstance(optimizer, Adam):
        _begin(optimizer)
        return partial(adam_step, optimizer)
    return optimizer.step


def traceable_targets(updater: TargetNetUpdater | None) -> bool:
    """Whether the target networks' step compiles: it may not count in Python."""
    return updater is None or type(updater) in (SoftUpdate, TSoftUpdate)


@torch.no_grad()
def adam_step(optimizer: Adam) -> None:
    """``optimizer.step()`` with gradients that are given in the same compiled function.

    The optimizer's own reads those that were there before, when it is traced. The state is the
    same, and has to be there.
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


def _begin(optimizer: Adam) -> None:
    """Gives every parameter the state that Adam's first step would give it."""
    for group in optimizer.param_groups:
        for p in group["params"]:
            if optimizer.state[p]:
                continue
            moments = ["exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] if group["amsgrad"] else [])]
            optimizer.state[p].update(
                step=torch.zeros((), dtype=torch.float32, device=p.device),
                **{name: torch.zeros_like(p) for name in moments},
            )
