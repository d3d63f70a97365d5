"""ASAP: policies whose mean is what could be predicted from the state before."""

from __future__ import annotations

import copy
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.grad_caps import GradCAPSLoss
from torchrl_l2c2.policy_distances import policy_mean


class ASAPLoss(GradCAPSLoss):
    r"""A loss with the terms of ASAP (*Enhancing Control Policy Smoothness by Aligning Actions with
    Predictions from Preceding States*).

    Adds to any TorchRL loss with a policy a network :math:`\pi_P` that predicts the next action,
    and

    .. math::
        \lambda_S\, \mathbb E\left[\lVert \mu(s_t) - \bar\pi_P(s_{t-1}) \rVert_2^2\right]
        + \lambda_P\, \mathbb E\left[\lVert \pi_P(s_{t-1}) - \bar\mu(s_t) \rVert_2^2\right],

    the spatial and the temporal term, as ``loss_asap_spatial``, which trains the policy, and
    ``loss_asap_temporal``, which trains the predictor; a bar stops the gradient. With them comes
    the term of :class:`GradCAPSLoss`, as ``loss_grad_caps``, whose batches this loss needs.

    States that may follow one state share one prediction, so that actions in them come near one
    another: that is what makes the first term spatial. In the first step of an episode, where the
    state before is the state itself, the policy is compared with a prediction for that one.

    [inferred] The authors' predictor is a second head on the hidden layers of the policy. A loss of
    any kind does not say where these end: here it is a network of its own, ``asap_predictor``, that
    begins as a copy of the policy. It is among the loss's parameters, and in its ``state_dict``,
    which other regularizers leave as the plain loss's. Make the optimizer of the regularized loss.

    Args:
        base_loss (LossModule): as for :class:`GradCAPSLoss`.
        lambda_spatial (float): :math:`\lambda_S`, at least 0. Larger values pull actions to the
            predicted ones. Scheduled as ``asap_lambda_spatial``. Defaults to ``0.3``, the authors'
            for MuJoCo; theirs for LunarLander and Pendulum is ``0.03``.
        lambda_temporal (float): :math:`\lambda_P`, at least 0. Larger values let the predictor
            follow the policy sooner, with optimizers that are not free of scale. Scheduled as
            ``asap_lambda_temporal``. Defaults to ``2.0``.
        lambda_grad (float): gain of Grad-CAPS's term, at least 0. Scheduled as
            ``grad_caps_lambda_temporal``. Defaults to ``0.05``; the authors' for LunarLander and
            Pendulum is ``0.005``.
        epsilon (float): as for :class:`GradCAPSLoss`.

    Keyword Args:
        frames_key (NestedKey): as for :class:`GradCAPSLoss`.
        previous_key (NestedKey, optional): likewise.
        mean (str): likewise.
        fraction (float): likewise.
        skip_ends (bool): likewise; leaves these transitions out of Grad-CAPS's term.

    Raises:
        TypeError: as for :class:`GradCAPSLoss`.
        ValueError: likewise.
        KeyError: likewise.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import ASAPLoss
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = ASAPLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value))
        >>> states = {"observation": torch.ones(1, 3), "frames": torch.ones(1, 6)}
        >>> batch = TensorDict({**states, "next": {"observation": torch.ones(1, 3)}}, [1])
        >>> loss.policy_regularizer(batch)["loss_asap_spatial"].item()  # the predictor is a copy
        0.0
    """

    def __init__(
        self,
        base_loss: LossModule,
        lambda_spatial: float = 0.3,
        lambda_temporal: float = 2.0,
        lambda_grad: float = 0.05,
        epsilon: float = 0.1,
        *,
        frames_key: NestedKey = "frames",
        previous_key: NestedKey | None = None,
        mean: Literal["loc", "action"] = "loc",
        fraction: float = 1.0,
        skip_ends: bool = False,
    ) -> None:
        super().__init__(
            base_loss,
            lambda_grad,
            epsilon,
            frames_key=frames_key,
            previous_key=previous_key,
            mean=mean,
            fraction=fraction,
            skip_ends=skip_ends,
        )
        self.register_coefficient("asap_lambda_spatial", lambda_spatial)
        self.register_coefficient("asap_lambda_temporal", lambda_temporal)
        self.asap_predictor = _copy_of_policy(self)
        self.declare_terms(policy=["loss_asap_spatial"], auxiliary=["loss_asap_temporal"])

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        terms = super().policy_regularizer(tensordict)
        near = self.successive_means(tensordict)
        predictor = self.policy_at(near.batch, near.states_before, "asap_predictor")
        squashed = self.grad_caps_mean == "action"
        predicted = policy_mean(predictor, squashed=squashed).squeeze(0)
        spatial = 2.0 * squared_error(near.mean, predicted.detach())
        spatial = self.reduce_term(spatial, tensordict, rows=near.rows)
        terms.set("loss_asap_spatial", self.scaled(spatial, "asap_lambda_spatial"))
        temporal = 2.0 * squared_error(predicted, near.mean.detach())
        temporal = self.reduce_term(temporal, tensordict, rows=near.rows)
        temporal = self.scaled(temporal, "asap_lambda_temporal", auxiliary=True)
        return terms.set("loss_asap_temporal", temporal)


def _copy_of_policy(loss: LossModule) -> TensorDictModuleBase:
    """The policy with parameters of its own, also where the loss keeps them beside it."""
    policy: TensorDictModuleBase = getattr(loss, POLICY_NETWORK)
    if not loss.functional:
        return copy.deepcopy(policy)
    with getattr(loss, f"{POLICY_NETWORK}_params").to_module(policy):
        return copy.deepcopy(policy)
