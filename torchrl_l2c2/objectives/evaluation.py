"""How the networks of a loss are evaluated at a batch's states and at others in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from threading import get_ident
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.compiler import is_compiling
from torch.distributions import Distribution, Independent
from torchrl.envs.utils import set_exploration_type
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

from torchrl_l2c2.objectives.precision import as_parameters, autocast_at, in_full_precision
from torchrl_l2c2.objectives.wiring import POLICY_NETWORK, Wiring, parameters_of, wiring_of

Policy = Distribution | Tensor
"""A policy at some states: a distribution or, where it is deterministic, its actions."""

ONE_PASS_STATES = 256
"""Up to so many states, a batch and the other states share a pass over a network when compiled.

There a pass through a small network costs what calling it costs; in larger batches arithmetic
decides, and two passes stay nearer to the caches.
"""


@dataclass
class ForwardPass:
    """What one forward pass of a loss has evaluated and made so far."""

    at_batch: dict[str, TensorDictBase] = field(default_factory=dict)
    """A network's outputs at the batch's states, ``[*B]``."""
    at_others: dict[str, tuple[TensorDictBase, TensorDictBase]] = field(default_factory=dict)
    """Other states, ``[K, *B]``, and a network's outputs there, with an ensemble's dimension."""
    made: dict[str, Any] = field(default_factory=dict)
    """What regularizers make once for all their terms."""


class EvaluatedNetworks:
    """The networks of a loss that are evaluated, and what a forward pass shares of it.

    Methods take the loss itself, so that this object, one of its attributes, does not refer back.

    Args:
        wiring (dict, optional): what is known of networks that were wired before.
    """

    def __init__(self, wiring: dict[str, Wiring] | None = None) -> None:
        self.wiring = {} if wiring is None else dict(wiring)
        self._forward_passes: dict[int, ForwardPass] = {}

    @property
    def forward_pass(self) -> ForwardPass | None:
        """What this thread's forward pass shares; ``None`` outside of one."""
        return self._forward_passes.get(_thread())

    def begin_forward_pass(self) -> ForwardPass | None:
        """From here on evaluations are shared; the pass that this one lies in, to end it with."""
        outer = self.forward_pass
        self._forward_passes[_thread()] = ForwardPass()
        return outer

    def end_forward_pass(self, outer: ForwardPass | None) -> None:
        """What was shared is forgotten; the outer pass goes on, if a loss called itself."""
        if outer is None:
            del self._forward_passes[_thread()]
        else:
            self._forward_passes[_thread()] = outer

    def wire(self, loss: LossModule, networks: Iterable[str]) -> None:
        """Finds out how these networks are evaluated; refuses those that cannot be."""
        self.wiring = {name: wiring_of(loss, name) for name in networks}
        if any(wiring.trunk for wiring in self.wiring.values()):
            self.wiring[POLICY_NETWORK] = wiring_of(loss, POLICY_NETWORK)

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
        return self._policy(loss, here), self._policy(loss, there)

    def policy_at(
        self,
        loss: LossModule,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        network: str = POLICY_NETWORK,
    ) -> Policy:
        """The policy at other states alone, ``[K, *B]``, by a pass that nothing else shares.

        Or a network that was copied from it, by its name: a regularizer's own.
        """
        rows = self._rows(POLICY_NETWORK, tensordict, states, with_batch=False)
        out = self._evaluate(loss, network, rows)
        (there,) = _split(out, 0, [len(states)], tensordict)
        return self._policy(loss, there)

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

        Not of inputs that hang on an encoder, which a regularizer does not train. Compiled, small
        batches are evaluated together with the other states, where these are known by now: that
        differs by rounding, and so it is left to where compiling does anyway.
        """
        wiring = self.wiring.get(network)
        if self.forward_pass is None or wiring is None or _requires_grad(tensordict, wiring.inputs):
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

    def _policy(self, loss: LossModule, outputs: TensorDictBase) -> Policy:
        wiring = self.wiring[POLICY_NETWORK]
        if not wiring.stochastic:
            return outputs.get(wiring.output)
        policy: Distribution = getattr(loss, POLICY_NETWORK).build_dist_from_params(outputs)
        separate = len(policy.batch_shape) > outputs.batch_dims and not policy.event_shape
        if separate and not policy.has_enumerate_support:
            return Independent(policy, 1)  # Its actions' dimensions, as of torch's plain Normal.
        return policy

    def _fits_one_pass(self, network: str, tensordict: TensorDictBase) -> bool:
        wiring = self.wiring[network]
        if wiring.trunk or wiring.has_buffers or not wiring.rowwise:
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
            rows.update(hidden if wiring.trains_trunk else hidden.detach())
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
        net, wiring = getattr(loss, network), self.wiring.get(network)
        params = parameters_of(loss, network)
        parameters = net.parameters() if params is None else params.values(True, True)
        rows = as_parameters(rows.select(*net.in_keys, strict=False), parameters)
        if wiring is not None and wiring.has_buffers:
            # Running statistics are the loss's own: spare copies take the update.
            params = TensorDict.from_module(net) if params is None else params
            params = params.apply(lambda p: p if p.requires_grad else p.clone())
        policy = wiring is None or network == POLICY_NETWORK  # or a copy of it, which is not wired
        run = net.get_dist_params if policy and self.wiring[POLICY_NETWORK].stochastic else net
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


def _requires_grad(tensordict: TensorDictBase, keys: Iterable[NestedKey]) -> bool:
    inputs = tensordict.select(*keys, strict=False).values(True, True)
    return any(value.requires_grad for value in inputs)


def is_ensemble(loss: LossModule, network: str) -> bool:
    """Whether the loss has expanded a network's parameters to those of several."""
    params = parameters_of(loss, network)
    return params is not None and params.ndim > 0


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


def _thread() -> int:
    # get_ident does not compile, and need not: a pass begins and ends while it is traced.
    return 0 if is_compiling() else get_ident()
