"""The one way of wrapping a loss: a subclass made for its class, working on its very state."""

from __future__ import annotations

import copy
import functools
import math
import types
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torch.compiler import is_compiling
from torch.distributions import Distribution
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import Delta, GRUModule, LSTMModule, TanhDelta
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

Policy = Distribution | Tensor
"""A policy at some states: a distribution or, where it is deterministic, its actions."""

POLICY_NETWORK = "actor_network"
VALUE_NETWORKS = ("critic_network", "qvalue_network", "value_network", "local_value_network")
# The vector of an ensemble, or of all actions, comes before the one number made of it.
_VALUE_KEYS = ("value_heads", "state_action_value", "action_value", "value")
# Up to so many states, a pass through a small network costs what calling it costs; in larger
# batches arithmetic decides, and two passes stay nearer to the caches.
ONE_PASS_STATES = 256

# What nn.Module itself keeps: dictionaries that two losses must not share.
_REGISTRIES = frozenset(vars(nn.Module()))


@dataclass(frozen=True)
class _Wiring:
    """What is to be known of a network to evaluate it at states of our own."""

    inputs: tuple[NestedKey, ...]  # what the evaluation reads from the batch
    states: tuple[NestedKey, ...]  # those inputs that are states
    trunk: tuple[NestedKey, ...]  # inputs that are hidden outputs of the policy network
    output: NestedKey | None  # a value function's value, a deterministic policy's action
    stochastic: bool
    has_buffers: bool
    rowwise: bool  # an output depends on its own row alone, and on no random numbers


