"""The experiment's settings: one frozen dataclass per group of ``conf/``, checked when made.

The YAML files of ``conf/`` choose values; these classes name and check them, so that a script or
a notebook has the same defaults without Hydra: ``ExperimentConfig()`` is ``python train.py``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

SWINGUP = "pybullet_envs_gymnasium:InvertedPendulumSwingupBulletEnv-v0"


@dataclass(frozen=True)
class TaskConfig:
    """What is learned: a Gymnasium task with noisy observations. Comments: ``conf/task/``.

    Left at ``None``, ``noise_scale`` is the paper's for Swingup, and none for any other task.
    """

    name: str = "swingup"
    env_id: str = SWINGUP
    noise_scale: float | None = None
    episodes: int = 200
    max_steps: int = 1000
    solved_at: float | None = None

    def __post_init__(self) -> None:
        if self.noise_scale is None:
            # Frozen: this is how a default that depends on another field is set.
            object.__setattr__(self, "noise_scale", 0.01 if self.env_id == SWINGUP else 0.0)
        _nonnegative(self, "noise_scale")
        _whole(self, "episodes", "max_steps")


@dataclass(frozen=True)
class PPORPEConfig:
    """PPO-RPE, its networks and its updates. Comments: ``conf/algorithm/ppo_rpe.yaml``."""

    name: str = "ppo_rpe"
    gamma: float = 0.99
    kappa: float = 0.5
    beta: float = 0.5
    decay: float = 0.999
    delta_min: float = 0.1
    threshold: str = "max"
    critic_weighting: str = "ratio"
    baseline: str = "stored"
    importance: str = "max"
    acting_policy: str = "target"
    reward_scale: float | None = None
    squash: str = "tanh"
    hidden: tuple[int, ...] = (100, 100)
    num_heads: int = 5
    squish_b: float = 4.0
    schedule: str = "episode"
    replay_ratio: float | None = None
    updates: int | None = None
    tau: float = 0.1
    nu: float = 1.0

    def __post_init__(self) -> None:
        _choice(self, "acting_policy", "target", "online")
        _choice(self, "schedule", "episode", "step")
        _choice(self, "squash", "tanh", "none")
        _whole(self, "num_heads")
        if self.updates is not None:
            _whole(self, "updates")
        if self.replay_ratio is not None:
            _positive(self, "replay_ratio")
            if self.updates is not None or self.schedule != "episode":
                raise ValueError(
                    f"{_where(self, 'replay_ratio')}={self.replay_ratio} says how many updates "
                    "follow an episode: it needs schedule='episode' and updates=None, got "
                    f"schedule={self.schedule!r} and updates={self.updates}."
                )


@dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic. Comments: ``conf/algorithm/sac.yaml``."""

    name: str = "sac"
    gamma: float = 0.99
    tau: float = 0.005
    alpha_init: float = 1.0
    hidden: tuple[int, ...] = (256, 256)
    random_frames: int = 1000
    reward_scale: float | None = 1.0
    schedule: str = "step"
    updates: int | None = 1

    def __post_init__(self) -> None:
        _off_policy(self)


@dataclass(frozen=True)
class TD3Config:
    """Twin delayed DDPG. Comments: ``conf/algorithm/td3.yaml``."""

    name: str = "td3"
    gamma: float = 0.99
    tau: float = 0.005
    exploration_noise: float = 0.1
    policy_noise: float = 0.2
    noise_clip: float = 0.5
    policy_delay: int = 2
    hidden: tuple[int, ...] = (256, 256)
    random_frames: int = 1000
    reward_scale: float | None = 1.0
    schedule: str = "step"
    updates: int | None = 1

    def __post_init__(self) -> None:
        _off_policy(self)
        _whole(self, "policy_delay")


@dataclass(frozen=True)
class DQNConfig:
    """Double deep Q-learning, for discrete actions. Comments: ``conf/algorithm/dqn.yaml``."""

    name: str = "dqn"
    gamma: float = 0.99
    tau: float = 0.005
    epsilon_end: float = 0.05
    epsilon_frames: int = 10_000
    hidden: tuple[int, ...] = (120, 84)
    random_frames: int = 1000
    reward_scale: float | None = 1.0
    schedule: str = "step"
    updates: int | None = 1

    def __post_init__(self) -> None:
        _off_policy(self)
        _whole(self, "epsilon_frames")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimization with a clipped ratio. Comments: ``conf/algorithm/ppo.yaml``."""

    name: str = "ppo"
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_epsilon: float = 0.2
    entropy_coeff: float = 0.0
    critic_coeff: float = 0.5
    max_grad_norm: float = 0.5
    frames: int = 2048
    epochs: int = 10
    hidden: tuple[int, ...] = (64, 64)
    reward_scale: float | None = 1.0
    schedule: str = "rollout"

    def __post_init__(self) -> None:
        _choice(self, "schedule", "rollout")
        _whole(self, "frames", "epochs")


@dataclass(frozen=True)
class NoRegularizerConfig:
    """The loss as it is: the paper's vanilla."""

    name: str = "none"


