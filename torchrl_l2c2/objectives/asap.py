"""ASAP: policies whose mean is predictable from the previous state."""

from __future__ import annotations

import copy
from typing import Literal

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch.nn.parameter import is_lazy
from torchrl.objectives import LossModule

from torchrl_l2c2.distances import squared_error
from torchrl_l2c2.objectives._networks import POLICY_NETWORK
from torchrl_l2c2.objectives.grad_caps import GradCAPSLoss
from torchrl_l2c2.policy_distances import policy_mean


class ASAPLoss(GradCAPSLoss):
    r"""A loss with the terms of ASAP (*Enhancing Control Policy Smoothness by Aligning Actions with
    Predictions from Preceding States*).

    Adds to any TorchRL loss with a policy a network :math:`\pi_P` that predicts the next action,
    and the terms

    .. math::
        \lambda_S\, \mathbb E\left[\lVert \mu(s_t) - \bar\pi_P(s_{t-1}) \rVert_2^2\right]
        + \lambda_P\, \mathbb E\left[\lVert \pi_P(s_{t-1}) - \bar\mu(s_t) \rVert_2^2\right],

    as ``loss_asap_spatial``, the spatial term, which trains the policy, and
    ``loss_asap_temporal``, the temporal term, which trains the predictor. A bar stops the gradient.
    The loss also adds ``loss_grad_caps``, the term of :class:`GradCAPSLoss`, and needs the same
    batches.

    All states that may follow a state share one prediction, so the first term draws their actions
    together: it is spatial. In the first step of an episode the state stands in for the previous
    state.

    [inferred] The authors' predictor is a second head on the policy's hidden layers. A general loss
    has no known hidden layers, so the predictor here is a separate network, ``asap_predictor``,
    initialized as a copy of the policy. Its parameters are part of the loss's parameters and
    ``state_dict``: create the optimizer from the regularized loss.

    Args:
        base_loss (LossModule): as for :class:`GradCAPSLoss`.
        lambda_spatial (float): :math:`\lambda_S`, at least 0. Larger values pull the actions toward
            the predictions. Scheduled as ``asap_lambda_spatial``. Defaults to ``0.3``, the authors'
            value for MuJoCo; their value for LunarLander and Pendulum is ``0.03``.
        lambda_temporal (float): :math:`\lambda_P`, at least 0. Larger values let the predictor
            follow the policy faster, unless the optimizer is scale-free. Scheduled as
            ``asap_lambda_temporal``. Defaults to ``2.0``.
        lambda_grad (float): gain of the Grad-CAPS term, at least 0. Scheduled as
            ``grad_caps_lambda_temporal``. Defaults to ``0.05``; the authors' value for LunarLander
            and Pendulum is ``0.005``.
        epsilon (float): as for :class:`GradCAPSLoss`.

    Keyword Args:
        frames_key (NestedKey): as for :class:`GradCAPSLoss`.
        previous_key (NestedKey, optional): as for :class:`GradCAPSLoss`.
        mean (str): as for :class:`GradCAPSLoss`.
        fraction (float): as for :class:`GradCAPSLoss`.
        skip_ends (bool): as for :class:`GradCAPSLoss`; applies to the Grad-CAPS term only.

    Raises:
        TypeError: as for :class:`GradCAPSLoss`.
        ValueError: as for :class:`GradCAPSLoss`; or layers of the policy have no size yet.
        KeyError: as for :class:`GradCAPSLoss`.

    Warns:
        UserWarning: in eager use, once: the optimizer moves other parameters than the predictor's.

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
        if any(map(is_lazy, self.asap_predictor.parameters())):
            raise ValueError(
                "the predictor of ASAPLoss begins as a copy of the policy, whose layers have no "
                "size yet: call the policy on a batch before, or give its layers their in_features."
            )
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
    """Copies the policy with its parameters, also if the loss stores them separately."""
    policy: TensorDictModuleBase = getattr(loss, POLICY_NETWORK)
    if not loss.functional:
        return copy.deepcopy(policy)
    with getattr(loss, f"{POLICY_NETWORK}_params").to_module(policy):
        return copy.deepcopy(policy)
