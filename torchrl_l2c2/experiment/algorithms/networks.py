"""Networks that several algorithms build, and what they ask of an environment."""

from __future__ import annotations

from copy import deepcopy

from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictParams
from torch import nn
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, ExplorationType
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator


def check_actions(
    env: EnvBase, algorithm: str, *, continuous: bool, squashed: bool = False
) -> None:
    """Refuses actions that an algorithm cannot take.

    Raises:
        ValueError: they are discrete where continuous ones are needed, or the other way round, or
            have no bounds to be squashed into.
    """
    if env.action_spec.dtype.is_floating_point != continuous:
        raise ValueError(
            f"algorithm={algorithm} needs {'continuous' if continuous else 'discrete'} actions, "
            f"this task's are {type(env.action_spec).__name__} of shape "
            f"{tuple(env.action_spec.shape)}."
        )
    if squashed and not _bounded(env.action_spec):
        raise ValueError(
            f"algorithm={algorithm} squashes actions into their bounds, and this task's have none: "
            "use algorithm=ppo_rpe with algorithm.squash=none, or register the task with a "
            "gymnasium.ActionWrapper that has bounds."
        )


def _bounded(spec: TensorSpec) -> bool:
    # An unbounded one has the largest floats as its low and high.
    sides = (spec.space.low, spec.space.high)
    return isinstance(spec, Bounded) and all(bool(side.isfinite().all()) for side in sides)


def observation_size(env: EnvBase) -> int:
    """Numbers in an observation."""
    return env.observation_spec["observation"].shape[-1]


def sharing(network: TensorDictModule, parameters: TensorDictParams) -> TensorDictModule:
    """A copy of a network on a loss's own parameters: it changes as they do."""
    copy = deepcopy(network)
    parameters.data.to_module(copy)
    return copy


def perceptron(
    in_features: int, out_features: int, hidden: tuple[int, ...], activation: type[nn.Module]
) -> MLP:
    """Fully connected layers with an activation between any two."""
    return MLP(
        in_features=in_features,
        out_features=out_features,
        num_cells=list(hidden),
        activation_class=activation,
    )


def tanh_normal_actor(
    env: EnvBase, hidden: tuple[int, ...], activation: type[nn.Module]
) -> TensorDictModule:
    """A tanh-squashed diagonal normal."""
    spec = env.action_spec
    network = nn.Sequential(
        perceptron(observation_size(env), 2 * spec.shape[-1], hidden, activation),
        NormalParamExtractor(),
    )
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


def action_value(env: EnvBase, hidden: tuple[int, ...]) -> ValueOperator:
    """The value of an action at an observation."""
    size = observation_size(env) + env.action_spec.shape[-1]
    network = perceptron(size, 1, hidden, nn.ReLU)
    return ValueOperator(network, in_keys=["observation", "action"])
