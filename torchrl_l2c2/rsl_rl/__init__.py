"""L2C2, CATS and other regularizers in rsl_rl's PPO, by class name in a run's configuration.

Needs the extra ``rsl-rl``. ``docs/rsl_rl.md`` has examples.
"""

from importlib.metadata import version


def _check_rsl_rl() -> None:
    """Checks that rsl_rl's PPO accepts a term from elsewhere.

    Raises:
        ImportError: rsl_rl is not installed, or too old.
    """
    try:
        from rsl_rl.extensions import Symmetry  # noqa: F401
    except ImportError as error:
        if error.name == "rsl_rl":
            raise
        raise ImportError(
            "Expected rsl-rl-lib 5.4.1 or newer, whose PPO accepts the regularizer as an "
            f"extension, got {version('rsl-rl-lib')}. Run: pip install 'rsl-rl-lib>=5.4.1'"
        ) from None


_check_rsl_rl()

from torchrl_l2c2.rsl_rl.networks import ActorCriticLoss  # noqa: E402
from torchrl_l2c2.rsl_rl.ppo import CATSPPO, L2C2PPO, RegularizedPPO  # noqa: E402
from torchrl_l2c2.rsl_rl.storage import SuccessorStorage  # noqa: E402

__all__ = ["CATSPPO", "L2C2PPO", "ActorCriticLoss", "RegularizedPPO", "SuccessorStorage"]
