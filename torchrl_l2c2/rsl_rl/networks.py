"""rsl_rl's actor and critic as the networks of a TorchRL loss."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from torchrl_l2c2.objectives import SharedEvaluation
from torchrl_l2c2.rsl_rl.storage import recurrent_keys

MEAN, SCALE, VALUE, VALID = "loc", "scale", "state_value", "valid"
"""Entries of a batch: the policy's parameters, the value, and the mask of known transitions."""
ENTRIES = ("action", MEAN, SCALE, VALUE, VALID)
"""Reserved entries, which observation groups cannot have as names."""


class ActorCriticLoss(SharedEvaluation):
    """rsl_rl's actor and critic as a TorchRL loss without terms.

    The regularizers of this package wrap this loss; rsl_rl itself computes the terms of PPO.
    Batches have the observation groups by name, and the next observations under ``"next"``. If a
    batch has the policy's parameters as ``"loc"`` and ``"scale"``, which rsl_rl computes first, the
    actor is not evaluated again. If a batch has ``"valid"``, terms are means over the rows where it
    is true. A recurrent model takes one step from the states in the batch, ``[*B, layers, width]``,
    whose names :func:`state_keys` returns.

    Args:
        actor (MLPModel): the policy, a normal distribution. Models with convolutions and recurrent
            models also work.
        critic (MLPModel): the value function.

    Raises:
        TypeError: a model is recurrent and no ``RNNModel``, or the policy is not a normal
            distribution.
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
        """Returns no terms; caches the policy's parameters for the regularizers."""
        if MEAN in tensordict.keys():
            self.evaluate_at_batch("actor_network", tensordict)
        return TensorDict()

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.select(MEAN, SCALE)


class _Actor(TensorDictModuleBase):
    """Evaluates the policy's parameters without changing the distribution that rsl_rl uses."""

    def __init__(self, actor: MLPModel) -> None:
        super().__init__()
        self.model, self.recurrent_keys = actor, state_keys(actor, "actor")
        self.in_keys, self.out_keys = [*groups(actor), *self.recurrent_keys], [MEAN, SCALE]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # Calling the model would draw actions with the global generator.
        output = self.model.mlp(_latent(self.model, tensordict, self.recurrent_keys))
        distribution = copy.copy(self.model.distribution)
        distribution.update(output)
        return write_parameters(tensordict, distribution.params)


class _Critic(TensorDictModuleBase):
    def __init__(self, critic: MLPModel) -> None:
        super().__init__()
        self.model, self.recurrent_keys = critic, state_keys(critic, "critic")
        self.in_keys, self.out_keys = [*groups(critic), *self.recurrent_keys], [VALUE]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.recurrent_keys:
            value = self.model.mlp(_latent(self.model, tensordict, self.recurrent_keys))
        else:
            value = self.model(tensordict)
        return tensordict.set(VALUE, value.float())


def _latent(model: MLPModel, tensordict: TensorDictBase, states: Sequence[str]) -> Tensor:
    """The input of a model's last layers, ``[B, width]``; a recurrent model takes one step."""
    if not states:
        return model.get_latent(tensordict)
    observation = MLPModel.get_latent(model, tensordict).unsqueeze(0)  # not through the memory
    before = tuple(tensordict[key].transpose(0, 1).contiguous() for key in states)
    out, _ = model.rnn.rnn(observation, before if len(before) > 1 else before[0])
    return out.squeeze(0)


def state_keys(model: MLPModel, name: str) -> tuple[str, ...]:
    """Keys of a model's recurrent states in batches, in the order of its layers' arguments.

    Args:
        model: the model.
        name: ``"actor"`` or ``"critic"``.
    """
    if not model.is_recurrent:
        return ()
    return recurrent_keys(name, 2 if isinstance(model.rnn.rnn, nn.LSTM) else 1)


def write_parameters(tensordict: TensorDictBase, parameters: tuple[Tensor, ...]) -> TensorDictBase:
    """Writes mean and scale in single precision, also if the networks ran in a lower precision."""
    mean, scale = torch.broadcast_tensors(*(parameter.float() for parameter in parameters))
    return tensordict.set(MEAN, mean).set(SCALE, scale)


def groups(model: MLPModel) -> list[str]:
    """The observation groups that a model reads, vectors first, then images."""
    return [*model.obs_groups, *getattr(model, "obs_groups_2d", [])]


def _check_models(actor: MLPModel, critic: MLPModel) -> None:
    for name, model in (("actor", actor), ("critic", critic)):
        if model.is_recurrent and not isinstance(model, RNNModel):
            raise TypeError(
                f"the {name} is recurrent and of a class of its own ({type(model).__name__}), of "
                "which a single step is unknown. Take an RNNModel, or a feed-forward model, such "
                "as MLPModel, with a history of observations."
            )
    if not isinstance(actor.distribution, GaussianDistribution):
        raise TypeError(
            "Expected a normal distribution of the actor, got a "
            f"{type(actor.distribution).__name__}. Name GaussianDistribution or "
            "HeteroscedasticGaussianDistribution in the actor's distribution_cfg."
        )
