"""The settings of a run: what its groups are, how they are read, and what depends on several."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from torchrl_l2c2.experiment.algorithms import ALGORITHMS, AlgorithmConfig, PPORPEConfig
from torchrl_l2c2.experiment.optimizers import OPTIMIZERS, OptimizerConfig
from torchrl_l2c2.experiment.regularizers import (
    REGULARIZERS,
    L2C2Config,
    RegularizerConfig,
    preset_settings,
)
from torchrl_l2c2.experiment.replay import REPLAYS, ReplayConfig
from torchrl_l2c2.experiment.settings import SettingError, read, settings
from torchrl_l2c2.experiment.tasks import TASKS, TaskConfig

if TYPE_CHECKING:
    from torchrl.data import TensorDictReplayBuffer
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent


@settings
class LoggerConfig:
    """Where metrics go: metrics.csv, a line per episode; the others get them as well."""

    name: Literal["csv", "tensorboard", "wandb", "mlflow"] = "csv"


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
# Added to a run's seed for its neighbors, as others are for tests and noise: far from all of them.
NEIGHBOR_SEED = 32_452_843
# What steers where and how often runs happen, and is no setting of a run.
STEERING = {"outputs", "experiment", "preset", "resume", "allow_other_versions"}


@settings
class ExperimentConfig:
    """Everything one run depends on; the defaults are those of ``python train.py``.

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
        description="of everything that is random in the run",
    )
    device: str = Field(
        default="cpu",
        description="of the updates and what they learn from: cpu, cuda or cuda:N; episodes are "
        "played on the CPU, by a copy of the policy",
    )
    threads: int = Field(
        default=1, ge=1, le=1024, description="of PyTorch; networks so small gain nothing from more"
    )
    num_workers: int = Field(
        default=1,
        ge=1,
        le=1024,
        description="processes that play episodes, one each in a round with one policy, the last "
        "round whole: 4 play 352 episodes where 350 are asked for; more than 1 needs "
        "algorithm.schedule other than step",
    )
    compile: bool = Field(
        default=True,
        description="compile updates and policies where a C++ compiler is found; false: eager",
    )
    on_nonfinite: Literal["stop", "skip"] = Field(
        default="stop",
        description="what a batch whose loss or gradient is NaN or infinite does (skipped ones are "
        "counted)",
    )
    test_episodes: int = Field(
        default=100,
        ge=0,
        description="episodes played with the policy's mean, and as many with samples, after "
        "training; 0: none, and no evaluation.json, so that reports pass the run over",
    )
    evaluate_every: int = Field(
        default=0,
        ge=0,
        description="training episodes between tests of 10 episodes; "
        "policy_best.pt is from the best test; 0: none",
    )
    record: bool = Field(
        default=False, description="a test episode as video.mp4, after training (extra video)"
    )
    late_share: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="final fraction of training whose policies play one test episode each; 0: none",
    )
    checkpoint_interval: float = Field(
        default=60.0, ge=0, description="seconds between checkpoints, after episodes or rollouts"
    )
    checkpoint_keep: int = Field(
        default=2, ge=1, description="newest checkpoints that stay in the folder"
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
        self._check_rounds()

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> ExperimentConfig:
        """Reads nested mappings, such as a resolved Hydra configuration.

        Args:
            values (Mapping): by group and name; what a group leaves out is the default of its name,
                which for ``l2c2`` is the paper's; ``outputs``, ``resume``, ``experiment`` and
                ``allow_other_versions``, which steer where, whether and how often runs happen, are
                passed over.

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

    def make_env(self) -> EnvBase:
        """The training environment."""
        return self.task.make_env(self.seed)

    def make_agent(self, env: EnvBase) -> Agent:
        """What learns, for an environment's observation and action, on the settings' device.

        Raises:
            SettingError: PyTorch finds no such device.
        """
        import torch

        from torchrl_l2c2.experiment.process import check_device_found

        check_device_found(self.device)
        device = torch.device(self.device)
        with device, warnings.catch_warnings():
            # Target networks get updaters of this package's.
            warnings.filterwarnings("ignore", "No target network updater")
            agent = self.algorithm.make_agent(env, self.regularizer, self.optimizer)
        if device.type != "cpu":
            agent.act_on_cpu()
        return agent

    def make_replay(self) -> TensorDictReplayBuffer:
        """The replay buffer; its batches have what the regularizer wants in them."""
        import torch

        # The last episodes may go past the rollout's frames.
        longest = self.algorithm.frames + self.num_workers * self.task.time_limit
        buffer = self.replay.make(self.seed, longest, self.device)
        # Another seed than the sampler's: with one number for a neighbor both draw as many at a
        # time, and where a transition lies would say which neighbor it gets.
        neighbors = torch.Generator(self.device).manual_seed(self.seed + NEIGHBOR_SEED)
        if (transform := self.regularizer.neighbors(neighbors)) is not None:
            buffer.append_transform(transform)
        return buffer

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

    def _check_rounds(self) -> None:
        """Several workers play whole episodes, and all of them as many."""
        workers = self.num_workers
        if workers > 1 and self.algorithm.num_envs is not None:
            raise SettingError(
                "num_workers",
                f"must be 1 with algorithm.num_envs, whose simulators one process plays, got "
                f"{workers}: leave one of the two.",
            )
        if workers > 1 and self.algorithm.schedule == "step":
            raise SettingError(
                "num_workers",
                f"must be 1 with algorithm.schedule=step, which updates after every frame, got "
                f"{workers}: use one worker, or algorithm.schedule=episode algorithm.updates=null "
                f"algorithm.replay_ratio={self.replay.batch_size}, one update a frame on average.",
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


# What may differ between a run and its continuation: it changes none of the numbers.
FREE_SETTINGS = {
    "logger",
    "test_episodes",
    "late_share",
    "evaluate_every",
    "record",
    "threads",
    "checkpoint_interval",
    "checkpoint_keep",
}
# More episodes or frames are a longer run of the same kind.
FREE_TASK_SETTINGS = {"name", "episodes", "frames", "solved_at"}
# Settings of older runs that there are no more, and that changed none of the numbers.
REMOVED_SETTINGS = ("workers",)
# Settings that are newer than some runs, with the value at which they change none of the numbers.
# Others are newer, too: null and false always are such values.
NEUTRAL_SETTINGS = {
    "device": "cpu",
    "algorithm.activation": "tanh",
    "algorithm.initial_scale": 1.0,
    "algorithm.reduction": "mean",
    "algorithm.time_limit": "truncated",
    "algorithm.scale_mapping": "softplus",
    "regularizer.policy_distance": "hellinger",
    "regularizer.over_neighbors": "mean",
    "regularizer.fraction": 1.0,
    "regularizer.gain": "constant",
    "regularizer.strength": 1.0,
    "regularizer.gain_of": "action_variation",
    "regularizer.gain_rate": 0.1,
    "regularizer.gain_limit": 1000.0,
    "regularizer.gain_length": 1.0,
}


def is_free(name: str, gain_of: str | None = None) -> bool:
    """Whether a setting may differ between a run and its continuation.

    Args:
        name (str): with its group, such as ``"task.solved_at"``; or of a group as a whole.
        gain_of (str, optional): of the regularizer: what a gain follows is part of the training.
    """
    group, _, setting = name.partition(".")
    if group == "late_share" and str(gain_of).startswith("test_"):
        return False
    return group in FREE_SETTINGS or (group == "task" and setting in FREE_TASK_SETTINGS)


def is_neutral(name: str, value: Any) -> bool:
    """Whether a run of before there was this setting has the numbers of one with this value.

    Args:
        name (str): with its group, such as ``"regularizer.policy_distance"``.
        value: of the setting.
    """
    return value is None or value is False or NEUTRAL_SETTINGS.get(name) == value
