"""Smooth Tchebycheff scalarization of a loss and its regularizers: the larger one counts most."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import check_real
from torchrl_l2c2.objectives.regularized import RegularizedLoss

OBJECTIVES = ("loss_actor", "loss_objective", "loss_entropy")
"""Names of the policy's terms in TorchRL's losses."""


class TchebycheffLoss(RegularizedLoss):
    r"""A regularized loss whose policy is trained by a smooth maximum instead of a sum.

    Let :math:`f_1` be the sum of the loss's own terms that train the policy, and :math:`f_2` the
    sum of the regularizers' terms, gains included. The policy descends

    .. math::
        g = \mu \ln \sum_i e^{(f_i - z_i) / \mu}, \qquad
        \nabla g = \sum_i p_i \nabla f_i, \qquad
        p_i = \frac{e^{(f_i - z_i) / \mu}}{\sum_j e^{(f_j - z_j) / \mu}},

    instead of :math:`f_1 + f_2`: the smooth Tchebycheff scalarization (arXiv 2402.19078). With a
    sum, the gains reach only the convex parts of a Pareto front; with :math:`g` they reach all of
    it. Each policy term is multiplied by its :math:`p_i`, so the sum of the returned terms has the
    gradient of :math:`g`. Value terms are unchanged. Two entries are for the log: ``tchebycheff``
    is :math:`g`, ``tchebycheff_share`` is :math:`p_2`.

    Apply it after all regularizers: the terms of a regularizer applied later are added unweighted.
    Loops that call ``policy_regularizer`` without ``forward`` must multiply the terms by
    :func:`tchebycheff_shares`.

    .. note:: Actor losses have no natural zero. For SAC and TD3 the actor loss is minus a value:
        set :math:`z_1` to about minus the largest value you expect. For PPO the actor loss is near
        0 for good and bad policies: only :math:`f_2 - z_2` matters, and the regularizers' share
        falls as the policy gets smoother.

    Args:
        base_loss (LossModule): a regularized loss with a term that trains the policy. Its
            reduction must not be ``"none"``.
        mu (float): :math:`\mu`, greater than 0, in the unit of the losses. Smaller values approach
            the maximum, where only the larger objective counts; larger values approach the mean of
            both plus :math:`\mu \ln 2`. Defaults to ``1.0``.
        ideal (pair of float): :math:`z`, the smallest values you expect. Larger :math:`z_1` train
            the regularizers more. Defaults to ``(0.0, 0.0)``.

    Keyword Args:
        objectives (str or iterable of str): names of the terms in :math:`f_1`, among the ``loss_``
            entries that train the policy. CQL has two policy losses: pass the name of the loss that
            the loop minimizes, ``"loss_actor"`` or ``"loss_actor_bc"``. Defaults to the names in
            ``OBJECTIVES`` that the loss has.

    Raises:
        TypeError: the loss has no regularizer with a policy term, or an argument has the wrong
            type.
        ValueError: an argument is out of its range, or an objective is not a term of the base loss;
            in use, terms are not single numbers.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import CATSLoss
        >>> from torchrl_l2c2.objectives.tchebycheff import TchebycheffLoss
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = CATSLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value))
        >>> loss = TchebycheffLoss(loss, mu=0.1, ideal=(-10.0, 0.0))
        >>> loss.out_keys[-2:]
        ['tchebycheff', 'tchebycheff_share']
    """

    def __init__(
        self,
        base_loss: LossModule,
        mu: float = 1.0,
        ideal: tuple[float, float] = (0.0, 0.0),
        *,
        objectives: str | Iterable[str] = OBJECTIVES,
    ) -> None:
        check_real("mu", mu, above=0)
        if not isinstance(ideal, Sequence) or len(ideal) != 2:
            raise TypeError(
                f"ideal must be two numbers, of the loss and of the regularizers, got {ideal!r}."
            )
        for place, value in enumerate(ideal):
            check_real(f"ideal[{place}]", value)
        added = [key for key in self.out_keys if key in self.added_terms & self.policy_terms]
        if not added:
            raise TypeError(
                f"TchebycheffLoss weighs a regularizer of the policy against the loss, and "
                f"{type(base_loss).__name__} has none among its out_keys: put L2C2Loss or another "
                "around it first."
            )
        names = [objectives] if isinstance(objectives, str) else list(objectives)
        losses = [key for key in self.out_keys if key.startswith("loss_")]
        offered = [key for key in losses if key not in self.added_terms]
        own = [key for key in offered if key in names]
        unknown = objectives is not OBJECTIVES and not set(names) <= set(offered)
        if not own or unknown:
            raise ValueError(
                f"objectives must name what trains the policy among {offered}, which are the "
                f"loss's own, got {names}."
            )
        self.tchebycheff_mu = float(mu)
        self.tchebycheff_ideal = tuple(map(float, ideal))
        self._tchebycheff_keys = (own, added)
        self.out_keys = [*self.out_keys, "tchebycheff", "tchebycheff_share"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss, with each policy term times its share.

        Args:
            tensordict (TensorDictBase): the batch, as for the base loss.
        """
        terms = super().forward(tensordict)
        sums = [sum(terms[key] for key in keys) for keys in self._tchebycheff_keys]
        if any(each.ndim for each in sums):
            raise ValueError(
                "TchebycheffLoss needs terms that are single numbers, got "
                f"{[tuple(each.shape) for each in sums]}: make the loss with reduction='mean'."
            )
        values = torch.stack(sums).detach()
        shares = tchebycheff_shares(values, self.tchebycheff_ideal, self.tchebycheff_mu)
        for keys, share in zip(self._tchebycheff_keys, shares, strict=True):
            for key in keys:
                terms.set(key, share * terms[key])
        value = smooth_tchebycheff(values, self.tchebycheff_ideal, self.tchebycheff_mu)
        return terms.set("tchebycheff", value).set("tchebycheff_share", shares[1])


