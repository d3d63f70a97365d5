"""A policy as a function from an observation to what it writes, compiled as far as can be."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_l2c2.experiment.agents.agent import exploring_in, network_of
from torchrl_l2c2.experiment.learn.compilation import compiled


def on_tensors(
    policy: TensorDictModule, keys: list[str], compile_policy: bool
) -> Callable[[Tensor], tuple[Tensor, ...]]:
    """The policy as a function from an observation to the tensors it writes.

    Args:
        policy (TensorDictModule): reads ``"observation"``.
        keys (list of str): what is returned of the entries that it writes, in this order.
        compile_policy (bool): whether to compile it, but for a module of TorchRL's behind it that
            only explores. It is then to be called in one exploration type.
    """
    if not compile_policy:
        return _written(policy, keys)
    network, exploring = network_of(policy), exploring_in(policy)
    if exploring is None:
        return compiled(_written(network, keys))
    names = list(network.out_keys)
    run = compiled(_written(network, names))

    def explore(observation: Tensor) -> tuple[Tensor, ...]:
        values = zip(names, run(observation), strict=True)
        written = exploring(TensorDict({"observation": observation, **dict(values)}))
        return tuple(written.get(key) for key in keys)

    return explore


def _written(policy: TensorDictModule, keys: list[str]) -> Callable[[Tensor], tuple[Tensor, ...]]:
    def act(observation: Tensor) -> tuple[Tensor, ...]:
        written = policy(TensorDict({"observation": observation}))
        return tuple(written.get(key) for key in keys)

    return act