@dataclass(frozen=True)
class CAPSConfig:
    """The baseline. Comments: ``conf/regularizer/caps.yaml``."""

    name: str = "caps"
    sigma: float = 0.2
    lambda_temporal: float = 0.01
    lambda_spatial: float = 0.05
    mean: str = "loc"


@dataclass(frozen=True)
class L2C2Config:
    """The paper's method. Comments: ``conf/regularizer/l2c2.yaml``."""

    name: str = "l2c2"
    sigma: float = 1.0
    lambda_min: float = 0.01
    lambda_max: float = 1.0
    beta: float = 0.1
    num_samples: int = 1


@dataclass(frozen=True)
class PrioritizedReplayConfig:
    """Prioritized experience replay. Comments: ``conf/replay/prioritized.yaml``."""

    name: str = "prioritized"
    capacity: int = 10_000
    batch_size: int = 32
    alpha: float = 1.0
    beta: float = 0.5

    def __post_init__(self) -> None:
        _whole(self, "capacity", "batch_size")
        _nonnegative(self, "alpha", "beta")
        _fits(self)


@dataclass(frozen=True)
class UniformReplayConfig:
    """Uniform experience replay. Comments: ``conf/replay/uniform.yaml``."""

    name: str = "uniform"
    capacity: int = 100_000
    batch_size: int = 256

    def __post_init__(self) -> None:
        _whole(self, "capacity", "batch_size")
        _fits(self)


@dataclass(frozen=True)
class RolloutReplayConfig:
    """The frames of one rollout, for on-policy learning. Comments: ``conf/replay/rollout.yaml``."""

    name: str = "rollout"
    batch_size: int = 64

    def __post_init__(self) -> None:
        _whole(self, "batch_size")


@dataclass(frozen=True)
class AdaTermConfig:
    """The paper's optimizer. Comments: ``conf/optimizer/adaterm.yaml``."""

    name: str = "adaterm"
    lr: float = 1e-3
    beta: float = 0.9
    eps: float = 1e-5
    nu_min: float = 1.0


@dataclass(frozen=True)
class AdamConfig:
    """Adam. Comments: ``conf/optimizer/adam.yaml``."""

    name: str = "adam"
    lr: float = 3e-4
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-8


@dataclass(frozen=True)
class LoggerConfig:
    """Where metrics go. Comments: ``conf/logger/``."""

    name: str = "csv"


AlgorithmConfig = PPORPEConfig | SACConfig | TD3Config | DQNConfig | PPOConfig
RegularizerConfig = NoRegularizerConfig | CAPSConfig | L2C2Config
ReplayConfig = PrioritizedReplayConfig | UniformReplayConfig | RolloutReplayConfig
OptimizerConfig = AdaTermConfig | AdamConfig

# group -> name -> its class; what a group's `name` may be.
GROUPS: dict[str, dict[str, type]] = {
    "algorithm": {
        "ppo_rpe": PPORPEConfig,
        "sac": SACConfig,
        "td3": TD3Config,
        "dqn": DQNConfig,
        "ppo": PPOConfig,
    },
    "regularizer": {
        "none": NoRegularizerConfig,
        "caps": CAPSConfig,
        "l2c2": L2C2Config,
        "l2c2_policy": L2C2Config,
    },
    "replay": {
        "prioritized": PrioritizedReplayConfig,
        "uniform": UniformReplayConfig,
        "rollout": RolloutReplayConfig,
    },
    "optimizer": {"adaterm": AdaTermConfig, "adam": AdamConfig},
    "logger": {"csv": LoggerConfig, "tensorboard": LoggerConfig},
}


