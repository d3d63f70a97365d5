"""Locally Lipschitz continuous constraint (L2C2) for TorchRL: the public names."""

from torchrl_l2c2._version import __version__
from torchrl_l2c2.distances import register_hellinger, squared_error, squared_hellinger
from torchrl_l2c2.metrics import action_variation, local_lipschitz
from torchrl_l2c2.modules import Squish, make_actor, make_critic
from torchrl_l2c2.neighborhood import Neighborhood
from torchrl_l2c2.objectives import CAPSLoss, L2C2Loss, PPORPELoss, RegularizedLoss
from torchrl_l2c2.optim import AdaTerm
from torchrl_l2c2.transforms import NeighborTransform, ObservationNoise
from torchrl_l2c2.updaters import TSoftUpdate

__all__ = [
    "AdaTerm",
    "CAPSLoss",
    "L2C2Loss",
    "NeighborTransform",
    "Neighborhood",
    "ObservationNoise",
    "PPORPELoss",
    "RegularizedLoss",
    "Squish",
    "TSoftUpdate",
    "__version__",
    "action_variation",
    "local_lipschitz",
    "make_actor",
    "make_critic",
    "register_hellinger",
    "squared_error",
    "squared_hellinger",
]
