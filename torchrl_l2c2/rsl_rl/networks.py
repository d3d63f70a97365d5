"""rsl_rl's actor and critic as the networks of a TorchRL loss."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torch import Tensor
from torchrl.modules import IndependentNormal

from torchrl_l2c2.objectives import SharedEvaluation

MEAN, SCALE, VALUE, VALID = "loc", "scale", "state_value", "valid"
"""Entries of a batch: the policy's parameters and the value, and whether a row is a transition."""
ENTRIES = ("action", MEAN, SCALE, VALUE, VALID)
"""All that the losses read or write beside observation groups, which cannot have these names."""


class ActorCriticLoss(SharedEvaluation):
    """rsl_rl's actor and critic as a TorchRL loss that has no terms of its own.

    rsl_rl computes the terms of PPO itself; this is what the regularizers of this package are put
    around. Batches have the observation groups by their names, and again under ``"next"``. Where
    they also have the policy's parameters as ``"loc"`` and ``"scale"``, which rsl_rl works out
    before, the actor is not evaluated again. Rows that are false in ``"valid"``, where a batch has
    it, count nothing: terms are means over the others.

    Args:
        actor (MLPModel): the policy, a normal distribution; also a model with convolutions.
        critic (MLPModel): the value function.

    Raises:
        TypeError: a model is recurrent, or the policy is not a normal distribution.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        value: NestedKey = VALUE

    default_keys = _AcceptedKeys

    def __init__(self, actor: MLPModel, critic: MLPModel) -> None:
        _check_models(actor, critic)
        super().__init__()
        self.in_keys: list[NestedKey] = []
        self.out_keys: list[NestedKey] = []
        parameters = ProbabilisticTensorDictModule(
            in_keys=[MEAN, SCALE], out_keys=["action"], distribution_class=IndependentNormal
        )
        self.actor_network = ProbabilisticTensorDictSequential(_Actor(actor), parameters)
        self.critic_network = _Critic(critic)
        self.loss_mask_key = VALID

    @property
    def functional(self) -> bool:
        return False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """No terms; keeps what is known of the policy for the regularizers around it."""
        if MEAN in tensordict.keys():
            self.evaluate_at_batch("actor_network", tensordict)
        return TensorDict()

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.select(MEAN, SCALE)


class _Actor(TensorDictModuleBase):
    """The parameters of the policy, apart from those that rsl_rl's update still has a use for."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        self.model = actor
        self.in_keys, self.out_keys = groups(actor), [MEAN, SCALE]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Not a call of the model: that draws actions, and moves the global generator.
        output = self.model.mlp(self.model.get_latent(tensordict))
        distribution = copy.copy(self.model.distribution)
        distribution.update(output)
        return write_parameters(tensordict, distribution.params)


class _Critic(TensorDictModuleBase):
    def __init__(self, critic: MLPModel) -> None:
        super().__init__()
        self.model = critic
        self.in_keys, self.out_keys = groups(critic), [VALUE]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(VALUE, self.model(tensordict).float())


def write_parameters(tensordict: TensorDictBase, parameters: tuple[Tensor, ...]) -> TensorDictBase:
    """Writes mean and scale, in single precision also where the networks ran in a lower one."""
    mean, scale = torch.broadcast_tensors(*(parameter.float() for parameter in parameters))
    return tensordict.set(MEAN, mean).set(SCALE, scale)


def groups(model: MLPModel) -> list[str]:
    """The observation groups that a model reads, vectors first, then images."""
    return [*model.obs_groups, *getattr(model, "obs_groups_2d", [])]


def _check_models(actor: MLPModel, critic: MLPModel) -> None:
    for name, model in (("actor", actor), ("critic", critic)):
        if model.is_recurrent:
            raise TypeError(
                f"the {name} is recurrent ({type(model).__name__}): its output depends on the "
                "observations before, so that it has no value at one near the current one alone. "
                "Take a feed-forward model, such as MLPModel, with a history of observations."
            )
    if not isinstance(actor.distribution, GaussianDistribution):
        raise TypeError(
            f"the actor's distribution is a {type(actor.distribution).__name__}, and normal ones "
            "alone can be compared: let distribution_cfg of the actor name GaussianDistribution "
            "or HeteroscedasticGaussianDistribution."
        )
