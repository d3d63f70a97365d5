"""Losses: L2C2 and other regularizers, their base class, and PPO-RPE."""

from torchrl_l2c2.objectives._evaluation import SharedEvaluation
from torchrl_l2c2.objectives.asap import ASAPLoss
from torchrl_l2c2.objectives.caps import CAPSLoss
from torchrl_l2c2.objectives.cats import CATSLoss
from torchrl_l2c2.objectives.grad_caps import GradCAPSLoss
from torchrl_l2c2.objectives.l2c2 import L2C2Loss
from torchrl_l2c2.objectives.lcp import LCPLoss
from torchrl_l2c2.objectives.ppo_rpe import PPORPELoss
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.objectives.sr2l import SR2LLoss

__all__ = [
    "ASAPLoss",
    "CAPSLoss",
    "CATSLoss",
    "GradCAPSLoss",
    "L2C2Loss",
    "LCPLoss",
    "PPORPELoss",
    "RegularizedLoss",
    "SR2LLoss",
    "SharedEvaluation",
]
