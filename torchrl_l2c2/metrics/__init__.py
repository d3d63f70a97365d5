"""Measures of smoothness: the paper's measure, other common measures, and local steepness."""

from torchrl_l2c2.metrics.actions import (
    action_fluctuation_ratio,
    action_jerk,
    action_rate,
    action_variation,
    previous_action_gain,
    saturation,
)
from torchrl_l2c2.metrics.policy import (
    change_with_held_input,
    local_lipschitz,
    noise_sensitivity,
)
from torchrl_l2c2.metrics.spectrum import amplitude_spectrum, roughness, spectral_smoothness

__all__ = [
    "action_fluctuation_ratio",
    "action_jerk",
    "action_rate",
    "action_variation",
    "amplitude_spectrum",
    "change_with_held_input",
    "local_lipschitz",
    "noise_sensitivity",
    "previous_action_gain",
    "roughness",
    "saturation",
    "spectral_smoothness",
]
