"""L2C2, CATS and other regularizers in rsl_rl's PPO, by class name in a run's configuration.

Needs the extra ``rsl-rl``. ``docs/rsl_rl.md`` has examples.
"""

from torchrl_l2c2.rsl_rl.networks import ActorCriticLoss
from torchrl_l2c2.rsl_rl.ppo import CATSPPO, L2C2PPO, RegularizedPPO
from torchrl_l2c2.rsl_rl.storage import SuccessorStorage

__all__ = ["CATSPPO", "L2C2PPO", "ActorCriticLoss", "RegularizedPPO", "SuccessorStorage"]
