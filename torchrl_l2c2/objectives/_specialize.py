"""Classes made at run time: ``Extension[Loss]``, which shares the state of a loss."""

from __future__ import annotations

import copy
import functools
import types
import weakref
from typing import Any, SupportsIndex
from weakref import WeakKeyDictionary

from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from tensordict.nn.common import _OutKeysSelect
from torch import nn
from torchrl.objectives import LossModule

from torchrl_l2c2._checks import describe_no_loss
from torchrl_l2c2._warnings import warn

# The losses that each was made of, while they live, with their keys and value estimators of then.
_ORIGINALS: WeakKeyDictionary[SpecializedLoss, list[tuple[weakref.ref[LossModule], Any, Any]]] = (
    WeakKeyDictionary()
)

# What nn.Module itself keeps: dictionaries that two losses must not share.
_REGISTRIES = frozenset(vars(nn.Module()))


class _WithoutCopies(type(LossModule)):  # type: ignore[misc]
    """TorchRL's metaclass gives every class a forward of its own, which would hide the loss's."""

    def __init__(cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any]) -> None:
        super().__init__(name, bases, namespace)
        if "forward" not in namespace:
            del cls.forward


class LossMixin(LossModule, metaclass=_WithoutCopies):
    """A mixin for losses: ``forward`` comes from the first class that defines it."""


class SpecializedLoss(LossMixin):
    """A loss made of another loss, as an object of a subclass of its class.

    ``Extension(loss, ...)``, with ``Extension`` a subclass of this one, returns an instance of
    ``Extension[type(loss)]``, a subclass of both classes that is made once for each pair. The
    object holds the networks, parameters and buffers of ``loss`` themselves, not copies, and
    ``loss`` stays as it was. When the ``__init__`` of ``Extension`` runs, the object already is the
    loss, and ``super().__init__()`` does nothing. ``Extension`` defines a ``forward``.

    Args:
        base_loss (LossModule): the loss.

    Raises:
        TypeError: it is no loss, has been wrapped by this class before, or has methods or
            attributes of its own with names of this class's.

    Examples:
        >>> import torch
        >>> from torchrl.modules import Actor, ValueOperator
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2.objectives._specialize import SpecializedLoss
        >>> class CountingLoss(SpecializedLoss):
        ...     def __init__(self, base_loss):
        ...         self.calls = 0
        ...
        ...     def forward(self, tensordict):
        ...         self.calls += 1
        ...         return super().forward(tensordict)
        >>> value = ValueOperator(torch.nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
        >>> loss = CountingLoss(DDPGLoss(Actor(torch.nn.Linear(3, 1)), value))
        >>> type(loss).__name__, isinstance(loss, DDPGLoss)
        ('CountingLoss[DDPGLoss]', True)
    """

    # Many losses compute these lists whenever they are read, which Dynamo cannot trace through
    # super(); here they are stored.
    in_keys = TensorDictModuleBase.in_keys
    out_keys = TensorDictModuleBase.out_keys

    _parts: tuple[type, ...] = ()
    _chose_estimator: bool = False  # whether this loss has been given another than its base

    def __class_getitem__(cls, base_class: type[LossModule]) -> type[SpecializedLoss]:
        """The subclass of this class and of ``base_class``."""
        if not (isinstance(base_class, type) and issubclass(base_class, LossModule)):
            raise TypeError(f"{cls.__name__}[...] takes a class of losses, got {base_class!r}.")
        # Classes are hashable; their instances' __hash__ is what confuses the checker.
        return _specialize(cls, base_class)  # type: ignore[arg-type]

    def __new__(cls, base_loss: LossModule, *args: Any, **kwargs: Any) -> SpecializedLoss:
        if not isinstance(base_loss, LossModule):
            raise TypeError(
                f"{cls.__name__} wraps a torchrl.objectives.LossModule, got "
                f"{describe_no_loss(base_loss)}."
            )
        specialized = cls if cls._parts else cls.__class_getitem__(type(base_loss))
        if type(base_loss) not in specialized.__mro__:
            raise TypeError(f"{cls.__name__} cannot wrap a {type(base_loss).__name__}.")
        _check_no_attribute_hides(specialized._parts[0], base_loss)
        self = object.__new__(specialized)
        _adopt(self, base_loss)
        return self

    def __init__(self, base_loss: LossModule | None = None) -> None:
        """Does nothing: the object already is the loss, whose constructor was called before."""

    @classmethod
    def _made_methods(cls, original: type[LossModule]) -> dict[str, Any]:
        """Methods that the subclass of this class and of a class of losses has."""
        return {}

    def _warn_of_changed_base(self) -> None:
        """Warns once if keys or the value estimator of a wrapped loss changed after wrapping."""
        for base, keys, estimator in _ORIGINALS.get(self, ()):
            if (loss := base()) is None:
                continue
            changed = ["set_keys"] if loss.tensor_keys != keys else []
            theirs = getattr(loss, "_value_estimator", None)
            ours = getattr(self, "_value_estimator", None)
            other = theirs is not estimator and _describe(theirs) != _describe(ours)
            if other and not self._chose_estimator:
                changed.append("make_value_estimator")
            if changed:
                del _ORIGINALS[self]
                warn(
                    f"{' and '.join(changed)} of the {type(loss).__name__} was called after it was "
                    f"wrapped, which does not reach the {type(self).__name__}: call it on the "
                    "wrapped loss, or before wrapping."
                )
                return

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> Any:
        """As for the loss itself."""
        # A loss that has none makes the usual one, without any.
        self._chose_estimator = bool(hyperparams.keys() - {"device"})
        return super().make_value_estimator(value_type, **hyperparams)

    def set_keys(self, **kwargs: NestedKey | None) -> None:
        """As for the loss itself."""
        super().set_keys(**kwargs)
        self.in_keys = super().in_keys

    def __reduce_ex__(self, protocol: SupportsIndex) -> tuple[Any, ...]:
        # A class made here has no name that can be imported; the classes that it is made of have.
        parts = vars(type(self)).get("_parts", (type(self),))
        return (_make_empty, parts, *super().__reduce_ex__(protocol)[2:])


