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
TASKS: dict[str, TaskConfig] = {}  # by their names; filled below


@dataclass(frozen=True)
class Budget:
    """Length of a training.

    Attributes:
        total: Number of episodes, or of frames; the last episode is played to its end.
        unit: ``episode`` or ``frame``.
    """

    total: int
    unit: Literal["episode", "frame"] = "episode"

    def at_least(self, other: Budget) -> Budget:
        """The longer of the two; this one where they are not of the same unit."""
        return other if other.unit == self.unit and other.total > self.total else self

    def spent(self, episodes: int, frames: int) -> int:
        """Returns the part that a training of these episodes and frames has used."""
        return episodes if self.unit == "episode" else frames

    def is_late(self, spent: int, share: float) -> bool:
        """Checks whether a training is in its last share, of at least one unit."""
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
        description="length of training in episodes, unless frames are given [inferred: the "
        "paper states none]",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    max_steps: int | None = Field(
        default=None,
        ge=1,
        description="longest episode in steps; null: the task's own limit in Gymnasium",
    )
    solved_at: float | None = Field(
        default=None,
        description="return at which the task counts as solved: a line in the picture",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    frames: int | None = Field(
        default=None,
        ge=1,
        description="length of training in frames, instead of episodes, such as 1e6; it ends "
        "with the first episode that reaches them, or with the first rollout if "
        "algorithm.num_envs is set",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    flatten: bool = Field(
        default=False,
        description="one vector of matrices, nested entries and labels (as one-hot vectors). "
        "Without it, several vectors are joined in the order of their names",
    )
    action_rate: float = Field(
        default=0.0,
        ge=0,
        description="weight of an action-rate penalty: training rewards minus this times the mean "
        "squared change of the action, in halves of its range; tests have the task's own rewards",
        json_schema_extra=neutral(0.0),
    )

    @model_validator(mode="before")
    @classmethod
    def _check_env_id_given(cls, given: ArgsKwargs) -> ArgsKwargs:
        """Refuses a name without a simulator, which would be Swingup's."""
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
                f"must be {own} with name={self.name!r}, got {self.env_id}: give another name (in "
                f"a shell, task=gymnasium task.env_id={self.env_id}).",
            )
        if self.noise_scale is None:
            # Frozen: this is how a default that depends on another field is set.
            object.__setattr__(self, "noise_scale", 0.01 if self.env_id == SWINGUP else 0.0)

    @property
    def budget(self) -> Budget:
        """Length of the training."""
        return Budget(self.episodes) if self.frames is None else Budget(self.frames, "frame")

    def for_test(self) -> TaskConfig:
        """The task with its own rewards."""
        return replace(self, action_rate=0.0)

    def for_episodes(self, episodes: int) -> TaskConfig:
        """The task with a training of so many episodes."""
        return replace(self, episodes=episodes, frames=None)


def _bullet(name: str, **settings: Any) -> TaskConfig:
    return TaskConfig(name.lower(), f"pybullet_envs_gymnasium:{name}BulletEnv-v0", **settings)


# Noise, steps and the returns that count as solved are from the paper; episodes are inferred.
PAPER_TASKS: dict[str, TaskConfig] = {
    "swingup": TaskConfig(max_steps=1000, solved_at=800.0),
    "reacher": _bullet("Reacher", noise_scale=0.01, episodes=4500, max_steps=150, solved_at=18.0),
    "hopper": _bullet("Hopper", noise_scale=0.001, episodes=750, max_steps=1000, solved_at=2500.0),
    "ant": _bullet("Ant", noise_scale=0.001, episodes=750, max_steps=1000, solved_at=2500.0),
}
# Tasks of later methods, without noise; conf/preset/rl_zoo/ has the length of training.
FIELD_TASKS: dict[str, TaskConfig] = {
    "pendulum": TaskConfig("pendulum", "Pendulum-v1"),
    "lunarlander": TaskConfig("lunarlander", "LunarLanderContinuous-v3"),
    "hopper_v5": TaskConfig("hopper_v5", "Hopper-v5"),
    "walker2d_v5": TaskConfig("walker2d_v5", "Walker2d-v5"),
}
TASKS.update(PAPER_TASKS | FIELD_TASKS)
