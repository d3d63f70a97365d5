"""The tasks: what is learned, with how much noise and for how long."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

SWINGUP = "pybullet_envs_gymnasium:InvertedPendulumSwingupBulletEnv-v0"


@settings
class TaskConfig:
    """A Gymnasium task with noisy observations; by default the paper's Swingup."""

    name: str = "swingup"
    env_id: str = Field(
        default=SWINGUP,
        description="Gymnasium id; `module:id` imports the module that registers it",
    )
    noise_scale: float | None = Field(
        default=None,
        ge=0,
        description="standard deviation of the white noise on every observation; null: the paper's "
        ".01 for Swingup, none for other ids [paper]",
    )
    episodes: int = Field(
        default=400, ge=1, description="to train for [inferred: the paper states none]"
    )
    max_steps: int = Field(
        default=1000,
        ge=1,
        description="longest episode; at most so many frames are collected at once",
    )
    solved_at: float | None = Field(
        default=None, description="return at which the task counts as solved, a line in the picture"
    )

    def __post_init__(self) -> None:
        if self.noise_scale is None:
            # Frozen: this is how a default that depends on another field is set.
            object.__setattr__(self, "noise_scale", 0.01 if self.env_id == SWINGUP else 0.0)

    def make_env(self, seed: int) -> EnvBase:
        """The task's environment, noisy and seeded: :func:`~.environments.make_env`."""
        from torchrl_l2c2.experiment.environments import make_env

        return make_env(self, seed)


def _bullet(name: str) -> str:
    return f"pybullet_envs_gymnasium:{name}BulletEnv-v0"


# Noise, steps and the returns that count as solved are the paper's; episodes are inferred.
TASKS: dict[str, TaskConfig] = {
    "swingup": TaskConfig(solved_at=800.0),
    "reacher": TaskConfig("reacher", _bullet("Reacher"), 0.01, 3000, 150, 18.0),
    "hopper": TaskConfig("hopper", _bullet("Hopper"), 0.001, 1500, 1000, 2500.0),
    "ant": TaskConfig("ant", _bullet("Ant"), 0.001, 1500, 1000, 2500.0),
}
