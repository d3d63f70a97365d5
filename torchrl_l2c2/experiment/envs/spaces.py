"""Conversion of a Gymnasium task's observations and actions to float32 vectors."""

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


def with_vector_observation(env: Env, *, flatten: bool) -> Env:
    """Wraps a task to observe one float32 vector; returns the task itself if it already does.

    Integers and other floats are cast. The vectors of a ``Dict`` are joined in the order of their
    names.

    Args:
        env (gymnasium.Env): Task.

    Keyword Args:
        flatten (bool): Whether to convert matrices, nested entries and labels (one-hot) as well.

    Returns:
        gymnasium.Env: The wrapped task.

    Raises:
        ValueError: If the observation cannot be converted to a vector.

    Examples:
        >>> import gymnasium
        >>> env = gymnasium.make("Taxi-v4")
        >>> with_vector_observation(env, flatten=True).observation_space.shape
        (500,)
        >>> with_vector_observation(env, flatten=False)
        Traceback (most recent call last):
        torchrl_l2c2.experiment.errors.UserError: the task observes a Discrete, not a vector of numbers: set task.flatten=true to convert it.
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
    if not vector.shape[0]:
        raise UserError("the task's observation is a vector without entries: a policy needs one.")
    if vector.dtype == np.float32:
        return env
    # DtypeObservation does the same, but warns about every float64.
    return TransformObservation(env, lambda seen: np.asarray(seen, np.float32), _float32(vector))


def with_vector_action(env: Env) -> Env:
    """Wraps a task to take a float32 vector; returns the task if it does.

    Raises:
        UserError: If the actions have another type.
    """
    space: Any = env.action_space
    vector = isinstance(space, spaces.Box) and len(space.shape) == 1
    if not vector or not np.issubdtype(space.dtype, np.floating):
        discrete = isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
        raise UserError(
            f"the task's actions are a {_kind(space)}; they must be one vector of floats: "
            + (
                "train a policy with discrete actions in a TorchRL loop of your own, and wrap its "
                "loss with torchrl_l2c2.smooth."
                if discrete
                else "register the task with a gymnasium.ActionWrapper that takes such a vector."
            )
        )
    if space.dtype == np.float32:
        return env
    low, high, dtype = space.low, space.high, space.dtype
    # Rounding may exceed the bounds.
    return TransformAction(
        env, lambda action: np.clip(action.astype(dtype), low, high), _float32(space)
    )


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
        todo = "set task.flatten=true to convert it."
    else:
        todo = "convert it in a gymnasium.ObservationWrapper, and register the result."
    raise UserError(f"the task observes a {_kind(space)}, not a vector of numbers: {todo}")


def _kind(space: Any) -> str:
    """Describes a space in one line; Gymnasium's representation lists all bounds."""
    name = type(space).__name__
    return f"{name} of {space.dtype} {space.shape}" if isinstance(space, spaces.Box) else name


def unknown_task(env_id: str, cause: Exception) -> UserError:
    """Returns the error for an id that Gymnasium cannot create."""
    return UserError(
        f"task.env_id={env_id!r} is not a task that Gymnasium can create here ({cause}). "
        "Use one of this package's tasks (see train.py --help), or task=gymnasium with a "
        "registered id; `module:id` imports the module that registers it, from the current "
        "folder or PYTHONPATH."
    )


def check_env_id(env_id: str) -> None:
    """Checks that Gymnasium knows an id, without importing the simulator.

    Raises:
        UserError: If Gymnasium does not know the id.
    """
    module, _, name = env_id.rpartition(":")
    try:
        if not module:
            gymnasium.spec(name)
        elif find_spec(module.partition(".")[0]) is None:
            raise ModuleNotFoundError(f"No module named {module!r}")
    except (gymnasium.error.Error, ImportError) as error:
        raise unknown_task(env_id, error) from error
