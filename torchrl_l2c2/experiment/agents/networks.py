"""Networks shared by several algorithms, and checks of the environment's actions."""

from __future__ import annotations

from copy import deepcopy

import torch
from tensordict.nn import (
    AddStateIndependentNormalScale,
    NormalParamExtractor,
    TensorDictModule,
    TensorDictParams,
)
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import EnvBase, ExplorationType
from torchrl.modules import (
    MLP,
    IndependentNormal,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from torchrl_l2c2.experiment.errors import UserError


def check_bounds(env: EnvBase, algorithm: str, *, sampled: bool = True) -> None:
    """Checks that an algorithm can squash the environment's actions into their bounds.

    Args:
        env (EnvBase): Environment.
        algorithm (str): Name of the algorithm, for errors.

    Keyword Args:
        sampled (bool): Whether actions are sampled from a distribution, which needs bounds that
            differ. Default ``True``.

    Raises:
        UserError: If the actions have no bounds or equal bounds.
    """
    if not _bounded(env.action_spec):
        raise UserError(
            f"algorithm={algorithm} squashes actions into their bounds, but this task's actions "
            "have none: use algorithm=ppo_rpe with algorithm.squash=none, or register the task "
            "with a gymnasium.ActionWrapper that has bounds."
        )
    bounds = action_bounds(env) if sampled else ()
    if bounds and (fixed := (bounds[0] >= bounds[1]).nonzero().flatten().tolist()):
        raise UserError(
            f"algorithm={algorithm} squashes actions into their bounds, but entries {fixed} of "
            "this task's actions have only one possible value: register the task with a "
            "gymnasium.ActionWrapper that leaves them out."
        )


def _bounded(spec: TensorSpec) -> bool:
    # An unbounded spec has the largest floats as low and high.
    sides = (spec.space.low, spec.space.high)
    return isinstance(spec, Bounded) and all(bool(side.isfinite().all()) for side in sides)


def action_bounds(env: EnvBase) -> tuple[Tensor, Tensor] | tuple[()]:
    """Returns the lower and upper bounds ``[A]`` of actions, or an empty tuple without bounds."""
    spec = env.action_spec.to(torch.get_default_device())
    return (spec.space.low, spec.space.high) if _bounded(spec) else ()


def clip_bounds(env: EnvBase) -> tuple[Tensor, Tensor] | tuple[()]:
    """Returns bounds ``[A]`` as :func:`action_bounds` does, of which some may be infinite."""
    spec = env.action_spec.to(torch.get_default_device())
    return (spec.space.low, spec.space.high) if isinstance(spec, Bounded) else ()


def observation_size(env: EnvBase) -> int:
    """Returns the length of an observation."""
    size: int = env.observation_spec["observation"].shape[-1]
    return size


def shared_copy(network: TensorDictModule, parameters: TensorDictParams) -> TensorDictModule:
    """Returns a copy of a network that shares its parameters with a loss."""
    copy = deepcopy(network)
    parameters.data.to_module(copy)
    return copy


def perceptron(
    env: EnvBase,
    out_features: int,
    hidden: tuple[int, ...],
    activation: type[nn.Module],
    *,
    extra_features: int = 0,
) -> nn.Module:
    """Returns fully connected layers on an observation.

    Args:
        env (EnvBase): Environment with the task's observations.
        out_features (int): Number of outputs.
        hidden (tuple of int): Numbers of neurons of the hidden layers.
        activation (type): Class of the activations.

    Keyword Args:
        extra_features (int): Length of a second input, such as the action. Default 0.
    """
    return MLP(
        in_features=observation_size(env) + extra_features,
        out_features=out_features,
        num_cells=list(hidden),
        activation_class=activation,
    )


def normal_actor(
    env: EnvBase,
    hidden: tuple[int, ...],
    activation: type[nn.Module],
    *,
    squash: bool = True,
    log_scale: float | None = None,
    exponential: bool = False,
) -> TensorDictModule:
    """Returns a policy with a diagonal normal distribution.

    Args:
        env (EnvBase): Environment with the task's observations and actions.
        hidden (tuple of int): Numbers of neurons of the hidden layers.
        activation (type): Class of the activations.

    Keyword Args:
        squash (bool): Whether tanh squashes actions into their bounds. Default ``True``.
        log_scale (float, optional): Initial logarithm of the scale, which is then a parameter
            independent of the state. Default: the scale is an output of the network.
        exponential (bool): Whether the network's output is the logarithm of the scale, clipped to
            [-20, 2], instead of the input of a softplus. Default ``False``.
    """
    spec = env.action_spec.to(torch.get_default_device())
    size = spec.shape[-1]
    extractor: nn.Module
    if log_scale is not None:
        extractor = AddStateIndependentNormalScale(size, init_value=log_scale)
    else:
        extractor = LogScaleExtractor() if exponential else NormalParamExtractor()
    outputs = 2 * size if log_scale is None else size
    network = nn.Sequential(perceptron(env, outputs, hidden, activation), extractor)
    squashed = {"low": spec.space.low, "high": spec.space.high} if squash else {}
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        # Samples without squashing may exceed the bounds.
        spec=spec if squash else None,
        distribution_class=TanhNormal if squash else IndependentNormal,
        distribution_kwargs=squashed,
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


class LogScaleExtractor(nn.Module):
    """Splits an output into the location and the logarithm of the scale.

    Examples:
        >>> import torch
        >>> loc, scale = LogScaleExtractor()(torch.tensor([3.0, 9.0]))
        >>> loc.item(), scale.log().item()
        (3.0, 2.0)
    """

    LIMITS = (-20.0, 2.0)

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Converts an output ``[*B, 2 A]`` to location and scale, each ``[*B, A]``."""
        loc, log_scale = output.chunk(2, -1)
        return loc, log_scale.clamp(*self.LIMITS).exp()


def orthogonal(network: nn.Module, *, last: float) -> None:
    r"""Initializes weights orthogonally with a gain of :math:`\sqrt{2}`, and biases to 0.

    Args:
        network (nn.Module): Network, changed in place.

    Keyword Args:
        last (float): Gain of the last layer. Smaller values give initial outputs closer to 0.
    """
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last if layer is layers[-1] else 2.0**0.5)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)


def action_value(env: EnvBase, hidden: tuple[int, ...]) -> ValueOperator:
    """Returns a network for the value of an action at an observation."""
    network = perceptron(env, 1, hidden, nn.ReLU, extra_features=env.action_spec.shape[-1])
    return ValueOperator(network, in_keys=["observation", "action"])
