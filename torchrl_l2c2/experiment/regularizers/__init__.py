"""Choices of the setting ``regularizer``. Each regularizer has a file."""

from typing import Any

from torchrl_l2c2.experiment.regularizers.asap import ASAPConfig
from torchrl_l2c2.experiment.regularizers.base import GainConfig, RegularizerConfig
from torchrl_l2c2.experiment.regularizers.caps import CAPSConfig
from torchrl_l2c2.experiment.regularizers.cats import CATSConfig
from torchrl_l2c2.experiment.regularizers.grad_caps import GradCAPSConfig
from torchrl_l2c2.experiment.regularizers.l2c2 import L2C2Config
from torchrl_l2c2.experiment.regularizers.lcp import LCPConfig
from torchrl_l2c2.experiment.regularizers.none import NoRegularizerConfig
from torchrl_l2c2.experiment.regularizers.sr2l import SR2LConfig
from torchrl_l2c2.presets import KINDS, METHODS, preset

__all__ = [
    "BEGIN_WITH_PRESET",
    "REGULARIZERS",
    "ASAPConfig",
    "CAPSConfig",
    "CATSConfig",
    "GainConfig",
    "GradCAPSConfig",
    "L2C2Config",
    "LCPConfig",
    "NoRegularizerConfig",
    "RegularizerConfig",
    "SR2LConfig",
    "preset_settings",
]

# Choices that start from the algorithm's preset, with their overrides. l2c2_paper has the paper's
# settings with every algorithm.
BEGIN_WITH_PRESET: dict[str, tuple[str, dict[str, Any]]] = {
    "l2c2": ("l2c2", {}),
    "l2c2_constant": ("l2c2", {"gain": "constant"}),
    "l2c2_ramp": ("l2c2", {"gain": "ramp"}),
    **{method: (method, {}) for method in METHODS if method != "l2c2"},
}


def preset_settings(regularizer: str, algorithm: str) -> dict[str, Any]:
    """The initial settings of a regularizer for an algorithm.

    Args:
        regularizer (str): a name in :data:`REGULARIZERS`.
        algorithm (str): name of the algorithm.

    Returns:
        dict: settings by name; empty if there is no preset.

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
    # The paper's ablation: only the policy is regularized.
    "l2c2_policy": L2C2Config(name="l2c2_policy", beta=0.0),
    # The distance of the means suits policies of any scale; a ramp costs less return early.
    "l2c2_mean": L2C2Config(name="l2c2_mean", policy_distance="mean"),
    "l2c2_ramp": L2C2Config(name="l2c2_ramp", policy_distance="mean", gain="ramp"),
    "l2c2_constant": L2C2Config(name="l2c2_constant"),
}
