"""The paper's networks: the Squish activation, the stochastic actor and the ensemble critic."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Literal

import torch
from tensordict import NestedKey
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import ExplorationType
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, TanhNormal

from torchrl_l2c2._checks import check_choice, check_positive_int, check_real


class Squish(nn.Module):
    r"""The paper's activation: the input times the derivative of squareplus.

    .. math::
        \mathrm{squish}(x) = \frac{x}{2} \Big(1 + \frac{x}{\sqrt{x^2 + b}}\Big), \qquad
        \mathrm{squareplus}(x) = \frac{1}{2} \big(x + \sqrt{x^2 + b}\big)

    In the same way, swish is the input times the derivative of softplus (Kobayashi, L2C2, 2022,
    "Setup").

    Args:
        b (float): bend, greater than 0. Larger values bend more gently around 0; towards 0 it
            becomes a ReLU. [inferred] Default 4.0: squareplus then has the curvature of softplus at
            0, and Squish follows swish there to second order.

    Raises:
        TypeError: ``b`` is not a real number.
        ValueError: ``b`` is not finite or not greater than 0.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2 import Squish
        >>> Squish()(torch.tensor([-1.5, 0.0, 1.5]))
        tensor([-0.3000,  0.0000,  1.2000])
    """

    def __init__(self, b: float = 4.0) -> None:
        super().__init__()
        check_real("Squish: b", b, above=0)
        self.b = b

    def forward(self, x: Tensor) -> Tensor:
        """Applies the activation to every element."""
        if x.dtype.itemsize < 4:  # The square of 256 is infinite in float16.
            return self.forward(x.float()).to(x.dtype)
        return 0.5 * x * (1.0 + x * torch.rsqrt(x.square() + self.b))

    def extra_repr(self) -> str:
        """The bend, for ``repr``."""
        return f"b={self.b}"


class SigmoidNormal(TanhNormal):
    r"""A normal squashed into bounds by the logistic function: a tanh of half its values.

    .. math::
        \mathrm{low} + (\mathrm{high} - \mathrm{low})\, \sigma(x), \qquad
        \sigma(x) = \tfrac{1}{2} \big(1 + \tanh \tfrac{x}{2}\big)

    Takes what :class:`~torchrl.modules.TanhNormal` takes; its base distribution has half the
    location and half the scale that were given. Distances of means use the base distribution and
    are a quarter of the distances between entries ``loc``.

    Examples:
        >>> import torch
        >>> from torchrl_l2c2.modules import SigmoidNormal
        >>> policy = SigmoidNormal(torch.tensor([2.0]), torch.tensor([0.5]), low=0.0, high=10.0)
        >>> policy.deterministic_sample, 10 * torch.tensor([2.0]).sigmoid()
        (tensor([8.8080]), tensor([8.8080]))
    """

    def update(self, loc: Tensor, scale: Tensor) -> None:
        """Sets the location and the scale of the normal, before it is squashed."""
        super().update(loc / 2, scale / 2)

    def get_mode(self) -> Tensor:
        """Estimates the mode by Adam, as :class:`~torchrl.modules.TanhNormal` does its own."""
        bounds = {"low": self.low, "high": self.high, "event_dims": self._event_dims}
        mode: Tensor = TanhNormal(self.loc, self.scale, **bounds).get_mode()  # Halved already.
        return mode


# Distributions by the function that keeps actions within their bounds.
DISTRIBUTIONS = {"tanh": TanhNormal, "sigmoid": SigmoidNormal, "none": IndependentNormal}


class NormalNetwork(nn.Module):
    """Maps observations to the location and the positive scale of a diagonal normal."""

    def __init__(self, body: nn.Module, extractor: nn.Module) -> None:
        super().__init__()
        self.body = body
        self.extractor = extractor

    def forward(self, *observations: Tensor) -> tuple[Tensor, Tensor]:
        """Observations ``[*B, F_i]`` to location and scale, each ``[*B, A]``."""
        return self.extractor(self.body(*observations))


class EnsembleNetwork(nn.Module):
    """Maps observations to the mean of several values and to the values themselves."""

    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.body = body

    def forward(self, *observations: Tensor) -> tuple[Tensor, Tensor]:
        """Observations ``[*B, F_i]`` to their value ``[*B, 1]`` and its heads ``[*B, K]``."""
        heads = self.body(*observations)
        return heads.mean(-1, keepdim=True), heads


def make_actor(
    observation_size: int,
    action: TensorSpec | int,
    *,
    hidden: Sequence[int] = (100, 100),
    squash: Literal["tanh", "sigmoid", "none"] = "tanh",
    scale_mapping: str = "biased_softplus_1.0",
    squish_b: float = 4.0,
    in_keys: str | Sequence[NestedKey] = ("observation",),
) -> ProbabilisticActor:
    r"""Builds the paper's policy: a diagonal normal from layers of ``Linear, LayerNorm, Squish``.

    It writes ``loc``, ``scale``, ``action`` and ``action_log_prob``. It samples by default; under
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` the action is the squashed ``loc``.

    Args:
        observation_size (int): number of observed values: the sum of the last dimensions of
            ``in_keys``.
        action (TensorSpec or int): the environment's (unbatched) action spec, whose bounds the
            squashing takes; or the number of actions, with bounds ``[-1, 1]``.

    Keyword Args:
        hidden (sequence of int): neurons of each hidden layer. More can represent more and cost
            more. Default ``(100, 100)``.
        squash (str): ``"tanh"`` maps the normal sample into the action's bounds; ``"sigmoid"``
            does so with half the slope (:class:`SigmoidNormal`); ``"none"`` leaves it unbounded,
            for an environment that clips. [inferred] Default ``"tanh"``.
        scale_mapping (str): how the scale is made positive, a name that
            :class:`~tensordict.nn.NormalParamExtractor` knows. [inferred] Default
            ``"biased_softplus_1.0"``, TorchRL's own: 1 where the network's output is 0.
        squish_b (float): bend of :class:`Squish`. Default 4.0.
        in_keys (str or sequence of NestedKey): observations to read; several are concatenated.
            Default ``("observation",)``.

    Returns:
        ProbabilisticActor: the policy, for any leading batch dimensions.

    Raises:
        TypeError: the action is not a single continuous tensor, or a setting of another type.
        ValueError: a size or a choice that is not allowed, or bounds that cannot be squashed into.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_l2c2 import make_actor
        >>> actor = make_actor(3, Bounded(low=-2.0, high=2.0, shape=(1,)))
        >>> batch = actor(TensorDict({"observation": torch.zeros(8, 3)}, batch_size=[8]))
        >>> batch["action"].shape, batch["action_log_prob"].shape
        (torch.Size([8, 1]), torch.Size([8]))
    """
    check_choice("make_actor: squash", squash, tuple(DISTRIBUTIONS))
    spec = action
    if not isinstance(spec, TensorSpec):
        if not isinstance(spec, Integral):
            raise TypeError(
                "make_actor: action must be a TorchRL spec, such as env.action_spec_unbatched, or "
                f"the number of actions, got {spec!r}."
            )
        check_positive_int("make_actor: the number of actions", action)
        spec = Bounded(low=-1.0, high=1.0, shape=(action,))
    size = _action_size(spec)
    if not isinstance(scale_mapping, str):
        raise TypeError(
            f"make_actor: scale_mapping must be a name, such as 'exp', got {scale_mapping!r}."
        )
    try:
        extractor = NormalParamExtractor(scale_mapping)
        *_, bias = scale_mapping.rpartition("biased_softplus_")
        if bias != scale_mapping:  # the initial scale, of which 0.01 is the smallest
            check_real("the number in scale_mapping", float(bias), above=0.01)
    except (NotImplementedError, ValueError) as error:
        raise ValueError(
            "make_actor: scale_mapping must be 'exp', 'expln', 'softplus', 'relu' or "
            "'biased_softplus_1.0', with any number above 0.01 as the initial scale, got "
            f"{scale_mapping!r}."
        ) from error
    network = NormalNetwork(_body(observation_size, hidden, 2 * size, squish_b), extractor)
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=_read(in_keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=DISTRIBUTIONS[squash],
        distribution_kwargs={} if squash == "none" else _bounds(spec),
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


def make_critic(
    observation_size: int,
    *,
    num_heads: int = 5,
    hidden: Sequence[int] = (100, 100),
    squish_b: float = 4.0,
    in_keys: str | Sequence[NestedKey] = ("observation",),
) -> TensorDictModule:
    """Builds the paper's critic: an ensemble of values that share all layers but the last.

    It writes ``state_value`` ``[*B, 1]``, the mean of the ensemble, and ``state_value_heads``
    ``[*B, num_heads]``, the ensemble itself.

    Args:
        observation_size (int): number of observed values: the sum of the last dimensions of
            ``in_keys``.

    Keyword Args:
        num_heads (int): size of the ensemble. A larger one has a steadier mean. Default 5.
        hidden (sequence of int): neurons of each hidden layer. More can represent more and cost
            more. Default ``(100, 100)``.
        squish_b (float): bend of :class:`Squish`. Default 4.0.
        in_keys (str or sequence of NestedKey): observations to read; several are concatenated.
            Default ``("observation",)``.

    Returns:
        TensorDictModule: the critic, for any leading batch dimensions.

    Raises:
        TypeError: a size that is no integer.
        ValueError: a size that is not allowed.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_l2c2 import make_critic
        >>> critic = make_critic(3)
        >>> batch = critic(TensorDict({"observation": torch.zeros(8, 3)}, batch_size=[8]))
        >>> batch["state_value"].shape, batch["state_value_heads"].shape
        (torch.Size([8, 1]), torch.Size([8, 5]))
    """
    check_positive_int("make_critic: num_heads", num_heads)
    return TensorDictModule(
        EnsembleNetwork(_body(observation_size, hidden, num_heads, squish_b)),
        in_keys=_read(in_keys),
        out_keys=["state_value", "state_value_heads"],
    )


def _body(
    in_features: int,
    hidden: Sequence[int],
    out_features: int,
    squish_b: float,
) -> nn.Module:
    check_positive_int("observation_size", in_features)
    if not isinstance(hidden, Sequence) or isinstance(hidden, str):
        raise TypeError(
            f"hidden must be the sizes of the layers, such as (100, 100), got {hidden!r}."
        )
    for cells in hidden:
        check_positive_int("every entry of hidden", cells)
    return MLP(
        in_features=in_features,
        out_features=out_features,
        num_cells=list(hidden),
        norm_class=nn.LayerNorm,
        norm_kwargs=[{"normalized_shape": cells} for cells in hidden],
        activation_class=Squish,
        activation_kwargs={"b": squish_b},
    )


def _read(in_keys: str | Sequence[NestedKey]) -> list[NestedKey]:
    """A string is one key, and not its letters."""
    keys = [in_keys] if isinstance(in_keys, str) else list(in_keys or ())
    if not keys:
        raise ValueError("in_keys must name at least one observation, got none.")
    return keys


def _action_size(spec: TensorSpec) -> int:
    if isinstance(spec, Composite):
        raise TypeError(
            f"make_actor: the action must be a single tensor, got a Composite of {list(spec)}: "
            "pass the spec of one action."
        )
    if not spec.dtype.is_floating_point:
        raise TypeError(f"make_actor: the action must be continuous, got {spec}.")
    if spec.ndim != 1:
        raise ValueError(
            f"make_actor: the action spec must have one dimension, got shape {tuple(spec.shape)}: "
            "pass the environment's action_spec_unbatched."
        )
    return spec.shape[0]


def _bounds(spec: TensorSpec) -> dict[str, Tensor]:
    low, high = spec.space.low, spec.space.high
    finite = isinstance(spec, Bounded) and low.isfinite().all() and high.isfinite().all()
    if not (finite and (low < high).all()):
        raise ValueError(
            "make_actor: squashing needs finite bounds of the action, the lower below the upper, "
            f"got {low.tolist()} and {high.tolist()}: use squash='none'."
        )
    return {"low": low, "high": high}
