"""Evaluation of the networks of a loss at the states of a batch and at other states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from threading import get_ident
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.compiler import is_compiling
from torch.distributions import Distribution, Independent
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

from torchrl_l2c2.objectives._batch import at_rows
from torchrl_l2c2.objectives._networks import (
    POLICY_NETWORK,
    NetworkSpec,
    drops_out,
    inspect_network,
    is_ensemble,
    parameters_of,
)
from torchrl_l2c2.objectives._specialize import LossMixin

Policy = Distribution | Tensor
"""A policy at some states: a distribution or, for a deterministic policy, its actions."""

ONE_PASS_STATES = 256
"""Largest batch that a compiled loss evaluates in one pass with the other states.

In small batches the cost of a pass is the cost of the call. In larger batches arithmetic dominates,
and two passes use the caches better.
"""


@dataclass
class ForwardPass:
    """Cache of one forward pass of a loss."""

    at_batch: dict[str, TensorDictBase] = field(default_factory=dict)
    """Outputs at the batch's states, ``[*B]``, by network."""
    at_others: dict[str, tuple[TensorDictBase, TensorDictBase]] = field(default_factory=dict)
    """Other states, ``[K, *B]``, and outputs there, by network."""
    made: dict[str, Any] = field(default_factory=dict)
    """Results that the terms of a regularizer share, by name."""
    policy_size: Tensor | None = None
    """Mean absolute value of the loss's own policy term, if it was measured."""


