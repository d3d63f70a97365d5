"""Settings of the regularizers and of the gain's schedule."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings.fields import SettingError, neutral, settings
from torchrl_l2c2.presets import KINDS, METHODS, preset

# Setting -> values of ``gain`` for which the setting has an effect.
USED_WITH_GAIN = {
    "gain_target": ("target",),
    "gain_rate": ("target",),
    "gain_limit": ("target",),
    "gain_length": ("ramp",),
}
# Shared by the regularizers that compare means.
COMPARED_MEAN: Any = Field(
    default="loc",
    description="means to compare: before the squashing (loc) or after it (action); the same for "
    "deterministic policies (td3) [inferred: loc]",
)
# Shared by Grad-CAPS and ASAP, which contains it.
ZIGZAG_EPSILON: Any = Field(
    default=0.1,
    gt=0,
    description="constant in the denominator; smaller values penalize small zigzags more",
)


class RegularizerConfig:
    """Common settings of all regularizers.

    Attributes:
        reads_previous: Whether batches must contain the previous observation.
    """

    reads_previous: ClassVar[bool] = False

    name: str

    @property
    def ramped(self) -> bool:
        """Checks whether the gain is a ramp."""
        return False


@settings
class GainConfig(RegularizerConfig):
    """Common settings of regularizers with a gain, and the gain's schedule."""

    strength: float = Field(
        default=1.0,
        ge=0,
        description="factor on the penalty; larger values smooth more, but too large values lower "
        "the return",
        json_schema_extra=neutral(1.0),
    )
    gain: Literal["constant", "ramp", "target"] = Field(
        default="constant",
        description="schedule of the gain, applied after every episode (or rollout): constant, "
        "ramp (linear from 0 to 1), or target (keeps the action variation of training episodes at "
        "or below gain_target)",
        json_schema_extra=neutral("constant"),
    )
    gain_target: float | None = Field(
        default=None,
        gt=0,
        description="largest action variation with gain=target; smaller values smooth more",
    )
    gain_rate: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="largest change of the gain's logarithm per step of gain=target; larger values "
        "react faster",
        json_schema_extra=neutral(0.1),
    )
    gain_limit: float = Field(
        default=1000.0,
        gt=1,
        description="largest gain of gain=target; the smallest gain is 1 / gain_limit",
        json_schema_extra=neutral(1000.0),
    )
    gain_length: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of training after which gain=ramp reaches its full value",
        json_schema_extra=neutral(1.0),
    )
    relative: bool = Field(
        default=False,
        description="penalty of the policy relative to the mean size of the action values, for sac "
        "and td3; gains then suit rewards of any size",
        json_schema_extra=neutral(False),
    )

    def __post_init__(self) -> None:
        if self.gain in USED_WITH_GAIN["gain_target"] and self.gain_target is None:
            raise SettingError("gain_target", f"must be given with gain={self.gain}, got null.")
        declared: Any = {field.name: field.default for field in dataclasses.fields(GainConfig)}
        for name, gains in USED_WITH_GAIN.items():
            given, default = getattr(self, name), declared[name].default
            if self.gain not in gains and given != default:
                raise SettingError(
                    name,
                    f"works only with gain={' or gain='.join(gains)}, got {given} with "
                    f"gain={self.gain}: change gain, or leave {name} at "
                    f"{'null' if default is None else default}.",
                )

    @property
    def ramped(self) -> bool:
        """Checks whether the gain is a ramp."""
        return self.gain == "ramp"


