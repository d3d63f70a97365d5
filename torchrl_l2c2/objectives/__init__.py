"""Losses: the L2C2 and CAPS regularizers, what they are built on, and PPO-RPE."""

from torchrl_l2c2.objectives.caps import CAPSLoss
from torchrl_l2c2.objectives.l2c2 import L2C2Loss
from torchrl_l2c2.objectives.ppo_rpe import PPORPELoss
from torchrl_l2c2.objectives.regularized import RegularizedLoss
from torchrl_l2c2.objectives.shared_evaluation import SharedEvaluation

__all__ = ["CAPSLoss", "L2C2Loss", "PPORPELoss", "RegularizedLoss", "SharedEvaluation"]
