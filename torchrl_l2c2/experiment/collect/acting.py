"""Policies as functions from an observation to output tensors, optionally compiled."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_l2c2.experiment.agents.agent import exploration_module, without_exploration
from torchrl_l2c2.experiment.learn.compilation import compiled


def policy_function(
    policy: TensorDictModule, keys: list[str], compile_policy: bool
) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """Converts a policy to a function from an observation to its output tensors.

    Args:
        policy (TensorDictModule): Policy that reads ``"observation"``.
        keys (list of str): Keys of the returned outputs, in this order.
        compile_policy (bool): Whether to compile the policy, except for an exploration module at
            its end. Always call the compiled function with the same exploration type.

    Returns:
        Callable: Function from an observation to a tuple of tensors.
    """
    if not compile_policy:
        return _written(policy, keys)
    network, exploration = without_exploration(policy), exploration_module(policy)
    if exploration is None:
        return compiled(_written(network, keys))
    names = list(network.out_keys)
    run = compiled(_written(network, names))

    def explore(observation: Tensor) -> tuple[Tensor, ...]:
        values = zip(names, run(observation), strict=True)
        written = exploration(TensorDict({"observation": observation, **dict(values)}))
        return tuple(written.get(key) for key in keys)

    return explore


def _written(policy: TensorDictModule, keys: list[str]) -> Callable[[Tensor], tuple[Tensor, ...]]:
    def act(observation: Tensor) -> tuple[Tensor, ...]:
        written = policy(TensorDict({"observation": observation}))
        return tuple(written.get(key) for key in keys)

    return act