@functools.cache
def _specialize(extension: type[SpecializedLoss], base: type[LossModule]) -> type:
    if extension._parts:
        raise TypeError(f"{extension.__name__} is made for one class of losses already.")
    for part in getattr(base, "_parts", ()):
        if issubclass(extension, part) or issubclass(part, extension):
            raise TypeError(
                f"{extension.__name__} cannot go around a {base.__name__}, which has the terms of "
                f"{part.__name__} already: wrap the loss within it, or change its coefficients."
            )
    _check_no_clash(extension, base)
    namespace = {
        "__module__": extension.__module__,
        "__doc__": extension.__doc__,
        "_parts": (extension, *getattr(base, "_parts", (base,))),
        **extension._made_methods(getattr(base, "_parts", (base,))[-1]),
    }
    name = f"{extension.__name__}[{base.__name__}]"
    return types.new_class(name, (extension, base), exec_body=lambda ns: ns.update(namespace))


def _check_no_clash(extension: type[SpecializedLoss], base: type[LossModule]) -> None:
    """Refuses to hide, by chance, a method of the loss that it needs itself.

    What a class that both inherit from declares, is there to be overridden.
    """
    common = set(extension.__mro__) & set(base.__mro__)
    ours = _names(set(extension.__mro__) - common)
    theirs = _names(set(base.__mro__) - common)
    clash = sorted(name for name in ours & theirs - _names(common) if not name.startswith("__"))
    if clash:
        raise TypeError(
            f"{extension.__name__} and {base.__name__} both define {clash}: rename one of them."
        )


def _check_no_attribute_hides(extension: type, base_loss: LossModule) -> None:
    """Refuses a loss whose own attributes would take the place of what the class has."""
    ours = _names(set(extension.__mro__) - set(type(base_loss).__mro__))
    registries = (getattr(base_loss, name) for name in ("_parameters", "_buffers", "_modules"))
    theirs = set(vars(base_loss)).union(*registries)
    if clash := sorted(name for name in ours & theirs if not name.startswith("__")):
        raise TypeError(
            f"{extension.__name__} has {clash}, which this {type(base_loss).__name__} has as "
            "attributes of its own: rename them in the loss."
        )


def _names(classes: set[type]) -> set[str]:
    return {name for cls in classes for name in vars(cls)}


def _adopt(self: SpecializedLoss, base_loss: LossModule) -> None:
    """Makes the base's state this object's own, down to where the two have to differ."""
    state = self.__dict__
    for name, value in vars(base_loss).items():
        state[name] = copy.copy(value) if name in _REGISTRIES else value
    state.pop("_compiled_call_impl", None)  # By loss.compile(): a call of the plain loss.
    # Renaming keys here must not rename them there.
    state["_tensor_keys"] = copy.copy(base_loss.tensor_keys)
    if "_value_estimator" in self._modules:
        self._modules["_value_estimator"] = copy.copy(base_loss._value_estimator)
    # A selection of out_keys belongs to the module that it was made on: the base.
    for key, selection in find_selections(base_loss).items():
        self._forward_hooks[key] = copy.copy(selection)
        self._forward_hooks[key].module = self
    # These hooks hold a weak reference to the module that they were registered on: the base.
    for key, hook in self._load_state_dict_pre_hooks.items():
        if hook.with_module:
            self._load_state_dict_pre_hooks[key] = type(hook)(hook.hook, self)
    estimator = getattr(base_loss, "_value_estimator", None)
    original = weakref.ref(base_loss), copy.copy(base_loss.tensor_keys), estimator
    inner = _ORIGINALS.get(base_loss, []) if isinstance(base_loss, SpecializedLoss) else []
    _ORIGINALS[self] = [original, *inner]
    try:
        self.in_keys = getattr(base_loss, "in_keys", [])
    except TypeError as error:  # Of A2CLoss with several actions.
        raise TypeError(
            f"the in_keys of {type(base_loss).__name__} cannot be read ({error}): call its "
            "set_keys, such as set_keys(action=..., sample_log_prob=...), before it is wrapped."
        ) from error
    self.out_keys = getattr(base_loss, "out_keys", [])


def find_selections(module: nn.Module) -> dict[int, Any]:
    """The forward hooks of ``select_out_keys``, by their numbers."""
    hooks = module._forward_hooks.items()
    return {key: hook for key, hook in hooks if isinstance(hook, _OutKeysSelect)}


def _describe(estimator: Any) -> tuple[Any, ...]:
    """The kind of a value estimator and its numbers."""
    numbers = (getattr(estimator, name, None) for name in ("gamma", "lmbda"))
    return type(estimator), *(None if n is None else float(n) for n in numbers)


def _make_empty(*parts: Any) -> SpecializedLoss:
    cls = functools.reduce(
        lambda base, extension: extension.__class_getitem__(base), reversed(parts)
    )
    return object.__new__(cls)
