"""How the networks of a loss are evaluated at a batch's states and at others in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule
from torch import Tensor, nn
from torch.compiler import is_compiling
from torch.distributions import Distribution
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import Delta, GRUModule, LSTMModule, TanhDelta
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

from torchrl_l2c2.objectives.precision import autocast_at, in_full_precision

Policy = Distribution | Tensor
"""A policy at some states: a distribution or, where it is deterministic, its actions."""

POLICY_NETWORK = "actor_network"
"""The name under which losses hold their policy."""

VALUE_NETWORKS = ("critic_network", "qvalue_network", "value_network", "local_value_network")
"""The names under which losses hold their value functions."""

ONE_PASS_STATES = 256
"""Up to so many states, a batch and the other states share a pass over a network when compiled.

There a pass through a small network costs what calling it costs; in larger batches arithmetic
decides, and two passes stay nearer to the caches.
"""

# The vector of an ensemble, or of all actions, comes before the one number made of it.
_VALUE_KEYS = ("value_heads", "state_action_value", "action_value", "value")


@dataclass(frozen=True)
class Wiring:
    """What is to be known of a network to evaluate it at states of our own."""

    inputs: tuple[NestedKey, ...]  # what the evaluation reads from the batch
    states: tuple[NestedKey, ...]  # those inputs that are states
    trunk: tuple[NestedKey, ...]  # inputs that are hidden outputs of the policy network
    output: NestedKey | None  # a value function's value, a deterministic policy's action
    stochastic: bool
    has_buffers: bool
    rowwise: bool  # an output depends on its own row alone, and on no random numbers


@dataclass
class ForwardPass:
    """What one forward pass of a loss has evaluated and made so far."""

    at_batch: dict[str, TensorDictBase] = field(default_factory=dict)
    """A network's outputs at the batch's states, ``[*B]``."""
    at_others: dict[str, tuple[TensorDictBase, TensorDictBase]] = field(default_factory=dict)
    """Other states, ``[K, *B]``, and a network's outputs there, with an ensemble's dimension."""
    made: dict[str, Any] = field(default_factory=dict)
    """What regularizers make once for all their terms."""


class Evaluation:
    """The networks of a loss that are evaluated, and what a forward pass shares of it.

    Methods take the loss itself, so that this object, one of its attributes, does not refer back.

    Args:
        wiring (dict, optional): what is known of networks that were wired before.
    """

    def __init__(self, wiring: dict[str, Wiring] | None = None) -> None:
        self.wiring = {} if wiring is None else dict(wiring)
        self.forward_pass: ForwardPass | None = None

    def wire(self, loss: LossModule, networks: Iterable[str]) -> None:
        """Finds out how these networks are evaluated; refuses those that cannot be."""
        self.wiring = {name: _wiring(loss, name) for name in networks}
        if any(wiring.trunk for wiring in self.wiring.values()):
            self.wiring[POLICY_NETWORK] = _wiring(loss, POLICY_NETWORK)

    def policies_at(
        self,
        loss: LossModule,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        rows: Tensor | None = None,
    ) -> tuple[Policy, Policy]:
        """The policy at the batch's states and at others, both ``[K, *B]``.

        With ``rows``, ``[M]``, at these of the batch's states, written as one row, and at others in
        their place, ``[K, M]``; likewise for the values.
        """
        actor, wiring = getattr(loss, POLICY_NETWORK), self.wiring[POLICY_NETWORK]
        keys = actor.dist_params_keys if wiring.stochastic else [wiring.output]
        here, there = self._outputs_at(loss, POLICY_NETWORK, tensordict, states, keys, rows)
        here = here.expand(states.batch_size)
        if wiring.stochastic:
            return actor.build_dist_from_params(here), actor.build_dist_from_params(there)
        return here.get(wiring.output), there.get(wiring.output)

    def values_at(
        self,
        loss: LossModule,
        network: str,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        rows: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """A value function at the batch's states, ``[1, *B, ...]``, and at others, ``[K, ...]``."""
        key = self.wiring[network].output
        if key is None:
            # Not earlier: set_keys may come after the wrapping, as after the making of any loss.
            raise ValueError(
                f"{network} writes {list(getattr(loss, network).out_keys)}, and none of it is a "
                f"value to this loss, whose keys are {loss.tensor_keys}: name it with set_keys."
            )
        here, there = self._outputs_at(loss, network, tensordict, states, [key], rows)
        return here.get(key), there.get(key)

    def at_batch(
        self,
        loss: LossModule,
        network: str,
        tensordict: TensorDictBase,
        evaluate: Callable[[str, TensorDictBase], TensorDictBase],
        known_states: Callable[[TensorDictBase], TensorDictBase | None],
    ) -> TensorDictBase:
        """Evaluates a network as the loss does, and keeps the result for the forward pass.

        Compiled, small batches are evaluated together with the other states, where these are known
        by now: that differs by rounding, and so it is left to where compiling does anyway.
        """
        if self.forward_pass is None:
            return evaluate(network, tensordict)
        states = None
        alone = not is_compiling() or autocast_at(tensordict)
        if not alone and self._fits_one_pass(network, tensordict):
            states = known_states(tensordict)
        if states is None:
            here = evaluate(network, tensordict)
        else:
            rows = self._rows(network, tensordict, states, with_batch=True)
            dim = int(is_ensemble(loss, network))
            here, there = _split(evaluate(network, rows), dim, [1, len(states)], tensordict)
            here = here.squeeze(dim)
            self.forward_pass.at_others[network] = states, there
        self.forward_pass.at_batch[network] = here
        return here

    def _fits_one_pass(self, network: str, tensordict: TensorDictBase) -> bool:
        wiring = self.wiring.get(network)
        if wiring is None or wiring.trunk or wiring.has_buffers or not wiring.rowwise:
            return False
        inputs = tensordict.select(*wiring.inputs, strict=False).values(True, True)
        if any(value.requires_grad for value in inputs):
            return False
        return tensordict.ndim == 1 and tensordict.numel() <= ONE_PASS_STATES

    def _outputs_at(
        self,
        loss: LossModule,
        network: str,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        keys: Iterable[NestedKey],
        chosen: Tensor | None,
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """A network's outputs at the batch's states, ``[1, *B]``, and at others, ``[K, *B]``."""
        shared = self.forward_pass
        if shared is None or autocast_at(states):
            shared = ForwardPass()  # What the loss has evaluated is rounded.
        wiring, known = self.wiring[network], shared.at_batch.get(network)
        dim, num = int(is_ensemble(loss, network)), len(states)
        if chosen is not None:
            known = None if known is None else at_rows(known.select(*keys), chosen, dim)
            tensordict = at_rows(tensordict.select(*wiring.inputs, strict=False), chosen)
        evaluated, there = shared.at_others.get(network, (None, None))
        if evaluated is states and known is not None and there is not None:
            return known.select(*keys).unsqueeze(dim), there.select(*keys)
        rows = self._rows(network, tensordict, states, with_batch=known is None)
        if wiring.trunk:
            hidden = self._evaluate(loss, POLICY_NETWORK, rows).select(*wiring.trunk)
            rows.update(hidden.detach() if getattr(loss, "separate_losses", False) else hidden)
        out = self._evaluate(loss, network, rows).select(*keys)
        if known is None:
            return _split(out, dim, [1, num], tensordict)
        return known.select(*keys).unsqueeze(dim), _split(out, dim, [num], tensordict)[0]

    def _rows(
        self, network: str, tensordict: TensorDictBase, states: TensorDictBase, with_batch: bool
    ) -> TensorDictBase:
        """A network's inputs at the batch's states and at the others: ``[(1 + K) * B0, ...]``."""
        wiring, batch = self.wiring[network], tensordict.batch_size
        # The batch's action may still hang on the policy that made it.
        inputs = tensordict.select(*wiring.inputs, strict=False).detach()
        moved = {key: states.get(key, None) for key in wiring.inputs}
        moved = {key: state for key, state in moved.items() if state is not None}
        if not moved:
            raise KeyError(
                f"none of the inputs of {network}, {list(wiring.inputs)}, is among the states to "
                f"compare, {list(states.keys(True, True))}: name its observation in the in_keys "
                "of the transform that wrote them."
            )
        rows = inputs.expand(states.batch_size[0] + with_batch, *batch)
        for key, state in moved.items():
            here = inputs.get(key).unsqueeze(0)
            rows.set(key, torch.cat((here, state)) if with_batch else state)
        return rows.flatten(0, 1) if batch else rows

    def _evaluate(self, loss: LossModule, network: str, rows: TensorDictBase) -> TensorDictBase:
        net, wiring = getattr(loss, network), self.wiring[network]
        rows = rows.select(*net.in_keys, strict=False)
        params = _parameters_of(loss, network)
        if wiring.has_buffers:
            # Running statistics are the loss's own: spare copies take the update.
            params = TensorDict.from_module(net) if params is None else params
            params = params.apply(lambda p: p if p.requires_grad else p.clone())
        run = net.get_dist_params if network == POLICY_NETWORK and wiring.stochastic else net
        with set_exploration_type(loss.deterministic_sampling_mode), in_full_precision(rows):
            if params is None:
                return run(rows)
            if not params.ndim:
                with params.to_module(net, preserve_module_state=False):
                    return run(rows)
            return _vmap_func(
                net,
                (None, 0),
                randomness=loss.vmap_randomness,
                pseudo_vmap=getattr(loss, "deactivate_vmap", False),
            )(rows, params)


def is_ensemble(loss: LossModule, network: str) -> bool:
    """Whether the loss has expanded a network's parameters to those of several."""
    params = _parameters_of(loss, network)
    return params is not None and params.ndim > 0


def _parameters_of(loss: LossModule, network: str) -> TensorDictBase | None:
    return getattr(loss, f"{network}_params", None) if loss.functional else None


def at_rows(tensordict: TensorDictBase, rows: Tensor, dim: int = 0) -> TensorDictBase:
    """Some rows of a batch ``[*B]``, behind ``dim`` other dimensions, written as one row."""
    if tensordict.ndim > dim + 1:
        tensordict = tensordict.flatten(dim, tensordict.ndim - 1)
    return tensordict[:, rows] if dim else tensordict[rows]


def _split(
    out: TensorDictBase, dim: int, parts: list[int], tensordict: TensorDictBase
) -> tuple[TensorDictBase, ...]:
    """Outputs at rows, by what the rows are: ``[part, *B]``, behind ``dim`` other dimensions."""
    if tensordict.batch_size:
        # Explicit sizes: an inferred one does not compile.
        out = out.unflatten(dim, (sum(parts), tensordict.batch_size[0]))
    return out.split(parts, dim)


def _wiring(loss: LossModule, network: str) -> Wiring:
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
            actions = actor.out_keys[-1:]
    trunk = [key for key in net.in_keys if key in made - set(actions)]
    inputs = dict.fromkeys([*net.in_keys, *(actor.in_keys if trunk and actor is not None else ())])
    if network == POLICY_NETWORK:
        output = next((key for key in actions if key in made), None)
    else:
        output = _value_key(loss, network)
    return Wiring(
        inputs=tuple(key for key in inputs if key not in trunk),
        states=tuple(key for key in inputs if key not in made.union(actions)),
        trunk=tuple(trunk),
        output=output,
        stochastic=stochastic,
        has_buffers=_has_buffers(loss, network),
        rowwise=not any(isinstance(m, _BatchNorm | _DropoutNd) for m in net.modules()),
    )


def _action_keys(loss: LossModule) -> list[NestedKey]:
    keys = getattr(loss.tensor_keys, "action", [])
    return [unravel_key(key) for key in (keys if isinstance(keys, list) else [keys])]


def _value_key(loss: LossModule, network: str) -> NestedKey | None:
    # A network's name does not tell what it is: a value_network is V, Q or a vector of Q.
    keys = (getattr(loss.tensor_keys, name, None) for name in _VALUE_KEYS)
    written = getattr(loss, network).out_keys
    return next((key for key in keys if key and unravel_key(key) in written), None)


def _has_buffers(loss: LossModule, network: str) -> bool:
    params = _parameters_of(loss, network)
    if params is None:
        return any(True for _ in getattr(loss, network).buffers())
    return not all(isinstance(p, nn.Parameter) for p in params.values(True, True))


def _is_stochastic(actor: nn.Module) -> bool:
    classes = {
        module.distribution_class
        for module in actor.modules()
        if isinstance(module, ProbabilisticTensorDictModule)
    }
    if classes <= {Delta, TanhDelta}:
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
    recurrent = any(isinstance(module, LSTMModule | GRUModule) for module in net.modules())
    if recurrent or "is_init" in net.in_keys:
        raise TypeError(
            f"{name} is recurrent: its output depends on the states before, so that it has no "
            "value at a state near the current one alone. Only feed-forward networks can be "
            "regularized."
        )