def smooth_tchebycheff(
    values: Tensor,  # shape: [N]
    ideal: Iterable[float],  # N of them
    mu: float,
) -> Tensor:  # shape: []
    r"""The smooth Tchebycheff scalarization :math:`\mu \ln \sum_i e^{(f_i - z_i) / \mu}`.

    It is at least the largest of :math:`f_i - z_i`, and at most :math:`\mu \ln N` more.

    Args:
        values: :math:`f`, weights included.
        ideal: :math:`z`, one number for each value.
        mu: :math:`\mu`, greater than 0.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.tchebycheff import smooth_tchebycheff
        >>> smooth_tchebycheff(torch.tensor([3.0, 1.0]), (1.0, 1.0), mu=0.1)
        tensor(2.)
    """
    return mu * torch.logsumexp(_over(values, ideal) / mu, 0)


def tchebycheff_shares(
    values: Tensor,  # shape: [N]
    ideal: Iterable[float],  # N of them
    mu: float,
) -> Tensor:  # shape: [N]
    r"""The derivative of :func:`smooth_tchebycheff` with respect to each value: a softmax.

    Args:
        values: :math:`f`, as for :func:`smooth_tchebycheff`.
        ideal: :math:`z`, as for :func:`smooth_tchebycheff`.
        mu: :math:`\mu`, as for :func:`smooth_tchebycheff`.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.objectives.tchebycheff import tchebycheff_shares
        >>> tchebycheff_shares(torch.tensor([3.0, 3.0]), (1.0, 1.0), mu=0.1)
        tensor([0.5000, 0.5000])
    """
    return torch.softmax(_over(values, ideal) / mu, 0)


def _over(values: Tensor, ideal: Iterable[float]) -> Tensor:
    return torch.stack([value - least for value, least in zip(values, ideal, strict=True)])
