"""What is to be known of a loss's networks to evaluate them at states of our own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd
from torchrl.modules import Delta, GRUModule, LSTMModule, TanhDelta
from torchrl.objectives import IQLLoss, LossModule, PPOLoss, ReinforceLoss

POLICY_NETWORK = "actor_network"
"""The name under which losses hold their policy."""

VALUE_NETWORKS = ("critic_network", "qvalue_network", "value_network", "local_value_network")
"""The names under which losses hold their value functions."""

RECURRENT = (LSTMModule, GRUModule, nn.RNNBase, nn.RNNCellBase)

# The vector of an ensemble, or of all actions, comes before the one number made of it.
_VALUE_KEYS = ("value_heads", "state_action_value", "action_value", "value")


@dataclass(frozen=True)
class Wiring:
    """What is to be known of a network to evaluate it at states of our own."""

    inputs: tuple[NestedKey, ...]  # what the evaluation reads from the batch
    states: tuple[NestedKey, ...]  # those inputs that are states
    trunk: tuple[NestedKey, ...]  # inputs that are hidden outputs of the policy network
    trains_trunk: bool  # whether gradients of its own term reach the policy through these
    output: NestedKey | None  # a value function's value, a deterministic policy's action
    stochastic: bool
    has_buffers: bool
    rowwise: bool  # an output depends on its own row alone, and on no random numbers


def wiring_of(loss: LossModule, network: str) -> Wiring:
    """How a network of a loss is evaluated; refuses one that cannot be.

    Args:
        loss (LossModule): the loss.
        network (str): its name, such as ``"actor_network"``.

    Raises:
        TypeError: it is recurrent, does not declare its keys, or has several distributions.
    """
    net, actor = getattr(loss, network), getattr(loss, POLICY_NETWORK, None)
    _check_declares_keys(net, network)
    _check_not_recurrent(net, network)
    stochastic, actions, made = False, _action_keys(loss), set()
    if actor is not None:
        stochastic = _is_stochastic(actor)
        made = set(actor.out_keys) - set(actor.in_keys)
        if stochastic:
            actions += actor.dist_sample_keys
        elif not made & set(actions):
            actions = [_unnamed_action(loss, actor, made)]
    trunk = [key for key in net.in_keys if key in made - set(actions)]
    inputs = dict.fromkeys([*net.in_keys, *(actor.in_keys if trunk and actor is not None else ())])
    if network == POLICY_NETWORK:
        output = next((key for key in actions if key in made), None)
    else:
        output = _value_key(loss, network)
    return Wiring(
        inputs=tuple(key for key in inputs if key not in trunk),
        states=tuple(k for k in inputs if k not in made.union(actions) and not _is_private(k)),
        trunk=tuple(trunk),
        trains_trunk=_trains_trunk(loss, network),
        output=output,
        stochastic=stochastic,
        has_buffers=_has_buffers(loss, network),
        rowwise=not any(isinstance(m, _BatchNorm | _DropoutNd) for m in net.modules()),
    )


def _unnamed_action(loss: LossModule, actor: Any, made: set[NestedKey]) -> NestedKey:
    """What a deterministic policy acts with, by a loss that does not name it."""
    networks: list[Any] = [getattr(loss, name, None) for name in VALUE_NETWORKS]
    read = {key for network in networks if network is not None for key in network.in_keys}
    written: list[NestedKey] = list(actor.out_keys)
    # What a policy hands on to the values beside its action, such as a trunk, it writes before.
    found = [key for key in written if key in made & read]
    return "action" if "action" in found else (found or written)[-1]


def _trains_trunk(loss: LossModule, network: str) -> bool:
    """Whether a value function trains the policy by its hidden outputs in the plain loss.

    That is where the loss evaluates the policy before, in the same batch; others read what the
    batch holds.
    """
    of_values = isinstance(loss, IQLLoss) and network == "value_network"
    whole = not getattr(loss, "separate_losses", False)
    return of_values or (isinstance(loss, PPOLoss | ReinforceLoss) and whole)


def _is_private(key: NestedKey) -> bool:
    """Whether it is TorchRL's own bookkeeping, such as the noise matrix of gSDE."""
    return (key if isinstance(key, str) else key[-1]).startswith("_")


def _action_keys(loss: LossModule) -> list[NestedKey]:
    keys = getattr(loss.tensor_keys, "action", [])
    return [unravel_key(key) for key in (keys if isinstance(keys, list) else [keys])]


def _value_key(loss: LossModule, network: str) -> NestedKey | None:
    # A network's name does not tell what it is: a value_network is V, Q or a vector of Q.
    keys = (getattr(loss.tensor_keys, name, None) for name in _VALUE_KEYS)
    written = getattr(loss, network).out_keys
    return next((key for key in keys if key and unravel_key(key) in written), None)


def _has_buffers(loss: LossModule, network: str) -> bool:
    params = parameters_of(loss, network)
    if params is None:
        return any(True for _ in getattr(loss, network).buffers())
    return not all(isinstance(p, nn.Parameter) for p in params.values(True, True))


def _is_stochastic(actor: nn.Module) -> bool:
    classes = [
        getattr(module.distribution_class, "func", module.distribution_class)  # of a partial
        for module in actor.modules()
        if isinstance(module, ProbabilisticTensorDictModule)
    ]
    if all(isinstance(one, type) and issubclass(one, Delta | TanhDelta) for one in classes):
        return False
    if getattr(actor, "return_composite", False) or not hasattr(actor, "get_dist_params"):
        raise TypeError(
            "the policy must be a ProbabilisticTensorDictSequential, such as a ProbabilisticActor, "
            f"with one distribution, got a {type(actor).__name__} with {len(classes)}: join "
            "several heads in one CompositeDistribution."
        )
    return True


def _check_declares_keys(net: nn.Module, name: str) -> None:
    if not (hasattr(net, "in_keys") and hasattr(net, "out_keys")):
        raise TypeError(
            f"{name} is a {type(net).__name__}, which does not say what it reads and writes: make "
            "it a TensorDictModule with in_keys and out_keys."
        )


def _check_not_recurrent(net: Any, name: str) -> None:
    recurrent = any(isinstance(module, RECURRENT) for module in net.modules())
    # What it hands on to the next step.
    written = {unravel_key(key) for key in net.out_keys}
    handed_on = any(unravel_key(("next", key)) in written for key in net.in_keys)
    if recurrent or handed_on or "is_init" in net.in_keys:
        raise TypeError(
            f"{name} is recurrent: its output depends on the states before, so that it has no "
            "value at a state near the current one alone. Only feed-forward networks can be "
            "regularized."
        )


def parameters_of(loss: LossModule, network: str) -> TensorDictBase | None:
    """The parameters that a loss keeps beside a network; ``None``: in it."""
    return getattr(loss, f"{network}_params", None) if loss.functional else None
