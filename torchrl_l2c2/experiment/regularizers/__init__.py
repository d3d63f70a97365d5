"""What is added to the loss: a file for each regularizer, and a line here for each choice."""

from torchrl_l2c2.experiment.regularizers.base import GainConfig, RegularizerConfig
from torchrl_l2c2.experiment.regularizers.caps import CAPSConfig
from torchrl_l2c2.experiment.regularizers.l2c2 import L2C2Config
from torchrl_l2c2.experiment.regularizers.none import NoRegularizerConfig

__all__ = [
    "REGULARIZERS",
    "CAPSConfig",
    "GainConfig",
    "L2C2Config",
    "NoRegularizerConfig",
    "RegularizerConfig",
]

REGULARIZERS: dict[str, RegularizerConfig] = {
    "none": NoRegularizerConfig(),
    "caps": CAPSConfig(),
    "l2c2": L2C2Config(),
    # The paper's ablation: the policy alone is regularized.
    "l2c2_policy": L2C2Config(name="l2c2_policy", beta=0.0),
}
