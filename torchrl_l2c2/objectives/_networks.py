"""Inspection of a loss's networks: their inputs, their outputs, and refusals of unsuitable ones."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd
from torchrl.modules import (
    ConsistentDropoutModule,
    Delta,
    GRUModule,
    LSTMModule,
    TanhDelta,
)
from torchrl.objectives import DiscreteIQLLoss, IQLLoss, LossModule, PPOLoss, ReinforceLoss

POLICY_NETWORK = "actor_network"
"""Name of a loss's attribute with the policy."""

VALUE_NETWORKS = ("critic_network", "qvalue_network", "value_network", "local_value_network")
"""Names of a loss's attributes with value functions."""

IMITATING = (IQLLoss, DiscreteIQLLoss)
"""Losses whose policy imitates weighted actions of the batch: values only give the weights."""

RECURRENT_KEYS = "recurrent_keys"
"""Attribute of a recurrent module with the keys of its states, from which it takes one step."""

# The vector of an ensemble, or of all actions, comes before the scalar computed from it.
_VALUE_KEYS = ("value_heads", "state_action_value", "action_value", "value")


@dataclass(frozen=True)
class NetworkSpec:
    """The inputs and outputs of a network of a loss.

    Attributes:
        inputs: entries of the batch that the evaluation reads.
        states: the inputs that are observations.
        trunk: inputs that are hidden outputs of the policy network.
        trains_trunk: whether gradients of the network's own term reach the policy through the
            trunk.
        output: key of the value, or of a policy's action.
        stochastic: whether the policy is a distribution.
        has_buffers: whether the network keeps running statistics.
        rowwise: whether a row of the output depends only on the same row of the input, and on no
            random numbers.
        has_dropout: whether the network has dropout layers.
        recurrent: inputs that carry the past, ``is_init`` among them; empty if feed-forward.
        overwrites: whether the network writes over its inputs or their successors, as recurrent
            modules do.
    """

    inputs: tuple[NestedKey, ...]
    states: tuple[NestedKey, ...]
    trunk: tuple[NestedKey, ...]
    trains_trunk: bool
    output: NestedKey | None
    stochastic: bool
    has_buffers: bool
    rowwise: bool
    has_dropout: bool
    recurrent: tuple[NestedKey, ...]
    overwrites: bool


def inspect_network(loss: LossModule, network: str) -> NetworkSpec:
    """Inspects a network of a loss; refuses a network that cannot be evaluated at other states.

    Args:
        loss (LossModule): the loss.
        network (str): name of the network, such as ``"actor_network"``.

    Raises:
        TypeError: the network is recurrent in another way than TorchRL's modules, does not declare
            its keys, or has several distributions.
    """
    net, actor = getattr(loss, network), getattr(loss, POLICY_NETWORK, None)
    _check_declares_keys(net, network)
    recurrent = _recurrent_inputs(net)
    _check_recurrent(net, network, recurrent)
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
    of_policy = () if actor is None else _recurrent_inputs(actor)
    recurrent = (*recurrent, *of_policy) if trunk else recurrent
    if network == POLICY_NETWORK:
        output = next((key for key in actions if key in made), None)
    else:
        output = _value_key(loss, network)
    masks = (m.out_keys[1] for m in net.modules() if isinstance(m, ConsistentDropoutModule))
    computed = made.union(actions, _parents(made), recurrent, of_policy, map(unravel_key, masks))
    states = tuple(key for key in inputs if key not in computed and not _is_private(key))
    written = {unravel_key(key) for key in net.out_keys}
    return NetworkSpec(
        inputs=tuple(key for key in inputs if key not in trunk),
        states=states,
        trunk=tuple(trunk),
        trains_trunk=_trains_trunk(loss, network),
        output=output,
        stochastic=stochastic,
        has_buffers=_has_buffers(loss, network),
        rowwise=not (
            recurrent or any(isinstance(m, _BatchNorm) or drops_out(m) for m in net.modules())
        ),
        has_dropout=any(map(drops_out, net.modules())),
        recurrent=tuple(dict.fromkeys(recurrent)),
        overwrites=any(
            unravel_key(key) in written or unravel_key(("next", key)) in written
            for key in (*states, *recurrent)
        ),
    )


