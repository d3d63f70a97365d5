"""Settings of the tasks: environment, noise and length of training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from pydantic import Field, model_validator
from pydantic_core import ArgsKwargs

from torchrl_l2c2.experiment.settings.fields import (
    CHANGES_NO_NUMBERS,
    SettingError,
    neutral,
    settings,
)

SWINGUP = "pybullet_envs_gymnasium:InvertedPendulumSwingupBulletEnv-v0"
TASKS: dict[str, TaskConfig] = {}  # By name; filled below.


@dataclass(frozen=True)
class Budget:
    """Length of training.

    Attributes:
        total: Number of episodes or frames. The last episode is played to its end.
        unit: ``episode`` or ``frame``.
    """

    total: int
    unit: Literal["episode", "frame"] = "episode"

    def at_least(self, other: Budget) -> Budget:
        """Returns the longer of the two, or this one if the units differ."""
        return other if other.unit == self.unit and other.total > self.total else self

    def spent(self, episodes: int, frames: int) -> int:
        """Returns the number of episodes or frames used, by this budget's unit."""
        return episodes if self.unit == "episode" else frames

    def is_late(self, spent: int, share: float) -> bool:
        """Checks whether training is in its last share, which has at least one unit."""
        return share > 0.0 and self.total - spent < max(1, round(self.total * share))


@settings
class TaskConfig:
    """A Gymnasium task with noisy observations; by default the paper's Swingup."""

    name: str = Field(default="swingup", json_schema_extra=CHANGES_NO_NUMBERS)
    env_id: str = Field(
        default=SWINGUP,
        description="Gymnasium id; `module:id` imports the module that registers it",
    )
    noise_scale: float | None = Field(
        default=None,
        ge=0,
        le=1e9,
        description="standard deviation of the noise on every observation; null: 0.01 for "
        "Swingup, none for other tasks [paper]",
    )
    episodes: int = Field(
        default=350,
        ge=1,
        description="length of training in episodes; not used if frames is set [inferred: the "
        "paper states no length]",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    max_steps: int | None = Field(
        default=None,
        ge=1,
        description="maximum steps per episode; null: the task's own limit in Gymnasium",
    )
    solved_at: float | None = Field(
        default=None,
        description="return at which the task counts as solved; drawn as a line in the picture",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    frames: int | None = Field(
        default=None,
        ge=1,
        description="length of training in frames, instead of episodes, such as 1e6; the last "
        "episode (with algorithm.num_envs, the last rollout) is played to its end",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    flatten: bool = Field(
        default=False,
        description="conversion of matrices, nested entries and labels (as one-hot vectors) to "
        "one vector; false: only vectors are joined, in the order of their names",
    )
    action_rate: float = Field(
        default=0.0,
        ge=0,
        description="weight of an action-rate penalty on training rewards: the mean squared change "
        "of the action, relative to half its range; tests use the task's own rewards",
        json_schema_extra=neutral(0.0),
    )

    @model_validator(mode="before")
    @classmethod
    def _check_env_id_given(cls, given: ArgsKwargs) -> ArgsKwargs:
        """Refuses another name without an env_id: the simulator would be Swingup's."""
        values = given.kwargs or {}
        name = given.args[0] if given.args else values.get("name", "swingup")
        if len(given.args) < 2 and "env_id" not in values and name != "swingup":
            instead = f"TASKS[{name!r}]" if name in TASKS else f"TaskConfig({name!r}, ENV_ID)"
            raise SettingError("env_id", f"must be given with name={name!r}: write {instead}.")
        return given

    def __post_init__(self) -> None:
        if self.name in TASKS and self.env_id != (own := TASKS[self.name].env_id):
            raise SettingError(
                "env_id",
                f"must be {own} with name={self.name!r}, got {self.env_id}: use another name (on "
                f"the command line: task=gymnasium task.env_id={self.env_id}).",
            )
        if self.noise_scale is None:
            # A frozen dataclass: defaults that depend on other fields need object.__setattr__.
            object.__setattr__(self, "noise_scale", 0.01 if self.env_id == SWINGUP else 0.0)

    @property
    def budget(self) -> Budget:
        """Length of training."""
        return Budget(self.episodes) if self.frames is None else Budget(self.frames, "frame")

    def for_test(self) -> TaskConfig:
        """Returns the task with its own rewards, without the action-rate penalty."""
        return replace(self, action_rate=0.0)

    def for_episodes(self, episodes: int) -> TaskConfig:
        """Returns the task with a training of this many episodes."""
        return replace(self, episodes=episodes, frames=None)


def _bullet(name: str, **settings: Any) -> TaskConfig:
    return TaskConfig(name.lower(), f"pybullet_envs_gymnasium:{name}BulletEnv-v0", **settings)


# Noise, steps and solved_at are from the paper; episodes are inferred.
PAPER_TASKS: dict[str, TaskConfig] = {
    "swingup": TaskConfig(max_steps=1000, solved_at=800.0),
    "reacher": _bullet("Reacher", noise_scale=0.01, episodes=4500, max_steps=150, solved_at=18.0),
    "hopper": _bullet("Hopper", noise_scale=0.001, episodes=750, max_steps=1000, solved_at=2500.0),
    "ant": _bullet("Ant", noise_scale=0.001, episodes=750, max_steps=1000, solved_at=2500.0),
}
# Tasks of later methods, without noise; conf/preset/rl_zoo/ sets the length of training.
FIELD_TASKS: dict[str, TaskConfig] = {
    "pendulum": TaskConfig("pendulum", "Pendulum-v1"),
    "lunarlander": TaskConfig("lunarlander", "LunarLanderContinuous-v3"),
    "hopper_v5": TaskConfig("hopper_v5", "Hopper-v5"),
    "walker2d_v5": TaskConfig("walker2d_v5", "Walker2d-v5"),
}
TASKS.update(PAPER_TASKS | FIELD_TASKS)
