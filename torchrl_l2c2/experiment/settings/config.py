"""Settings of a run, their groups, and checks across groups."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings.algorithms import (
    ALGORITHMS,
    AlgorithmConfig,
    PerStepConfig,
    PPORPEConfig,
    TD3Config,
)
from torchrl_l2c2.experiment.settings.fields import (
    CHANGES_NO_NUMBERS,
    SettingError,
    neutral,
    read,
    settings,
)
from torchrl_l2c2.experiment.settings.optimizers import OPTIMIZERS, OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import (
    REGULARIZERS,
    L2C2Config,
    RegularizerConfig,
    preset_settings,
)
from torchrl_l2c2.experiment.settings.replay import REPLAYS, ReplayConfig
from torchrl_l2c2.experiment.settings.tasks import TASKS, TaskConfig


@settings
class LoggerConfig:
    """Logger of the metrics, in addition to metrics.csv with one line per episode."""

    name: Literal["csv", "tensorboard", "wandb", "mlflow"] = Field(
        default="csv", json_schema_extra=CHANGES_NO_NUMBERS
    )


LOGGERS = {
    "csv": LoggerConfig("csv"),
    "tensorboard": LoggerConfig("tensorboard"),
    "wandb": LoggerConfig("wandb"),
    "mlflow": LoggerConfig("mlflow"),
}

# group -> name -> settings of `group=name`.
GROUPS: dict[str, Mapping[str, Any]] = {
    "task": TASKS,
    "algorithm": ALGORITHMS,
    "regularizer": REGULARIZERS,
    "replay": REPLAYS,
    "optimizer": OPTIMIZERS,
    "logger": LOGGERS,
}
# Settings of the command only, not of a run: default and description.
COMMAND_SETTINGS = {
    "outputs": ("outputs", "parent folder of all run folders"),
    "preset": ("none", "settings of a task and an algorithm: baselines, rl_zoo, field"),
    "experiment": ("none", "a whole comparison from conf/experiment/, with -m"),
    "allow_other_versions": (
        "false",
        "continue a checkpoint made with other versions of torch, TorchRL or a simulator",
    ),
}


@settings
class ExperimentConfig:
    """Settings of a run, with the defaults of ``python train.py``.

    ``replay`` and ``optimizer`` default to the algorithm's own choices. ``regularizer`` defaults to
    L2C2 with the algorithm's preset, or with the paper's settings if there is no preset. An
    explicit ``L2C2Config()`` always has the paper's settings.

    Raises:
        SettingError: If a setting is unknown or outside its range.

    Examples:
        >>> config = ExperimentConfig(task=TaskConfig(episodes=5), regularizer=REGULARIZERS["caps"])
        >>> config.task.episodes, config.regularizer.name, config.replay.batch_size
        (5, 'caps', 32)
    """

    task: TaskConfig = dataclasses.field(default_factory=lambda: TASKS["swingup"])
    algorithm: AlgorithmConfig = dataclasses.field(default_factory=PPORPEConfig)
    # None: __post_init__ chooses by the algorithm.
    regularizer: RegularizerConfig = None  # type: ignore[assignment]
    replay: ReplayConfig = None  # type: ignore[assignment]
    optimizer: OptimizerConfig = None  # type: ignore[assignment]
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    seed: int = Field(
        # Simulators and tests use larger seeds, and NumPy's limit is 2 ** 32.
        default=0,
        ge=0,
        lt=2**31,
        description="random seed of the run",
    )
    device: str = Field(
        default="cpu",
        description="device of the updates: cpu, cuda or cuda:N; a copy of the policy plays "
        "episodes on the CPU",
        json_schema_extra=neutral("cpu"),
    )
    threads: int = Field(
        default=1,
        ge=1,
        le=1024,
        description="number of PyTorch threads; more speed up large layers only",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    compile: bool = Field(
        default=True,
        description="compilation of updates and policies if a C++ compiler is found; false: eager "
        "mode",
    )
    test_episodes: int = Field(
        default=100,
        ge=0,
        description="number of test episodes after training with mean actions, and the same number "
        "with sampled actions; 0: no evaluation.json, and reports leave the run out",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    evaluate_every: int = Field(
        default=0,
        ge=0,
        description="training episodes between tests of 10 episodes; policy_best.pt is the policy "
        "with the best test; 0: no tests during training",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    late_share: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="last fraction of training in which every policy plays a test episode; 0: none",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    checkpoint_interval: float = Field(
        default=60.0,
        ge=0,
        description="minimum time between checkpoints in seconds; a checkpoint is saved after an "
        "episode or a rollout",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    checkpoint_keep: int = Field(
        default=2,
        ge=1,
        description="number of latest checkpoints to keep",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )

    def __post_init__(self) -> None:
        # A frozen dataclass: defaults that depend on other fields need object.__setattr__.
        if self.regularizer is None:
            initial = preset_settings("l2c2", self.algorithm.name)
            object.__setattr__(self, "regularizer", L2C2Config(**initial))
        if self.replay is None:
            object.__setattr__(self, "replay", REPLAYS[self.algorithm.default_replay])
        if self.optimizer is None:
            object.__setattr__(self, "optimizer", OPTIMIZERS[self.algorithm.default_optimizer])
        self._check_names()
        self._check_device()
        self._check_replay()
        self._check_distribution()
        self._check_relative()

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ExperimentConfig:
        """Creates the settings from nested mappings, such as a resolved Hydra configuration.

        Args:
            values (Mapping): Settings by group and name. Missing settings have the defaults of the
                group's ``name``; for ``l2c2``, the paper's settings. Settings of the command
                (``outputs``, ``preset``, ``experiment``, ``allow_other_versions``) are ignored.

        Raises:
            SettingError: If a key or name is unknown, or a value is outside its range.
        """
        given = {k: v for k, v in values.items() if k not in COMMAND_SETTINGS}
        for group in GROUPS.keys() & given.keys():
            given[group] = _read_group(group, given[group])
        return read(cls, given, "")

    def to_dict(self) -> dict[str, Any]:
        """Returns nested dictionaries of plain values, the inverse of :meth:`from_dict`."""
        return dataclasses.asdict(self)

    def _check_names(self) -> None:
        """Checks that each group's name belongs to its class; tasks may have any name."""
        for group in GROUPS.keys() - {"task"}:
            chosen, choices = getattr(self, group), GROUPS[group]
            if type(choices.get(chosen.name)) is not type(chosen):
                own = [name for name, each in choices.items() if type(each) is type(chosen)]
                raise SettingError(
                    f"{group}.name",
                    f"must be one of {own} with {type(chosen).__name__}, got {chosen.name!r}.",
                )

    def _check_device(self) -> None:
        # Not a pattern of the field: pydantic would show the regular expression to the user.
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise SettingError(
                "device", f"must be cpu, cuda or cuda:N with N >= 0, got {self.device!r}."
            )

    def _check_replay(self) -> None:
        on_policy = self.algorithm.default_replay == "rollout"
        if on_policy != (type(self.replay) is type(REPLAYS["rollout"])):
            raise SettingError(
                "replay",
                f"{self.replay.name!r} does not work with algorithm {self.algorithm.name!r}: ppo "
                "needs rollout, the others prioritized or uniform.",
            )

    def _check_distribution(self) -> None:
        """Checks that TD3, whose policy is deterministic, needs no distribution of actions."""
        if not isinstance(self.algorithm, TD3Config):
            return
        for setting, value in (("policy_distance", "kl"), ("of", "log_prob")):
            if getattr(self.regularizer, setting, None) == value:
                raise SettingError(
                    f"regularizer.{setting}",
                    f"must not be {value} with algorithm={self.algorithm.name}, whose policy is "
                    "deterministic and no distribution: choose mean.",
                )

    def _check_relative(self) -> None:
        """Checks that a relative penalty has action values that it is relative to."""
        by_value = isinstance(self.algorithm, PerStepConfig)
        if not by_value and getattr(self.regularizer, "relative", False):
            raise SettingError(
                "regularizer.relative",
                f"must be false with algorithm={self.algorithm.name}, which trains no policy by an "
                "action value: sac and td3 do.",
            )


def _read_group(group: str, values: Mapping[str, Any]) -> Any:
    """Reads a group: the choice given by ``name``, changed by the other values."""
    if not isinstance(values, Mapping):
        raise SettingError(group, f"must be a mapping of settings by name, got {values!r}.")
    choices, name = GROUPS[group], str(values.get("name"))
    if name in choices:
        return read(partial(dataclasses.replace, choices[name]), values, group)
    if group == "task":  # A user's own task may have any name.
        if values.get("env_id", "") is None:
            raise SettingError(
                "env_id", "must be given with task=gymnasium, such as Pendulum-v1, got null.", group
            )
        return read(TaskConfig, values, group)
    given = values.get("name")
    raise SettingError("name", f"must be one of {sorted(choices)}, got {given!r}.", group)
