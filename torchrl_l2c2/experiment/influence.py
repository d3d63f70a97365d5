"""How much of an update is the regularizer's: its gradients beside those of the loss's own."""

from __future__ import annotations

from copy import deepcopy

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2.experiment.update import is_loss


@torch.enable_grad()
def gradient_shares(loss: LossModule, batch: TensorDictBase) -> dict[str, float]:
    r"""The gradients' norms of a regularizer's terms, relative to those of the loss's own terms.

    .. math::
        \frac{\lVert \nabla_\theta L_r \rVert_2}{\lVert \nabla_\theta L \rVert_2}

    for every term :math:`L_r` that a regularizer has added to a loss :math:`L`, in the parameters
    :math:`\theta` that the term trains. Nothing of the loss changes, and no number is drawn from
    torch's global generators.

    Args:
        loss (LossModule): as it is trained; one that is not regularized has no shares.
        batch (TensorDictBase): what it reads; not written to.

    Returns:
        dict: at least 0 for every added ``loss_*`` key; infinite where the loss's own gradient is
        zero.

    Raises:
        ValueError: a term is not a single number.
    """
    added = [key for key in loss.out_keys if key in getattr(loss, "added_terms", ())]
    if not added:
        return {}
    # A copy, as some losses keep statistics of what they have seen.
    devices = {parameter.device for parameter in loss.parameters() if parameter.is_cuda}
    with torch.random.fork_rng(devices=devices):
        twin = deepcopy(loss)
        terms = twin(batch.copy())
    if any(terms[key].ndim for key in terms.keys() if is_loss(key)):
        raise ValueError(
            "gradient_shares needs terms that are single numbers, one for the whole batch: make "
            "the loss with reduction='mean'."
        )
    parameters = list(twin.parameters())

    def gradients(value: Tensor) -> tuple[Tensor | None, ...]:
        return torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)

    own = gradients(sum(terms[key] for key in terms.keys() if is_loss(key) and key not in added))
    shares = {}
    for key in added:
        pairs = [(g, o) for g, o in zip(gradients(terms[key]), own, strict=True) if g is not None]
        norms = [_norm(side) for side in zip(*pairs, strict=True)]
        shares[key] = norms[0] / norms[1] if norms[1] else float("inf")
    return shares


def _norm(gradients: tuple[Tensor | None, ...]) -> float:
    return sum(float(g.square().sum()) for g in gradients if g is not None) ** 0.5