class RegularizedLoss(LossModule):
    """A TorchRL loss with further terms: what every regularizer of this package builds on.

    ``Regularizer(loss, ...)`` returns an instance of ``Regularizer[type(loss)]``, a subclass of
    both classes that is made once for each pair. It is a full member of the loss's class: updaters,
    ``set_keys``, ``select_out_keys``, scheduled coefficients, ``deepcopy`` and checkpoints work as
    before, and its ``state_dict`` has the keys of the plain loss's. It holds the networks,
    parameters and buffers of ``loss`` themselves, not copies, and ``loss`` stays the plain loss.
    From then on, move or cast the regularized one.

    ``forward`` returns the loss's own terms, unchanged (compiled: to rounding), and the
    regularizer's. Loops that call
    ``actor_loss`` and ``value_loss`` themselves add :meth:`policy_regularizer` and
    :meth:`value_regularizer`.

    A regularizer is a subclass that defines ``__init__`` and one or both of these methods. When its
    ``__init__`` runs, the object already is the loss: no other constructor is to be called.
    Regularizers can be applied to one another's results.

    .. note:: Losses that are not trained on transitions, and recurrent policies, are refused.
        Networks are evaluated in the mode they are in, so dropout makes two evaluations of one
        state differ. Running statistics of normalization layers are left alone.

    Args:
        base_loss (LossModule): the loss.

    Raises:
        TypeError: the loss cannot be regularized, or already is by this regularizer.

    Examples:
        >>> import torch
        >>> from torchrl.modules import MLP, Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2 import RegularizedLoss
        >>> class StillnessLoss(RegularizedLoss):
        ...     _schedulable_buffers = frozenset({"stillness_coeff"})
        ...
        ...     def __init__(self, base_loss, coeff):
        ...         self._register_coefficient("stillness_coeff", coeff)
        ...         self._regularize(["actor_network"])
        ...         self.out_keys = [*self.out_keys, "loss_stillness"]
        ...
        ...     def policy_regularizer(self, tensordict):
        ...         terms = super().policy_regularizer(tensordict)
        ...         states = tensordict.select("observation")[None]
        ...         _, action = self._policies_at(tensordict, states)
        ...         cost = self._reduce_term(action.square().sum(-1).mean(0), tensordict)
        ...         return terms.set("loss_stillness", self.stillness_coeff * cost)
        >>> actor = Actor(torch.nn.Linear(3, 1))
        >>> value = ValueOperator(
        ...     MLP(in_features=4, out_features=1), in_keys=["observation", "action"]
        ... )
        >>> loss = StillnessLoss(DDPGLoss(actor, value), coeff=0.1)
        >>> type(loss).__name__, isinstance(loss, DDPGLoss), loss.out_keys[-1]
        ('StillnessLoss[DDPGLoss]', True, 'loss_stillness')
    """

    # Many losses compute these lists whenever they are read, which Dynamo cannot trace through
    # super(); here they are stored.
    in_keys = TensorDictModuleBase.in_keys
    out_keys = TensorDictModuleBase.out_keys

    _parts: tuple[type, ...] = ()
    _coefficients: frozenset[str] = frozenset()

    def __class_getitem__(cls, base_class: type[LossModule]) -> type[RegularizedLoss]:
        """The subclass of this regularizer and of ``base_class``."""
        if not (isinstance(base_class, type) and issubclass(base_class, LossModule)):
            raise TypeError(f"{cls.__name__}[...] takes a class of losses, got {base_class!r}.")
        return _specialize(cls, base_class)

    def __new__(cls, base_loss: LossModule, *args: Any, **kwargs: Any) -> RegularizedLoss:
        if not isinstance(base_loss, LossModule):
            raise TypeError(
                f"{cls.__name__} wraps a torchrl.objectives.LossModule, got a "
                f"{type(base_loss).__name__}."
            )
        specialized = cls if cls._parts else cls[type(base_loss)]
        if type(base_loss) not in specialized.__mro__:
            raise TypeError(f"{cls.__name__} cannot wrap a {type(base_loss).__name__}.")
        self = object.__new__(specialized)
        self._adopt(base_loss)
        return self

    def __reduce_ex__(self, protocol: int) -> tuple[Any, ...]:
        # A class made here has no name that can be imported; the classes that it is made of have.
        parts = vars(type(self)).get("_parts", (type(self),))
        return (_make_empty, parts, *super().__reduce_ex__(protocol)[2:])

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self._coefficients and not isinstance(value, Tensor):
            value = _check_coefficient(name, value)
            if name not in self._buffers:
                raise ValueError(
                    f"{name} has nothing to scale: this {type(self).__name__} was made without "
                    "the term. Make it with a gain above 0, which can be set to 0 later."
                )
        super().__setattr__(name, value)

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """As for the loss itself; what the regularizer reads follows."""
        super().set_keys(**kwargs)
        self.in_keys = super().in_keys
        self._wire(self._wiring)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss's own terms, then the regularizer's.

        Args:
            tensordict (TensorDictBase): the batch, as the loss itself takes it.

        Returns:
            TensorDict: the loss's own output with the regularizer's terms and diagnostics added.
        """
        self._evaluated["batch"] = tensordict
        try:
            # The loss's own draws come first: at one seed its terms are those of the plain loss.
            terms = super().forward(tensordict)
            batch = self._prepare(tensordict)
            terms.update(self.policy_regularizer(batch))
            terms.update(self.value_regularizer(batch))
        finally:
            self._evaluated.clear()
        self._clear_weakrefs(tensordict, batch, terms, *(f"{name}_params" for name in self._wiring))
        return terms

    def policy_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the policy, with their diagnostics; empty where there are none.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``actor_loss`` takes.

        Returns:
            TensorDict: ``loss_*`` entries, reduced as the loss's own, and detached diagnostics.
        """
        return TensorDict()

    def value_regularizer(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms that train the value functions, with their diagnostics.

        Args:
            tensordict (TensorDictBase): the batch that ``forward`` or ``value_loss`` takes.

        Returns:
            TensorDict: ``loss_*`` entries, reduced as the loss's own, and detached diagnostics.
        """
        return TensorDict()

    # For regularizers: declarations, made in __init__.

    def _register_coefficient(self, name: str, value: float, used: bool = True) -> None:
        """A gain that can be assigned to later on; its name is one of ``_schedulable_buffers``.

        Not persistent: the ``state_dict`` is to keep the keys of the plain loss's.
        """
        coefficient = torch.tensor(_check_coefficient(name, value), device=self._default_device)
        if used:
            self.register_buffer(name, coefficient, persistent=False)

    def _regularize(self, networks: Iterable[str]) -> None:
        """Declares which networks are evaluated; refuses those that cannot be."""
        self._wire([*self._wiring, *networks])

    def _policy_networks(self) -> list[str]:
        return [] if getattr(self, POLICY_NETWORK, None) is None else [POLICY_NETWORK]

    def _has_stochastic_policy(self) -> bool:
        return self._wiring[POLICY_NETWORK].stochastic

    def _value_networks(self) -> list[str]:
        """The value functions that the loss trains."""
        untrained = "critic_network" if getattr(self, "critic_coeff", 1.0) is None else None
        return [
            name
            for name in VALUE_NETWORKS
            if name != untrained and getattr(self, name, None) is not None
        ]

    # For regularizers: evaluations, made in the two methods.

    def _prepare(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The batch with what both methods are to share in one forward pass."""
        return tensordict

    def _transitions(
        self, tensordict: TensorDictBase, networks: Iterable[str]
    ) -> dict[NestedKey, tuple[Tensor, Tensor]]:
        """The states that networks read, with their successors.

        Inputs that are not floating point (masks, labels) or have no successor (goals) are not
        among them.
        """
        keys = dict.fromkeys(key for name in networks for key in self._wiring[name].states)
        tensordict = tensordict.select(*keys, *map(_next, keys), strict=False).detach()
        found = {key: tensordict.get(key, None) for key in keys}
        floating = {
            key: value
            for key, value in found.items()
            if isinstance(value, Tensor) and value.is_floating_point()
        }
        if not floating:
            kinds = {
                key: value.dtype if isinstance(value, Tensor) else type(value).__name__
                for key, value in found.items()
            }
            raise TypeError(
                f"{type(self).__name__} needs a floating-point observation among the inputs of "
                f"{', '.join(networks)}, got {kinds}: cast it in the environment, the collector or "
                "the replay buffer. A network that reads no observation has nothing to regularize."
            )
        successors = {key: tensordict.get(_next(key), None) for key in floating}
        pairs = {key: (floating[key], s) for key, s in successors.items() if s is not None}
        if not pairs:
            raise KeyError(
                f"{type(self).__name__} needs the next observation, and the batch has no "
                f"{list(map(_next, floating))}: keep what the collector wrote there."
            )
        return pairs

    def _policies_at(
        self, tensordict: TensorDictBase, states: TensorDictBase
    ) -> tuple[Policy, Policy]:
        """The policy at the batch's states and at others, in one evaluation.

        Args:
            tensordict: the batch, ``[*B]``.
            states: entries that take the place of the batch's, ``[K, *B]``.

        Returns:
            The policy at the one and at the other, both ``[K, *B]``.
        """
        actor, wiring = getattr(self, POLICY_NETWORK), self._wiring[POLICY_NETWORK]
        keys = actor.dist_params_keys if wiring.stochastic else [wiring.output]
        here, there = self._outputs_at(POLICY_NETWORK, tensordict, states, keys)
        here = here.expand(states.batch_size)
        if wiring.stochastic:
            return actor.build_dist_from_params(here), actor.build_dist_from_params(there)
        return here.get(wiring.output), there.get(wiring.output)

    def _values_at(
        self, network: str, tensordict: TensorDictBase, states: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        """A value function at the batch's states and at others, in one evaluation.

        Args:
            network: its name.
            tensordict: the batch, ``[*B]``. Action values are taken at its actions.
            states: entries that take the place of the batch's, ``[K, *B]``.

        Returns:
            Values ``[1, *B, ...]`` and ``[K, *B, ...]``, with the ensemble's dimension in front of
            both where the loss has expanded the network's parameters.
        """
        key = self._wiring[network].output
        if key is None:
            # Not earlier: set_keys may come after the wrapping, as after the making of any loss.
            raise ValueError(
                f"{network} writes {list(getattr(self, network).out_keys)}, and none of it is a "
                f"value to this loss, whose keys are {self.tensor_keys}: name it with set_keys."
            )
        here, there = self._outputs_at(network, tensordict, states, [key])
        return here.get(key), there.get(key)

    def _evaluate_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """Keeps what the loss has evaluated at the batch's states until ``forward`` is done.

        Only for losses that do so through a method of this name, as :class:`PPORPELoss`: their
        networks then need to be evaluated at the other states alone. Compiled, small batches are
        evaluated together with the other states, where these are known by now: that differs by
        rounding, and so it is left to where compiling does anyway.
        """
        if "batch" not in self._evaluated:
            return super()._evaluate_batch(network, tensordict)
        states = None
        if is_compiling() and self._fits_one_pass(network, tensordict):
            states = self._known_states(tensordict)
        if states is None:
            here = super()._evaluate_batch(network, tensordict)
        else:
            rows = self._rows(network, tensordict, states, with_batch=True)
            out = super()._evaluate_batch(network, rows)
            here, there = self._split(network, out, [1, len(states)], tensordict)
            here = here.squeeze(int(self._is_ensemble(network)))
            self._evaluated[network, "others"] = states, there
        self._evaluated[network] = here
        return here

    def _fits_one_pass(self, network: str, tensordict: TensorDictBase) -> bool:
        wiring = self._wiring.get(network)
        if wiring is None or wiring.trunk or wiring.has_buffers or not wiring.rowwise:
            return False
        inputs = tensordict.select(*wiring.inputs, strict=False).values(True, True)
        if any(value.requires_grad for value in inputs):
            return False
        return tensordict.ndim == 1 and tensordict.numel() <= ONE_PASS_STATES

    def _known_states(self, tensordict: TensorDictBase) -> TensorDictBase | None:
        """States to compare the batch's with that are in the batch; ``None`` if drawn later."""
        return None

    def _is_ensemble(self, network: str) -> bool:
        params = self._parameters_of(network)
        return params is not None and params.ndim > 0

    def _reduce_term(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduces as the loss does its own terms: its reduction, masks and priority weights.

        Losses that ignore priority weights, ignore them here too. Weights make it TorchRL's
        weighted mean, whose strength does not depend on them; :class:`PPORPELoss` scales its own
        terms down by them, so that beside those a regularizer is at its full gain.
        """
        weights = None
        if hasattr(self.tensor_keys, "priority_weight"):
            weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(value, tensordict, weights=weights, reduction=self._term_reduction)

    def _diagnostic(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """The plain mean over the unmasked batch; with reduction="none" the values themselves."""
        reduction = "none" if self._term_reduction == "none" else "mean"
        return self._reduce_loss(value.detach(), tensordict, reduction=reduction)

    # Internals.

    @property
    def _term_reduction(self) -> str:
        return getattr(self, "reduction", "mean")

    def _adopt(self, base_loss: LossModule) -> None:
        in_keys = getattr(base_loss, "in_keys", [])
        if in_keys and not any(isinstance(key, tuple) and key[0] == "next" for key in in_keys):
            raise TypeError(
                f"{type(base_loss).__name__} is not trained on transitions (it reads "
                f"{sorted(in_keys, key=str)}): "
                "without a next observation there is nothing to regularize between."
            )
        state = self.__dict__
        for name, value in vars(base_loss).items():
            state[name] = copy.copy(value) if name in _REGISTRIES else value
        state.setdefault("_wiring", {})
        state["_evaluated"] = {}
        # Renaming keys here must not rename them there.
        state["_tensor_keys"] = copy.copy(base_loss.tensor_keys)
        if "_value_estimator" in self._modules:
            self._modules["_value_estimator"] = copy.copy(base_loss._value_estimator)
        # These hooks refer to the module that they were registered on, and weakly.
        for key, hook in self._load_state_dict_pre_hooks.items():
            if hook.with_module:
                self._load_state_dict_pre_hooks[key] = type(hook)(hook.hook, self)
        self.in_keys = in_keys
        self.out_keys = getattr(base_loss, "out_keys", [])

    def _wire(self, networks: Iterable[str]) -> None:
        self._wiring = {name: self._wiring_of(name) for name in networks}
        if any(wiring.trunk for wiring in self._wiring.values()):
            self._wiring[POLICY_NETWORK] = self._wiring_of(POLICY_NETWORK)
        if self.in_keys:
            states = (_next(key) for wiring in self._wiring.values() for key in wiring.states)
            self.in_keys = list(dict.fromkeys([*self.in_keys, *states]))

    def _wiring_of(self, network: str) -> _Wiring:
        net, actor = getattr(self, network), getattr(self, POLICY_NETWORK, None)
        _check_declares_keys(net, network)
        _check_not_recurrent(net, network)
        stochastic, actions, made = False, self._action_keys(), set()
        if actor is not None:
            stochastic = _is_stochastic(actor)
            made = set(actor.out_keys) - set(actor.in_keys)
            if stochastic:
                actions += actor.dist_sample_keys
            elif not made & set(actions):
                actions = actor.out_keys[-1:]
        trunk = [key for key in net.in_keys if key in made - set(actions)]
        inputs = dict.fromkeys([*net.in_keys, *(actor.in_keys if trunk else ())])
        if network == POLICY_NETWORK:
            output = next((key for key in actions if key in made), None)
        else:
            output = self._value_key(network)
        return _Wiring(
            inputs=tuple(key for key in inputs if key not in trunk),
            states=tuple(key for key in inputs if key not in made.union(actions)),
            trunk=tuple(trunk),
            output=output,
            stochastic=stochastic,
            has_buffers=self._has_buffers(network),
            rowwise=not any(isinstance(m, _BatchNorm | _DropoutNd) for m in net.modules()),
        )

    def _action_keys(self) -> list[NestedKey]:
        keys = getattr(self.tensor_keys, "action", [])
        return [unravel_key(key) for key in (keys if isinstance(keys, list) else [keys])]

    def _value_key(self, network: str) -> NestedKey | None:
        # A network's name does not tell what it is: a value_network is V, Q or a vector of Q.
        keys = (getattr(self.tensor_keys, name, None) for name in _VALUE_KEYS)
        written = getattr(self, network).out_keys
        return next((key for key in keys if key and unravel_key(key) in written), None)

    def _has_buffers(self, network: str) -> bool:
        params = self._parameters_of(network)
        if params is None:
            return any(True for _ in getattr(self, network).buffers())
        return not all(isinstance(p, nn.Parameter) for p in params.values(True, True))

    def _parameters_of(self, network: str) -> TensorDictBase | None:
        return getattr(self, f"{network}_params", None) if self.functional else None

    def _outputs_at(
        self,
        network: str,
        tensordict: TensorDictBase,
        states: TensorDictBase,
        keys: Iterable[NestedKey],
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """A network's outputs at the batch's states, ``[1, *B]``, and at others, ``[K, *B]``."""
        wiring, known = self._wiring[network], self._evaluated.get(network)
        dim, num = int(self._is_ensemble(network)), len(states)
        evaluated, there = self._evaluated.get((network, "others"), (None, None))
        if evaluated is states:
            return known.select(*keys).unsqueeze(dim), there.select(*keys)
        rows = self._rows(network, tensordict, states, with_batch=known is None)
        if wiring.trunk:
            hidden = self._evaluate(POLICY_NETWORK, rows).select(*wiring.trunk)
            rows.update(hidden.detach() if getattr(self, "separate_losses", False) else hidden)
        out = self._evaluate(network, rows).select(*keys)
        if known is None:
            return self._split(network, out, [1, num], tensordict)
        return known.select(*keys).unsqueeze(dim), self._split(network, out, [num], tensordict)[0]

    def _split(
        self, network: str, out: TensorDictBase, parts: list[int], tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, ...]:
        """Outputs at rows as :meth:`_rows` gives them, by what the rows are: ``[part, *B]``."""
        dim = int(self._is_ensemble(network))
        if tensordict.batch_size:
            # Explicit sizes: an inferred one does not compile.
            out = out.unflatten(dim, (sum(parts), tensordict.batch_size[0]))
        return out.split(parts, dim)

    def _rows(
        self, network: str, tensordict: TensorDictBase, states: TensorDictBase, with_batch: bool
    ) -> TensorDictBase:
        """A network's inputs at the batch's states and at the others: ``[(1 + K) * B0, ...]``."""
        wiring, batch = self._wiring[network], tensordict.batch_size
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

    def _evaluate(self, network: str, rows: TensorDictBase) -> TensorDictBase:
        net, wiring = getattr(self, network), self._wiring[network]
        rows = rows.select(*net.in_keys, strict=False)
        params = self._parameters_of(network)
        if wiring.has_buffers:
            # Running statistics are the loss's own: spare copies take the update.
            params = TensorDict.from_module(net) if params is None else params
            params = params.apply(lambda p: p if p.requires_grad else p.clone())
        run = net.get_dist_params if network == POLICY_NETWORK and wiring.stochastic else net
        with set_exploration_type(self.deterministic_sampling_mode):
            if params is None:
                return run(rows)
            if not params.ndim:
                with params.to_module(net, preserve_module_state=False):
                    return run(rows)
            return _vmap_func(
                net,
                (None, 0),
                randomness=self.vmap_randomness,
                pseudo_vmap=getattr(self, "deactivate_vmap", False),
            )(rows, params)


@functools.cache
def _specialize(regularizer: type[RegularizedLoss], base: type[LossModule]) -> type:
    if regularizer._parts:
        raise TypeError(f"{regularizer.__name__} is made for one class of losses already.")
    for part in getattr(base, "_parts", ()):
        if issubclass(regularizer, part) or issubclass(part, regularizer):
            raise TypeError(f"a {base.__name__} is already regularized by {part.__name__}.")
    _check_no_clash(regularizer, base)
    parts = (regularizer, *getattr(base, "_parts", (base,)))
    namespace = {
        "__module__": regularizer.__module__,
        "__doc__": regularizer.__doc__,
        "_parts": parts,
        "_coefficients": frozenset().union(*(p._schedulable_buffers for p in parts[:-1])),
    }
    name = f"{regularizer.__name__}[{base.__name__}]"
    return types.new_class(name, (regularizer, base), exec_body=lambda ns: ns.update(namespace))


def _check_no_clash(regularizer: type[RegularizedLoss], base: type[LossModule]) -> None:
    """Refuses to hide, by chance, a method of the loss that it needs itself."""
    ours = {name for part in regularizer.__mro__ for name in vars(part)}
    theirs = {
        name for part in base.__mro__ if part not in regularizer.__mro__ for name in vars(part)
    }
    meant = dir(RegularizedLoss if issubclass(base, RegularizedLoss) else LossModule)
    meant = {*meant, "_evaluate_batch"}
    clash = sorted(name for name in ours & theirs - meant if not name.startswith("__"))
    if clash:
        raise TypeError(
            f"{regularizer.__name__} and {base.__name__} both define {clash}: rename one of them."
        )


def _make_empty(*parts: type) -> RegularizedLoss:
    cls = functools.reduce(lambda base, regularizer: regularizer[base], reversed(parts))
    return object.__new__(cls)


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


def _check_not_recurrent(net: nn.Module, name: str) -> None:
    recurrent = any(isinstance(module, LSTMModule | GRUModule) for module in net.modules())
    if recurrent or "is_init" in net.in_keys:
        raise TypeError(
            f"{name} is recurrent: its output depends on the states before, so that it has no "
            "value at a state near the current one alone. Only feed-forward networks can be "
            "regularized."
        )


def _check_coefficient(name: str, value: Any) -> float:
    if not isinstance(value, Real) or isinstance(value, bool):
        raise TypeError(f"{name} must be a real number, got {value!r} ({type(value).__name__}).")
    if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"{name} must be finite and at least 0, got {value!r}.")
    return float(value)


def _next(key: NestedKey) -> NestedKey:
    return unravel_key(("next", key))