class EvaluatedNetworks:
    """Evaluates the networks of a loss, with a cache for each forward pass.

    Methods take the loss as an argument: this object is an attribute of the loss and must not refer
    back to it.

    Args:
        specs (dict, optional): specs of networks that were inspected before.
    """

    def __init__(self, specs: dict[str, NetworkSpec] | None = None) -> None:
        self.specs = {} if specs is None else dict(specs)
        self._forward_passes: dict[int, ForwardPass] = {}
        self._sizes: dict[int, list[Tensor]] = {}
        self._repeatable: set[str] = set()

    @property
    def forward_pass(self) -> ForwardPass | None:
        """The cache of this thread's forward pass; ``None`` outside of a forward pass."""
        return self._forward_passes.get(_thread())

    def begin_forward_pass(self) -> ForwardPass | None:
        """Starts sharing evaluations; returns the outer pass, for :meth:`end_forward_pass`."""
        outer = self.forward_pass
        self._forward_passes[_thread()] = ForwardPass()
        return outer

    def end_forward_pass(self, outer: ForwardPass | None) -> None:
        """Clears the cache, and restores the outer pass if a loss called itself."""
        if outer is None:
            del self._forward_passes[_thread()]
        else:
            self._forward_passes[_thread()] = outer

    @property
    def sizes(self) -> list[Tensor] | None:
        """The sizes of the terms that this thread reduces; ``None`` outside of a measurement."""
        return self._sizes.get(_thread())

    def measure(self, call: Callable[[], Any]) -> tuple[Any, list[Tensor]]:
        """Calls a method of the loss; returns its result and the sizes of the reduced terms."""
        outer = self.sizes
        sizes: list[Tensor] = []
        self._sizes[_thread()] = sizes
        try:
            result = call()
        finally:
            if outer is None:
                del self._sizes[_thread()]
            else:  # The method was called by another one.
                self._sizes[_thread()] = outer
                outer.extend(sizes)
        return result, sizes

    def kept(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The batch as it is before the loss evaluates its networks on it.

        In sequences, recurrent modules write zeros over most of the next recurrent states.
        """
        overwrites = any(spec.overwrites for spec in self.specs.values())
        return tensordict.copy() if overwrites else tensordict

    def inspect(self, loss: LossModule, networks: Iterable[str]) -> None:
        """Inspects these networks; refuses networks that cannot be evaluated at other states."""
        self.specs = {name: inspect_network(loss, name) for name in networks}
        if any(spec.trunk for spec in self.specs.values()):
            self.specs[POLICY_NETWORK] = inspect_network(loss, POLICY_NETWORK)

    def policies_at(
        self,
        loss: LossModule,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        rows: Tensor | None = None,
    ) -> tuple[Policy, Policy]:
        """Evaluates the policy at the batch's states and at other states, both ``[K, *B]``.

        With ``rows``, indices ``[M]`` in the flattened batch, it evaluates only these states and
        the other states, ``[K, M]``. The same holds for :meth:`values_at`.
        """
        self._check_declared(POLICY_NETWORK)
        actor, spec = getattr(loss, POLICY_NETWORK), self.specs[POLICY_NETWORK]
        keys = actor.dist_params_keys if spec.stochastic else [spec.output]
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
        """Evaluates the policy, or a copy, at other states only, ``[K, *B]``, without the cache."""
        self._check_declared(POLICY_NETWORK)
        rows = self._rows(POLICY_NETWORK, tensordict, states, with_batch=False)
        if network == POLICY_NETWORK:
            self._check_repeatable(loss, network, rows)
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
        """Values at the batch's states, ``[1, *B, ...]``, and at others, ``[K, *B, ...]``."""
        self._check_declared(network)
        key = self.specs[network].output
        if key is None:
            # Not earlier: set_keys may be called after the wrapping.
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
        """Evaluates a network as the loss does, and caches the result for the forward pass.

        Results are not cached if the inputs have a gradient: a regularizer does not train encoders.
        Nor are they if the network reads hidden outputs of the policy: those in the batch may be of
        an older policy, and those at other states are of the present one.
        Nor are they if the network normalizes by its batch, or keeps running statistics: only the
        states of one evaluation are normalized alike.
        Nor are they if the network is recurrent: the loss evaluates sequences of states.
        Compiled losses evaluate small batches together with the other states, if these are known.
        This changes the rounding, as compiling does; eager losses do not do it.
        """
        spec = self.specs.get(network)
        if self.forward_pass is None or spec is None or _requires_grad(tensordict, spec.inputs):
            return evaluate(network, tensordict)
        # Dropout is not rowwise: the loss evaluates with it, a regularizer without. A loss that is
        # not functional is rsl_rl's, whose statistics do not change in a forward pass.
        if not spec.rowwise or spec.trunk or (spec.has_buffers and loss.functional):
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

    def _check_declared(self, network: str) -> None:
        if network not in self.specs:
            raise TypeError(
                f"{network} is not declared: call self.declare_networks([{network!r}]) in __init__."
            )

    def _policy(self, loss: LossModule, outputs: TensorDictBase) -> Policy:
        spec = self.specs[POLICY_NETWORK]
        if not spec.stochastic:
            return outputs.get(spec.output)
        policy: Distribution = getattr(loss, POLICY_NETWORK).build_dist_from_params(outputs)
        separate = len(policy.batch_shape) > outputs.batch_dims and not policy.event_shape
        if separate and not policy.has_enumerate_support:
            return Independent(policy, 1)  # The action's dimensions, as with torch's Normal.
        return policy

    def _fits_one_pass(self, network: str, tensordict: TensorDictBase) -> bool:
        spec = self.specs[network]
        if spec.trunk or spec.has_buffers:
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
            shared = ForwardPass()  # The loss's own evaluation is rounded.
        spec, known = self.specs[network], shared.at_batch.get(network)
        dim, num = int(is_ensemble(loss, network)), len(states)
        if chosen is not None:
            known = None if known is None else at_rows(known.select(*keys), chosen, dim)
            tensordict = at_rows(tensordict.select(*spec.inputs, strict=False), chosen)
        evaluated, there = shared.at_others.get(network, (None, None))
        if evaluated is states and known is not None and there is not None:
            return known.select(*keys).unsqueeze(dim), there.select(*keys)
        rows = self._rows(network, tensordict, states, with_batch=known is None)
        self._check_repeatable(loss, network, rows)
        if spec.trunk:
            hidden = self._evaluate(loss, POLICY_NETWORK, rows).select(*spec.trunk)
            rows.update(hidden if spec.trains_trunk else hidden.detach())
        out = self._evaluate(loss, network, rows).select(*keys)
        if known is None:
            return _split(out, dim, [1, num], tensordict)
        return known.select(*keys).unsqueeze(dim), _split(out, dim, [num], tensordict)[0]

    def _check_repeatable(self, loss: LossModule, network: str, rows: TensorDictBase) -> None:
        """Refuses a network that draws random numbers; checks the first eager evaluation only.

        The distance between two evaluations would measure these numbers, even at equal states.
        Dropout is off here. Noise that a layer keeps between calls is harmless.

        Raises:
            TypeError: two evaluations of the same states differ.
        """
        spec = self.specs[network]
        if network in self._repeatable or is_compiling() or spec.trunk or not len(rows):
            return
        some = rows[:8]
        devices = {value.device for value in some.values(True, True) if value.is_cuda}
        with torch.random.fork_rng(devices), torch.no_grad():
            first, second = (self._evaluate(loss, network, some.clone()) for _ in range(2))
        if spec.stochastic and network == POLICY_NETWORK:
            keys = getattr(loss, network).dist_params_keys
        else:
            keys = [spec.output]
        for key in keys:
            a, b = first.get(key), second.get(key)
            if isinstance(a, Tensor) and not torch.allclose(
                a.double(), b.double(), rtol=1e-3, atol=1e-5, equal_nan=True
            ):
                raise TypeError(
                    f"{network} gives two different outputs for the same states: it draws random "
                    "numbers in its forward pass, and a regularizer would measure these. Make the "
                    "random numbers an input of the network, or draw them outside of it."
                )
        self._repeatable.add(network)

    def _rows(
        self, network: str, tensordict: TensorDictBase, states: TensorDictBase, with_batch: bool
    ) -> TensorDictBase:
        """A network's inputs at the batch's and the other states, ``[(1 + K) * B0, ...]``."""
        spec, batch = self.specs[network], tensordict.batch_size
        if states.batch_size[1:] != batch:
            raise ValueError(
                f"states must have the shape [K, *B] with the batch's {list(batch)}, got "
                f"{list(states.batch_size)}: states[None] has one state for each row."
            )
        if lacking := [key for key in spec.recurrent if tensordict.get(key, None) is None]:
            raise KeyError(
                f"{network} is recurrent, and the batch has no {lacking}: keep the recurrent state "
                "of every step, and is_init (TensorDictPrimer and InitTracker write them)."
            )
        # The batch's action may have a gradient of the behavior policy.
        inputs = tensordict.select(*spec.inputs, strict=False).detach()
        moved = {key: states.get(key, None) for key in spec.inputs}
        moved = {key: state for key, state in moved.items() if state is not None}
        if not moved:
            raise KeyError(
                f"none of the inputs of {network}, {list(spec.inputs)}, is among the states to "
                f"compare, {list(states.keys(True, True))}: name its observation in the in_keys "
                "of the transform that wrote them. If that was another loss's transform, choose "
                "another neighbor_key for this loss."
            )
        rows = inputs.expand(states.batch_size[0] + with_batch, *batch)
        for key, state in moved.items():
            here = inputs.get(key).unsqueeze(0)
            rows.set(key, torch.cat((here, state)) if with_batch else state)
        return rows.flatten(0, 1) if batch else rows

    def _evaluate(self, loss: LossModule, network: str, rows: TensorDictBase) -> TensorDictBase:
        net, spec = getattr(loss, network), self.specs.get(network)
        params = parameters_of(loss, network)
        parameters = net.parameters() if params is None else params.values(True, True)
        rows = as_parameters(rows.select(*net.in_keys, strict=False), parameters)
        if spec is not None and spec.has_buffers:
            # Copies take the update of running statistics, which belong to the loss.
            params = TensorDict.from_module(net) if params is None else params
            params = params.apply(lambda p: p if p.requires_grad else p.clone())
        policy = spec is None or network == POLICY_NETWORK  # a copy of the policy has no spec
        run = net.get_dist_params if policy and self.specs[POLICY_NETWORK].stochastic else net
        dropout_off = without_dropout(net) if spec is None or spec.has_dropout else nullcontext()
        exploration = set_exploration_type(loss.deterministic_sampling_mode)
        # Rows are single steps from the recurrent states of the batch.
        recurrent = spec is not None and spec.recurrent
        single_steps = set_recurrent_mode(False) if recurrent else nullcontext()
        with exploration, single_steps, in_full_precision(rows), dropout_off:
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


def _split(
    out: TensorDictBase, dim: int, parts: list[int], tensordict: TensorDictBase
) -> tuple[TensorDictBase, ...]:
    """Splits outputs into parts ``[part, *B]``, behind ``dim`` other dimensions."""
    if tensordict.batch_size:
        # Explicit sizes: an inferred one does not compile.
        out = out.unflatten(dim, (sum(parts), tensordict.batch_size[0]))
    return out.split(parts, dim)


@torch.compiler.assume_constant_result  # Dynamo does not trace get_ident.
def _thread() -> int:
    """The thread; after a graph break, eager code must find what compiled code has begun."""
    return get_ident()


class SharedEvaluation(LossMixin):
    """A loss that evaluates its networks at the batch's states through one method.

    It saves time: :class:`RegularizedLoss` overrides :meth:`evaluate_at_batch`, caches the result
    for the forward pass, and evaluates the network at the other states only. To use it, inherit
    from this class and evaluate the networks with :meth:`evaluate_at_batch`, as :class:`PPORPELoss`
    does. Other losses also work, with one more evaluation of their networks.

    Examples:
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2.objectives import SharedEvaluation
        >>> class ThriftyLoss(DDPGLoss, SharedEvaluation):
        ...     def evaluate_at_batch(self, network, tensordict):
        ...         net = getattr(self, network)
        ...         with getattr(self, f"{network}_params").to_module(net):
        ...             return net(tensordict.select(*net.in_keys))
        ...
        ...     def loss_value(self, tensordict):
        ...         value = self.evaluate_at_batch("value_network", tensordict)
        ...         return value["state_action_value"].square().mean(), {}
    """

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluates a network at the batch's states.

        The result must depend only on the given tensordict: when compiled, the method may be called
        with rows of the batch and of other states together.

        Args:
            network (str): name of the network, such as ``"actor_network"``.
            tensordict (TensorDictBase): the batch, ``[*B]``.

        Returns:
            TensorDictBase: the outputs, ``[*B]``; for a stochastic policy, the result of
            ``get_dist_params``.
        """
        raise NotImplementedError


def autocast_at(tensordict: TensorDictBase) -> str | None:
    """The device type of the entries, such as ``"cuda"``, if autocast is on; else ``None``."""
    kinds = {value.device.type for value in tensordict.values(True, True)}
    return next((kind for kind in kinds if torch.is_autocast_enabled(kind)), None)


def in_full_precision(tensordict: TensorDictBase) -> AbstractContextManager[object]:
    """A context without autocast on the device of the entries.

    A regularizer compares outputs at states that are close together. bfloat16 has 8 bits: a
    difference of 1% is mostly lost, and a difference of 0.1% is smaller than the rounding error.
    """
    kind = autocast_at(tensordict)
    return nullcontext() if kind is None else torch.autocast(kind, enabled=False)


@contextmanager
def without_dropout(net: nn.Module) -> Iterator[None]:
    """A context in which the dropout layers of a network are off.

    With dropout, two evaluations of one state differ, and a distance would measure the difference.
    """
    layers = [m for m in net.modules() if drops_out(m) and m.training]
    # cuDNN differentiates recurrent layers only in training mode.
    recurrent = [(m, m.dropout) for m in layers if isinstance(m, nn.RNNBase)]
    others = [m for m in layers if not isinstance(m, nn.RNNBase)]
    for rnn, _ in recurrent:
        rnn.dropout = 0.0
    for layer in others:
        layer.training = False
    try:
        yield
    finally:
        for rnn, dropout in recurrent:
            rnn.dropout = dropout
        for layer in others:
            layer.training = True


def as_parameters(rows: TensorDictBase, parameters: Iterable[Tensor]) -> TensorDictBase:
    """Casts inputs to the precision of the parameters, if autocast would have done so."""
    if autocast_at(rows) is None:
        return rows
    # A list: a partly consumed generator does not compile.
    dtypes = [p.dtype for p in parameters if p.is_floating_point()]
    # Autocast does not change double precision either.
    wanted = {torch.float16, torch.bfloat16, torch.float32}
    return rows.apply(lambda v: v.to(dtypes[0]) if dtypes and v.dtype in wanted else v)