@settings
class L2C2Config(GainConfig):
    """Settings of L2C2Loss, the paper's method."""

    name: str = "l2c2"
    sigma: float = Field(
        default=1.0,
        gt=0,
        description="size of the neighborhood relative to the step from s to s' [paper]",
    )
    lambda_min: float = Field(
        default=0.01, gt=0, description="gain at the edge of the neighborhood [paper]"
    )
    lambda_max: float = Field(
        default=1.0, gt=0, description="gain at the center of the neighborhood [paper]"
    )
    neighbors: Literal["box", "line"] = Field(
        default="box",
        description="shape of the neighborhood: a box around s with s' at a corner (one random "
        "number per dimension of the state) [paper], or the line through s and s' (one random "
        "number for all dimensions)",
        json_schema_extra=neutral("box"),
    )
    max_step: float | None = Field(
        default=None,
        gt=0,
        description="largest step from s to s' in the observation's units (with "
        "algorithm.normalize_observations, in standard deviations); transitions with larger steps, "
        "such as resets and teleports, have no penalty; null: no limit [paper]",
    )
    beta: float = Field(
        default=0.1,
        ge=0,
        description="gain of the value terms relative to the policy term [paper]",
    )
    num_samples: int = Field(default=1, ge=1, description="neighbors per transition [inferred: 1]")
    over_neighbors: Literal["mean", "max"] = Field(
        default="mean",
        description="reduction over a transition's neighbors: mean [paper] or max of the penalty; "
        "max requires num_samples above 1",
        json_schema_extra=neutral("mean"),
    )
    fraction: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of the batch that is regularized; smaller values save time in large "
        "batches but make the penalty noisier [paper: all]",
        json_schema_extra=neutral(1.0),
    )
    policy_distance: Literal["hellinger", "mean", "mse", "kl"] = Field(
        default="hellinger",
        description="distance between policies: hellinger [paper]; mean: half the squared distance "
        "of the means before the squashing; mse: their mean squared error over the action's "
        "dimensions; kl: the KL divergence. Each distance needs its own gains. For deterministic "
        "policies (td3), hellinger and mean are half the squared distance of the actions",
        json_schema_extra=neutral("hellinger"),
    )

    def __post_init__(self) -> None:
        GainConfig.__post_init__(self)
        if self.lambda_max <= (least := max(1.0, self.sigma) * self.lambda_min):
            raise SettingError(
                "lambda_max",
                f"must be above lambda_min and above sigma * lambda_min, here above {least:g}, got "
                f"{self.lambda_max:g}: increase lambda_max, or decrease lambda_min or sigma.",
            )
        if self.over_neighbors == "max" and self.num_samples == 1:
            raise SettingError("num_samples", "must be above 1 with over_neighbors=max, got 1.")


