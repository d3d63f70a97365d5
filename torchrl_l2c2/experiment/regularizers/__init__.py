"""What is added to the loss: a file for each regularizer, and a line here for each choice."""

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

__all__ = [
    "BEGIN_TUNED",
    "REGULARIZERS",
    "TUNED",
    "TUNED_ON",
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
]

# What begins from settings that were found for the algorithm, with what each has of its own;
# l2c2_paper is the paper's with any.
BEGIN_TUNED: dict[str, dict[str, Any]] = {
    "l2c2": {},
    "l2c2_constant": {"gain": "constant"},
    "l2c2_ramp": {"gain": "ramp"},
}
# These settings, by algorithm, of runs in results/; with others there are none.
TUNED: dict[str, dict[str, Any]] = {
    "ppo": {
        "policy_distance": "mse",
        "gain": "ramp",
        "shared": True,
        "lambda_min": 1.0,
        "lambda_max": 100.0,
        "beta": 0.0,
    },
    "sac": {
        "policy_distance": "mean",
        "shared": True,
        "lambda_min": 10.0,
        "lambda_max": 1000.0,
        "beta": 0.0,
    },
    "td3": {"lambda_min": 0.1, "lambda_max": 10.0},
}
TUNED_ON = {
    "ppo": "Pendulum, LunarLander and Walker2d",
    "sac": "Pendulum",
    # Its loss has the rewards' size, beside which a gain weighs.
    "td3": "Pendulum with algorithm.reward_scale=null",
}

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
    # The paper's ablation: the policy alone is regularized.
    "l2c2_policy": L2C2Config(name="l2c2_policy", beta=0.0),
    # For policies of any scale, and where little is to be lost early.
    "l2c2_mean": L2C2Config(name="l2c2_mean", policy_distance="mean"),
    "l2c2_ramp": L2C2Config(name="l2c2_ramp", policy_distance="mean", gain="ramp"),
    "l2c2_constant": L2C2Config(name="l2c2_constant"),
}
