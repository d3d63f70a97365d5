# The public names and where they live: for type checkers, and for __init__.py, which imports a
# name's module when the name is first used.
from ._version import __version__
from .affinities import register_hellinger
from .distances import squared_error, squared_hellinger
from .hooks import ProgressHook
from .metrics import action_variation, local_lipschitz
from .modules import Squish, make_actor, make_critic
from .neighborhood import Neighborhood
from .objectives import (
    ASAPLoss,
    CAPSLoss,
    CATSLoss,
    GradCAPSLoss,
    L2C2Loss,
    LCPLoss,
    PPORPELoss,
    RegularizedLoss,
    SR2LLoss,
)
from .optim import AdaTerm
from .smoothing import smooth
from .transforms import NeighborTransform, ObservationNoise
from .updaters import TSoftUpdate

__all__ = [
    "ASAPLoss",
    "AdaTerm",
    "CAPSLoss",
    "CATSLoss",
    "GradCAPSLoss",
    "L2C2Loss",
    "LCPLoss",
    "NeighborTransform",
    "Neighborhood",
    "ObservationNoise",
    "PPORPELoss",
    "ProgressHook",
    "RegularizedLoss",
    "SR2LLoss",
    "Squish",
    "TSoftUpdate",
    "__version__",
    "action_variation",
    "local_lipschitz",
    "make_actor",
    "make_critic",
    "register_hellinger",
    "smooth",
    "squared_error",
    "squared_hellinger",
]