@settings
class CAPSConfig(GainConfig):
    """Settings of CAPSLoss."""

    name: str = "caps"
    sigma: float = Field(
        default=0.2, gt=0, description="standard deviation of the noise on the state [paper]"
    )
    lambda_temporal: float = Field(
        default=0.01, ge=0, description="gain of the action distance between s and s' [paper]"
    )
    lambda_spatial: float = Field(
        default=0.05,
        ge=0,
        description="gain of the action distance between s and its noisy copy [paper]",
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN


@settings
class CATSConfig(GainConfig):
    """Settings of CATSLoss, with a linear ramp over the training."""

    name: str = "cats"
    gain: Literal["constant", "ramp", "target"] = Field(
        default="ramp", description="schedule of the gain, as for other methods [paper: ramp]"
    )
    lambda_temporal: float = Field(
        default=0.1, ge=0, description="gain of the action distance between s and s' [inferred]"
    )
    mean: Literal["loc", "action"] = COMPARED_MEAN


@settings
class GradCAPSConfig(GainConfig):
    """Settings of GradCAPSLoss, which needs the previous observation in each batch."""

    reads_previous: ClassVar[bool] = True

    name: str = "grad_caps"
    lambda_temporal: float = Field(
        default=0.01, ge=0, description="gain of the action's second difference [inferred]"
    )
    epsilon: float = ZIGZAG_EPSILON
    mean: Literal["loc", "action"] = COMPARED_MEAN


@settings
class ASAPConfig(GainConfig):
    """Settings of ASAPLoss, which needs the previous observation in each batch."""

    reads_previous: ClassVar[bool] = True

    name: str = "asap"
    lambda_spatial: float = Field(
        default=0.3,
        ge=0,
        description="gain of the distance to the predicted action [the authors' value for MuJoCo; "
        "for LunarLander and Pendulum: 0.03]",
    )
    lambda_temporal: float = Field(
        default=2.0, ge=0, description="gain of the predictor's loss [the authors' value]"
    )
    lambda_grad: float = Field(
        default=0.05,
        ge=0,
        description="gain of the action's second difference [the authors' value for MuJoCo; for "
        "LunarLander and Pendulum: 0.005]",
    )
    epsilon: float = ZIGZAG_EPSILON
    mean: Literal["loc", "action"] = COMPARED_MEAN


@settings
class SR2LConfig(GainConfig):
    """Settings of SR2LLoss, whose updates take several times longer than other regularizers."""

    name: str = "sr2l"
    epsilon: float = Field(
        default=0.05, gt=0, description="half the width of the box, in the observation's units"
    )
    coeff: float = Field(default=0.1, ge=0, description="gain of the largest distance in the box")
    steps: int = Field(
        default=10,
        ge=1,
        description="gradient ascent steps towards the worst state in the box; each step is a "
        "forward and backward pass of the policy",
    )
    policy_distance: Literal["jeffreys", "hellinger", "mean", "mse", "kl"] = Field(
        default="jeffreys",
        description="distance between policies; deterministic policies are compared by their "
        "actions, without kl",
    )


@settings
class LCPConfig(GainConfig):
    """Settings of LCPLoss."""

    name: str = "lcp"
    coeff: float = Field(default=0.002, ge=0, description="gain of the squared gradient")
    of: Literal["log_prob", "mean"] = Field(
        default="log_prob",
        description="differentiated function: the log-likelihood [the authors' choice], or the "
        "mean action, whose gradient does not shrink when the policy's scale grows",
    )


@settings
class NoRegularizerConfig(RegularizerConfig):
    """The baseline: the loss without a regularizer."""

    name: str = "none"


# Choices that start with the algorithm's preset: method and overrides. l2c2_paper is not one of
# them: it has the paper's settings for every algorithm.
BEGIN_WITH_PRESET: dict[str, tuple[str, dict[str, Any]]] = {
    "l2c2": ("l2c2", {}),
    "l2c2_constant": ("l2c2", {"gain": "constant"}),
    "l2c2_ramp": ("l2c2", {"gain": "ramp"}),
    **{method: (method, {}) for method in METHODS if method != "l2c2"},
}


def preset_settings(regularizer: str, algorithm: str) -> dict[str, Any]:
    """Returns a regularizer's initial settings for an algorithm.

    Args:
        regularizer (str): Name of the regularizer, a key of :data:`REGULARIZERS`.
        algorithm (str): Name of the algorithm.

    Returns:
        dict: Settings by name; empty if there is no preset.

    Examples:
        >>> preset_settings("l2c2_constant", "ppo")["gain"], preset_settings("l2c2_paper", "ppo")
        ('constant', {})
    """
    if regularizer not in BEGIN_WITH_PRESET or algorithm not in KINDS:
        return {}
    method, own = BEGIN_WITH_PRESET[regularizer]
    chosen = preset(method, algorithm)
    gain: dict[str, Any] = {"gain": "constant" if chosen.ramp is None else "ramp"}
    if chosen.ramp not in (None, 1.0):
        gain["gain_length"] = chosen.ramp
    if chosen.relative:
        gain["relative"] = True
    return {**chosen.settings, **gain, **own}


REGULARIZERS: dict[str, RegularizerConfig] = {
    "none": NoRegularizerConfig(),
    "caps": CAPSConfig(),
    "cats": CATSConfig(),
    "grad_caps": GradCAPSConfig(),
    "asap": ASAPConfig(),
    "sr2l": SR2LConfig(),
    "lcp": LCPConfig(),
    "l2c2": L2C2Config(),
    "l2c2_paper": L2C2Config(name="l2c2_paper"),
    # The paper's ablation: no value term.
    "l2c2_policy": L2C2Config(name="l2c2_policy", beta=0.0),
    # The distance of means suits policies of any scale; a ramp lowers early returns less.
    "l2c2_mean": L2C2Config(name="l2c2_mean", policy_distance="mean"),
    "l2c2_ramp": L2C2Config(name="l2c2_ramp", policy_distance="mean", gain="ramp"),
    "l2c2_constant": L2C2Config(name="l2c2_constant"),
}