def _parents(keys: Iterable[NestedKey]) -> set[NestedKey]:
    """Keys of the TensorDicts around entries, such as a composite policy's parameters."""
    nested = [key for key in keys if isinstance(key, tuple)]
    return {unravel_key(key[:end]) for key in nested for end in range(1, len(key))}


def _unnamed_action(loss: LossModule, actor: Any, made: set[NestedKey]) -> NestedKey:
    """Guesses the action key of a deterministic policy whose loss does not name it."""
    networks: list[Any] = [getattr(loss, name, None) for name in VALUE_NETWORKS]
    read = {key for network in networks if network is not None for key in network.in_keys}
    written: list[NestedKey] = list(actor.out_keys)
    # Other outputs that value functions read, such as a trunk, come before the action.
    found = [key for key in written if key in made & read]
    return "action" if "action" in found else (found or written)[-1]


def _trains_trunk(loss: LossModule, network: str) -> bool:
    """Checks whether the base loss trains the policy through hidden outputs that a value reads.

    This is the case if the loss evaluates the policy first. Other losses read the hidden outputs
    from the batch.
    """
    of_values = isinstance(loss, IQLLoss) and network == "value_network"
    whole = not getattr(loss, "separate_losses", False)
    return of_values or (isinstance(loss, PPOLoss | ReinforceLoss) and whole)


def _is_private(key: NestedKey) -> bool:
    """Checks whether a key is internal to TorchRL, such as the noise matrix of gSDE."""
    return (key if isinstance(key, str) else key[-1]).startswith("_")


def _action_keys(loss: LossModule) -> list[NestedKey]:
    keys = getattr(loss.tensor_keys, "action", [])
    return [unravel_key(key) for key in (keys if isinstance(keys, list) else [keys])]


def _value_key(loss: LossModule, network: str) -> NestedKey | None:
    # The attribute's name is ambiguous: a value_network is V, Q or a vector of Q.
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
            f"{name} is a {type(net).__name__}, which declares no keys: make it a "
            "TensorDictModule with in_keys and out_keys."
        )


def drops_out(module: nn.Module) -> bool:
    """Checks whether a layer drops out numbers in training."""
    own = isinstance(module, nn.RNNBase | nn.MultiheadAttention) and module.dropout > 0
    return own or isinstance(module, _DropoutNd)


def _steps(module: Any) -> tuple[NestedKey, ...]:
    """The states from which a recurrent module can take one step; none for other modules."""
    if isinstance(module, LSTMModule | GRUModule):
        return tuple(map(unravel_key, module.in_keys[1:]))
    return getattr(module, RECURRENT_KEYS, ())


def _recurrent_inputs(net: nn.Module) -> tuple[NestedKey, ...]:
    """Inputs of recurrent modules that carry the past."""
    return tuple(key for module in net.modules() for key in _steps(module))


def _check_recurrent(net: Any, name: str, carried: Iterable[NestedKey]) -> None:
    """Refuses a recurrent network that cannot take a single step from given states.

    Raises:
        TypeError: a recurrent layer is not in an ``LSTMModule`` or ``GRUModule``, or a module with
            :data:`RECURRENT_KEYS`; or the network hands on another input to its next evaluation.
    """
    known = {id(part) for module in net.modules() if _steps(module) for part in module.modules()}
    layers = (m for m in net.modules() if isinstance(m, nn.RNNBase | nn.RNNCellBase))
    written = {unravel_key(key) for key in net.out_keys}
    others = set(net.in_keys) - set(carried)
    handed_on = "is_init" in others or any(unravel_key(("next", key)) in written for key in others)
    if handed_on or any(id(layer) not in known for layer in layers):
        raise TypeError(
            f"{name} is recurrent: its output depends on earlier states, and not only on the "
            "current one. Use TorchRL's LSTMModule or GRUModule, whose recurrent states are in the "
            "batch, or a feed-forward network."
        )


def parameters_of(loss: LossModule, network: str) -> TensorDictBase | None:
    """The parameters that a loss stores separately from a network; ``None`` if in the network."""
    return getattr(loss, f"{network}_params", None) if loss.functional else None


def is_ensemble(loss: LossModule, network: str) -> bool:
    """Checks whether the loss has expanded a network to an ensemble."""
    params = parameters_of(loss, network)
    return params is not None and params.ndim > 0
