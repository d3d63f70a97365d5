"""Networks that several algorithms build, and their demands on an environment."""

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


def check_actions(
    env: EnvBase, algorithm: str, *, continuous: bool, squashed: bool = False, drawn: bool = True
) -> None:
    """Refuses actions that an algorithm cannot take.

    Keyword Args:
        continuous (bool): whether the algorithm needs continuous actions, or else discrete ones.
        squashed (bool): whether they are squashed into their bounds. Default ``False``.
        drawn (bool): whether they are drawn from a distribution between these. Default ``True``.

    Raises:
        ValueError: they are discrete where continuous ones are needed, or the other way round, or
            have no bounds to be squashed into, or none to draw between.
    """
    if env.action_spec.dtype.is_floating_point != continuous:
        raise UserError(
            f"algorithm={algorithm} needs {'continuous' if continuous else 'discrete'} actions, "
            f"this task's are {type(env.action_spec).__name__} of shape "
            f"{tuple(env.action_spec.shape)}: use algorithm="
            f"{'dqn' if continuous else 'ppo_rpe'}, or another algorithm."
        )
    if squashed and not _bounded(env.action_spec):
        raise UserError(
            f"algorithm={algorithm} squashes actions into their bounds, and this task's have none: "
            "use algorithm=ppo_rpe with algorithm.squash=none, or register the task with a "
            "gymnasium.ActionWrapper that has bounds."
        )
    bounds = action_bounds(env) if squashed and drawn else ()
    if bounds and (still := (bounds[0] >= bounds[1]).nonzero().flatten().tolist()):
        raise UserError(
            f"algorithm={algorithm} squashes actions into their bounds, and entries {still} of "
            "this task's can take only one value: register the task with a "
            "gymnasium.ActionWrapper that leaves them out."
        )


def _bounded(spec: TensorSpec) -> bool:
    # An unbounded one has the largest floats as its low and high.
    sides = (spec.space.low, spec.space.high)
    return isinstance(spec, Bounded) and all(bool(side.isfinite().all()) for side in sides)


def action_bounds(env: EnvBase) -> tuple[Tensor, Tensor] | tuple[()]:
    """The least and the largest action, ``[A]`` each; nothing where there are none."""
    spec = env.action_spec.to(torch.get_default_device())
    return (spec.space.low, spec.space.high) if _bounded(spec) else ()


def clip_bounds(env: EnvBase) -> tuple[Tensor, Tensor]:
    """The least and the largest action, ``[A]`` each; infinite where there is none."""
    spec = env.action_spec.to(torch.get_default_device())
    low, high = spec.space.low, spec.space.high
    if isinstance(spec, Bounded):
        return low, high
    # An unbounded one has the largest floats as its low and high.
    return torch.full_like(low, -torch.inf), torch.full_like(high, torch.inf)


def observation_size(env: EnvBase) -> int:
    """Returns the number of entries of an observation."""
    size: int = env.observation_spec["observation"].shape[-1]
    return size


def sharing(network: TensorDictModule, parameters: TensorDictParams) -> TensorDictModule:
    """A copy of a network on a loss's own parameters: it changes as they do."""
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
    """Makes fully connected layers on an observation.

    Keyword Args:
        extra_features (int): size of a second input, such as the action. Default 0.
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
    """A diagonal normal.

    Keyword Args:
        squash (bool): whether tanh squashes it into the action's bounds. Default ``True``.
        log_scale (float, optional): what the logarithm of the scale begins with, as a parameter
            of its own. Default: the scale is an output of the network.
        exponential (bool): whether such an output is the scale's logarithm, cut to [-20, 2],
            instead of going through a softplus. Default ``False``.
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
        # An unsquashed one's samples lie beyond the bounds.
        spec=spec if squash else None,
        distribution_class=TanhNormal if squash else IndependentNormal,
        distribution_kwargs=squashed,
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


class LogScaleExtractor(nn.Module):
    """Halves an output into a location and a scale, the logarithm of which it is.

    Examples:
        >>> import torch
        >>> loc, scale = LogScaleExtractor()(torch.tensor([3.0, 9.0]))
        >>> loc.item(), scale.log().item()
        (3.0, 2.0)
    """

    LIMITS = (-20.0, 2.0)

    def forward(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """An output ``[*B, 2 A]`` to location and scale, each ``[*B, A]``."""
        loc, log_scale = output.chunk(2, -1)
        return loc, log_scale.clamp(*self.LIMITS).exp()


def orthogonal(network: nn.Module, *, last: float) -> None:
    """Orthogonal weights with a gain of the root of 2, and no biases.

    Keyword Args:
        last (float): gain of the last layer. Smaller ones have outputs nearer to 0 at first.
    """
    layers = [layer for layer in network.modules() if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last if layer is layers[-1] else 2.0**0.5)
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)


def action_value(env: EnvBase, hidden: tuple[int, ...]) -> ValueOperator:
    """The value of an action at an observation."""
    network = perceptron(env, 1, hidden, nn.ReLU, extra_features=env.action_spec.shape[-1])
    return ValueOperator(network, in_keys=["observation", "action"])
