"""Conversion of Gymnasium spaces to one vector of float32 each."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import (
    FilterObservation,
    FlattenObservation,
    TransformAction,
    TransformObservation,
)

from torchrl_l2c2.experiment.errors import UserError

Env = gymnasium.Env[Any, Any]


def observing_vector(env: Env, *, flatten: bool) -> Env:
    """The same task, observing one vector of float32; the task itself where it does so already.

    Integers and other floats are cast. Several vectors, a ``Dict``, become one in the order of
    their names.

    Args:
        env (gymnasium.Env): the task.

    Keyword Args:
        flatten (bool): whether to make a vector of matrices, nested entries and, one-hot, labels.

    Raises:
        ValueError: an observation that does not become a vector so.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("Taxi-v4")
        >>> observing_vector(env, flatten=True).observation_space.shape
        (500,)
        >>> observing_vector(env, flatten=False)
        Traceback (most recent call last):
        torchrl_l2c2.experiment.errors.UserError: the task observes a Discrete, not a vector of numbers: task.flatten=true makes one of it.
    """  # noqa: E501
    space: Any = env.observation_space
    entries = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    if flatten:
        entries = _leaves(space)
    for entry in entries:
        _check_entry(entry, flatten=flatten)
    if isinstance(space, spaces.Dict):
        env = FilterObservation(env, sorted(space.spaces))
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        env = FlattenObservation(env)
    vector: Any = env.observation_space
    if vector.dtype == np.float32:
        return env
    # DtypeObservation does the same, and warns of every float64.
    return TransformObservation(env, lambda seen: np.asarray(seen, np.float32), _float32(vector))


def taking_vector(env: Env) -> Env:
    """The same task, taking a vector of float32 or a number from 0 up; itself where it does so.

    Raises:
        ValueError: an action of another kind.
    """
    space: Any = env.action_space
    if isinstance(space, spaces.Discrete):
        return CountedFromZero(env) if space.start else env
    vector = isinstance(space, spaces.Box) and len(space.shape) == 1
    if not vector or not np.issubdtype(space.dtype, np.floating):
        raise UserError(
            f"the task takes a {_kind(space)}; actions must be one vector of floats or one "
            "Discrete number: wrap the task in a gymnasium.ActionWrapper, and register that."
        )
    if space.dtype == np.float32:
        return env
    low, high, dtype = space.low, space.high, space.dtype
    # Rounding may lead out of the bounds.
    return TransformAction(
        env, lambda action: np.clip(action.astype(dtype), low, high), _float32(space)
    )


class CountedFromZero(TransformAction[Any, Any, Any]):
    """The same task, its Discrete actions counted from 0, where it counts them from ``first``."""

    def __init__(self, env: Env) -> None:
        space: Any = env.action_space
        self.first = int(space.start)
        super().__init__(env, lambda action: self.first + action, spaces.Discrete(int(space.n)))


def _float32(space: Any) -> Any:
    return spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32), dtype=np.float32)


def _leaves(space: Any) -> list[Any]:
    if isinstance(space, spaces.Dict):
        return [leaf for entry in space.spaces.values() for leaf in _leaves(entry)]
    return [space]


def _check_entry(space: Any, *, flatten: bool) -> None:
    numbers = isinstance(space, spaces.Box | spaces.MultiBinary)
    labels = isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
    if (numbers and (flatten or len(space.shape) <= 1)) or (labels and flatten):
        return
    if numbers or labels or isinstance(space, spaces.Dict):
        todo = "task.flatten=true makes one of it."
    else:
        todo = "make one of it in a gymnasium.ObservationWrapper, and register that."
    raise UserError(f"the task observes a {_kind(space)}, not a vector of numbers: {todo}")


def _kind(space: Any) -> str:
    """Gymnasium's own representation of bounds takes many lines."""
    name = type(space).__name__
    return f"{name} of {space.dtype} {space.shape}" if isinstance(space, spaces.Box) else name


def unknown_task(env_id: str, cause: Exception) -> UserError:
    """The error for an id that Gymnasium cannot make."""
    return UserError(
        f"task.env_id={env_id!r} is not a task that Gymnasium can make here ({cause}). "
        "Use one of this package's (train.py --help names them), or task=gymnasium with a "
        "registered id; `module:id` imports the module that registers it, from the current "
        "folder or PYTHONPATH."
    )


def check_known(env_id: str) -> None:
    """Refuses an id that Gymnasium does not know, without importing the simulator.

    Raises:
        UserError: with what to write instead.
    """
    module, _, name = env_id.rpartition(":")
    try:
        if not module:
            gymnasium.spec(name)
        elif find_spec(module.partition(".")[0]) is None:
            raise ModuleNotFoundError(f"No module named {module!r}")
    except (gymnasium.error.Error, ImportError) as error:
        raise unknown_task(env_id, error) from error