@dataclass(frozen=True)
class ExperimentConfig:
    """Everything one run depends on; the defaults are those of ``python train.py``.

    Left at ``None``, ``replay`` and ``optimizer`` are the algorithm's usual ones.

    Raises:
        ValueError: a setting that is not known or lies outside its range.

    Examples:
        >>> config = ExperimentConfig(task=TaskConfig(episodes=5), regularizer=CAPSConfig())
        >>> config.task.episodes, config.regularizer.name, config.replay.batch_size
        (5, 'caps', 32)
    """

    task: TaskConfig = field(default_factory=lambda: TaskConfig(solved_at=800.0))
    algorithm: AlgorithmConfig = field(default_factory=PPORPEConfig)
    regularizer: RegularizerConfig = field(default_factory=L2C2Config)
    replay: ReplayConfig | None = None
    optimizer: OptimizerConfig | None = None
    logger: LoggerConfig = field(default_factory=LoggerConfig)
    seed: int = 0
    threads: int = 1
    num_workers: int = 1
    compile: bool = True
    on_nonfinite: str = "stop"
    test_episodes: int = 100
    late_share: float = 0.1
    checkpoint_interval: float = 60.0
    checkpoint_keep: int = 2

    def __post_init__(self) -> None:
        replay, optimizer = _usual(self.algorithm)
        object.__setattr__(self, "replay", self.replay or replay)
        object.__setattr__(self, "optimizer", self.optimizer or optimizer)
        on_policy = isinstance(self.algorithm, PPOConfig)
        if on_policy != isinstance(self.replay, RolloutReplayConfig):
            raise ValueError(
                f"algorithm={self.algorithm.name} cannot learn from replay={self.replay.name}: "
                "ppo needs replay=rollout, the others replay=prioritized or replay=uniform."
            )
        _whole(self, "threads", "num_workers", "test_episodes", "checkpoint_keep")
        _check_rounds(self)
        _nonnegative(self, "checkpoint_interval", "late_share")
        if self.late_share > 1:
            raise ValueError(f"late_share must be at most 1, got {self.late_share!r}.")
        _choice(self, "on_nonfinite", "stop", "skip")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"seed must be a whole number of at least 0, got {self.seed!r}.")

    @classmethod
    def from_dict(cls, settings: Mapping[str, Any]) -> ExperimentConfig:
        """Reads nested mappings, such as a resolved Hydra configuration.

        Args:
            settings (Mapping): the groups and keys of ``conf/``; ``outputs``, ``resume``
                and ``experiment``, which steer where and how often runs happen, are passed over.

        Raises:
            ValueError: an unknown key, an unknown name, or a value outside its range.
        """
        values = {k: v for k, v in settings.items() if k not in ("outputs", "experiment", "resume")}
        for group, names in GROUPS.items():
            if group in values:
                values[group] = _read_group(group, names, values[group])
        if "task" in values:
            values["task"] = _construct(TaskConfig, values["task"], "task.")
        return _construct(cls, values, "")

    def to_dict(self) -> dict[str, Any]:
        """Nested dictionaries of plain values: ``from_dict`` reads them back."""
        return dataclasses.asdict(self)


def _usual(algorithm: AlgorithmConfig) -> tuple[ReplayConfig, OptimizerConfig]:
    if isinstance(algorithm, PPORPEConfig):
        return PrioritizedReplayConfig(), AdaTermConfig()
    if isinstance(algorithm, PPOConfig):
        return RolloutReplayConfig(), AdamConfig()
    return UniformReplayConfig(), AdamConfig()


def _read_group(group: str, names: Mapping[str, type], values: Mapping[str, Any]) -> Any:
    name = values.get("name")
    if name not in names:
        raise ValueError(f"{group}.name must be one of {sorted(names)}, got {name!r}.")
    return _construct(names[name], values, f"{group}.")


def _construct(cls: type, values: Mapping[str, Any], prefix: str) -> Any:
    allowed = {f.name for f in dataclasses.fields(cls)}
    unknown = sorted(set(values) - allowed)
    if unknown:
        raise ValueError(
            f"unknown setting {prefix}{unknown[0]}; allowed here are "
            f"{', '.join(prefix + name for name in sorted(allowed))}."
        )
    return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _where(config: object, name: str) -> str:
    return f"{type(config).__name__}.{name}"


def _nonnegative(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if not (math.isfinite(value) and value >= 0):
            raise ValueError(f"{_where(config, name)} must be at least 0, got {value!r}.")


def _positive(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{_where(config, name)} must be greater than 0, got {value!r}.")


def _whole(config: object, *names: str) -> None:
    for name in names:
        value = getattr(config, name)
        if isinstance(value, bool) or not isinstance(value, int) or value < 1:
            raise ValueError(
                f"{_where(config, name)} must be a whole number of at least 1, got {value!r}."
            )


def _check_rounds(config: ExperimentConfig) -> None:
    """Several workers play whole episodes, and all of them as many."""
    workers, episodes = config.num_workers, config.task.episodes
    if workers > 1 and config.algorithm.schedule == "step":
        raise ValueError(
            f"num_workers={workers} play whole episodes, and algorithm.schedule=step updates after "
            "every frame: use algorithm.schedule=episode, or num_workers=1."
        )
    if episodes % workers:
        raise ValueError(
            f"task.episodes={episodes} must be a multiple of num_workers={workers}, which play "
            f"one each in a round: use {episodes - episodes % workers or workers}, for example."
        )


def _off_policy(config: SACConfig | TD3Config | DQNConfig) -> None:
    _choice(config, "schedule", "step", "episode")
    _nonnegative(config, "random_frames")
    if config.updates is not None:
        _whole(config, "updates")


def _choice(config: object, name: str, *allowed: str) -> None:
    if getattr(config, name) not in allowed:
        raise ValueError(
            f"{_where(config, name)} must be one of {allowed}, got {getattr(config, name)!r}."
        )


def _fits(config: PrioritizedReplayConfig | UniformReplayConfig) -> None:
    if config.capacity < config.batch_size:
        raise ValueError(
            f"{_where(config, 'capacity')} must be at least the batch_size "
            f"({config.batch_size}), got {config.capacity}."
        )
