"""The settings of a run: what its groups are, how they are read, and what depends on several."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings.algorithms import ALGORITHMS, AlgorithmConfig, PPORPEConfig
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
    """Logger of the metrics, in addition to metrics.csv, which has a line per episode."""

    name: Literal["csv", "tensorboard", "wandb", "mlflow"] = Field(
        default="csv", json_schema_extra=CHANGES_NO_NUMBERS
    )


LOGGERS = {
    "csv": LoggerConfig("csv"),
    "tensorboard": LoggerConfig("tensorboard"),
    "wandb": LoggerConfig("wandb"),
    "mlflow": LoggerConfig("mlflow"),
}

# group -> name -> the settings that `group=name` chooses.
GROUPS: dict[str, Mapping[str, Any]] = {
    "task": TASKS,
    "algorithm": ALGORITHMS,
    "regularizer": REGULARIZERS,
    "replay": REPLAYS,
    "optimizer": OPTIMIZERS,
    "logger": LOGGERS,
}
# Settings of the command, which are no settings of a run: default and meaning.
STEERING = {
    "outputs": ("outputs", "folder that holds every run's folder"),
    "preset": ("null", "settings of a task and an algorithm: baselines, rl_zoo, field"),
    "experiment": ("null", "a whole comparison, with -m; conf/experiment/ holds them"),
    "resume": (
        "null",
        "folder of another run to continue from; the same command continues its own run",
    ),
    "allow_other_versions": (
        "false",
        "continue a checkpoint made with other versions of torch, TorchRL or a simulator",
    ),
}


@settings
class ExperimentConfig:
    """Settings of a run, with the defaults of ``python train.py``.

    Left out, ``replay`` and ``optimizer`` are the algorithm's usual ones, and
    ``regularizer`` is L2C2 with the preset of the algorithm, or else the paper's settings; an
    ``L2C2Config()`` that is given begins with the paper's settings.

    Raises:
        SettingError: a setting that is not known or lies outside its range.

    Examples:
        >>> config = ExperimentConfig(task=TaskConfig(episodes=5), regularizer=REGULARIZERS["caps"])
        >>> config.task.episodes, config.regularizer.name, config.replay.batch_size
        (5, 'caps', 32)
    """

    task: TaskConfig = dataclasses.field(default_factory=lambda: TASKS["swingup"])
    algorithm: AlgorithmConfig = dataclasses.field(default_factory=PPORPEConfig)
    # None stands for what __post_init__ chooses by the algorithm.
    regularizer: RegularizerConfig = None  # type: ignore[assignment]
    replay: ReplayConfig = None  # type: ignore[assignment]
    optimizer: OptimizerConfig = None  # type: ignore[assignment]
    logger: LoggerConfig = dataclasses.field(default_factory=LoggerConfig)
    seed: int = Field(
        # Simulators and tests have seeds that are larger, and NumPy takes those below 2 ** 32.
        default=0,
        ge=0,
        lt=2**31,
        description="random seed of the run",
    )
    device: str = Field(
        default="cpu",
        description="device of the updates: cpu, cuda or cuda:N; episodes are played on the "
        "CPU, by a copy of the policy",
        json_schema_extra=neutral("cpu"),
    )
    threads: int = Field(
        default=1,
        ge=1,
        le=1024,
        description="threads of PyTorch; more do not speed up networks of this size",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    compile: bool = Field(
        default=True,
        description="compilation of updates and policies, where a C++ compiler is found; false:"
        " eager",
    )
    on_nonfinite: Literal["stop", "skip"] = Field(
        default="stop",
        description="reaction to a batch whose loss or gradient is NaN or infinite: stop the "
        "run, or skip and count the batch",
    )
    test_episodes: int = Field(
        default=100,
        ge=0,
        description="test episodes after training, with mean actions, and as many with sampled "
        "actions; 0: no evaluation.json, and reports leave the run out",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    evaluate_every: int = Field(
        default=0,
        ge=0,
        description="training episodes between tests of 10 episodes; "
        "policy_best.pt is from the best test; 0: none",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    record: bool = Field(
        default=False,
        description="video.mp4 of a test episode, after training (extra video)",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    late_share: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="final fraction of training whose policies play a test episode each; 0: none",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    checkpoint_interval: float = Field(
        default=60.0,
        ge=0,
        description="seconds between checkpoints, which are written after episodes or rollouts",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )
    checkpoint_keep: int = Field(
        default=2,
        ge=1,
        description="number of newest checkpoints to keep",
        json_schema_extra=CHANGES_NO_NUMBERS,
    )

    def __post_init__(self) -> None:
        # Frozen: this is how a default that depends on another field is set.
        if self.regularizer is None:
            begins = preset_settings("l2c2", self.algorithm.name)
            object.__setattr__(self, "regularizer", L2C2Config(**begins))
        if self.replay is None:
            object.__setattr__(self, "replay", REPLAYS[self.algorithm.usual_replay])
        if self.optimizer is None:
            object.__setattr__(self, "optimizer", OPTIMIZERS[self.algorithm.usual_optimizer])
        self._check_names()
        self._check_device()
        self._check_replay()

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ExperimentConfig:
        """Reads nested mappings, such as a resolved Hydra configuration.

        Args:
            values (Mapping): Settings by group and name. Missing settings have the defaults of the
                group's name, for ``l2c2`` the paper's settings. ``outputs``, ``resume``,
                ``experiment`` and ``allow_other_versions`` are settings of the command, and are
                ignored.

        Raises:
            SettingError: an unknown key, an unknown name, or a value outside its range.
        """
        given = {k: v for k, v in values.items() if k not in STEERING}
        for group in GROUPS.keys() & given.keys():
            given[group] = _read_group(group, given[group])
        return read(cls, given, "")

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries of plain values: ``from_dict`` reads them back."""
        return dataclasses.asdict(self)

    def _check_names(self) -> None:
        """A group is found again by its name, as a run's folder has it; tasks may have any."""
        for group in GROUPS.keys() - {"task"}:
            chosen, choices = getattr(self, group), GROUPS[group]
            if type(choices.get(chosen.name)) is not type(chosen):
                own = [name for name, each in choices.items() if type(each) is type(chosen)]
                raise SettingError(
                    f"{group}.name",
                    f"must be one of {own} with {type(chosen).__name__}, got {chosen.name!r}.",
                )

    def _check_device(self) -> None:
        # Not a pattern of the field, which pydantic would show as it is written.
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise SettingError(
                "device", f"must be cpu, cuda or cuda:N, a number from 0 up, got {self.device!r}."
            )

    def _check_replay(self) -> None:
        on_policy = self.algorithm.usual_replay == "rollout"
        if on_policy != (type(self.replay) is type(REPLAYS["rollout"])):
            raise SettingError(
                "replay",
                f"{self.replay.name!r} is nothing that algorithm {self.algorithm.name!r} can learn "
                "from: ppo needs rollout, the others prioritized or uniform.",
            )


def _read_group(group: str, values: Mapping[str, Any]) -> Any:
    """The settings of a group that a mapping's ``name`` chooses, with its other values."""
    if not isinstance(values, Mapping):
        raise SettingError(group, f"must have settings by their names, got {values!r}.")
    choices, name = GROUPS[group], str(values.get("name"))
    if name in choices:
        return read(partial(dataclasses.replace, choices[name]), values, group)
    if group == "task":  # Any name will do for a task of one's own.
        if values.get("env_id", "") is None:
            raise SettingError(
                "env_id", "must be given with task=gymnasium, such as Pendulum-v1, got null.", group
            )
        return read(TaskConfig, values, group)
    given = values.get("name")
    raise SettingError("name", f"must be one of {sorted(choices)}, got {given!r}.", group)
