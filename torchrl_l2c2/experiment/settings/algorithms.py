"""Settings of the algorithms."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings.fields import SettingError, neutral, settings

Layers = tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...]
"""Number of neurons of each hidden layer."""


class AlgorithmConfig:
    """Common settings of all algorithms.

    Attributes:
        default_replay: Name of the algorithm's default replay buffer.
        default_optimizer: Name of the algorithm's default optimizer.
        frames: Minimum frames per rollout; 0 for algorithms with a replay buffer.
        num_envs: Number of simulators that one policy plays in turn; ``None`` for one simulator
            that plays whole episodes.
        random_frames: Frames with random actions before learning starts.
    """

    default_replay: ClassVar[str] = "uniform"
    default_optimizer: ClassVar[str] = "adam"

    frames: int = 0
    num_envs: int | None = None
    random_frames: int = 0

    name: str
    gamma: float
    reward_scale: float | None
    schedule: str

    @property
    def reward_factor(self) -> float:
        """Factor on rewards during learning."""
        return 1.0 - self.gamma if self.reward_scale is None else self.reward_scale


class OffPolicyConfig(AlgorithmConfig):
    """Common settings of algorithms with a replay buffer.

    Attributes:
        default_replay_ratio: Default of ``replay_ratio``.
    """

    default_replay_ratio: ClassVar[float | None] = None

    replay_ratio: float | None
    updates: int | None

    def __post_init__(self) -> None:
        # Only the default ratio may be overridden by a number of updates.
        changed = self.replay_ratio not in (None, self.default_replay_ratio)
        if changed and self.updates is not None:
            raise SettingError(
                "replay_ratio",
                f"and updates both set the number of updates: set one to null, got "
                f"{self.replay_ratio} and {self.updates}.",
            )

    def updates_after(self, frames: int, last_frame: int, stored: int, batch_size: int) -> int:
        """Returns the number of updates due after new frames.

        Args:
            frames (int): Number of new frames.
            last_frame (int): Total number of frames of the run, including the new ones.
            stored (int): Number of transitions in the replay buffer.
            batch_size (int): Number of transitions per update.
        """
        if self.updates is not None:
            return self.updates
        if self.replay_ratio is None:
            return 1 if self.schedule == "step" else stored // batch_size
        # The difference of totals: fractions of an update add up to whole updates.
        per_frame = self.replay_ratio / batch_size
        return int(per_frame * last_frame) - int(per_frame * (last_frame - frames))


@settings
class PerStepConfig(OffPolicyConfig):
    """Common settings of algorithms with target networks and, by default, an update per step."""

    name: str = ""
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount factor")
    tau: float = Field(
        default=0.005,
        gt=0,
        le=1,
        description="rate of the soft update of the target networks; larger values follow faster",
    )
    random_frames: int = Field(
        default=1000, ge=0, description="frames with random actions before learning starts"
    )
    reward_scale: float | None = Field(
        default=1.0, gt=0, description="factor on rewards during learning; null: 1 - gamma"
    )
    schedule: Literal["step", "episode"] = Field(
        default="step", description="time of the updates: after every step or episode"
    )
    replay_ratio: float | None = Field(
        default=None,
        gt=0,
        description="average number of times that a transition is sampled, instead of updates: "
        "ratio * frames / batch_size updates",
    )
    updates: int | None = Field(
        default=1,
        ge=1,
        description="number of updates per step or episode; null: set by replay_ratio, or if that "
        "is null too, one per step, or one pass over the buffer per episode",
    )


@settings
class PPORPEConfig(OffPolicyConfig):
    """PPO-RPE with target networks: the paper's algorithm."""

    default_replay: ClassVar[str] = "prioritized"
    default_optimizer: ClassVar[str] = "adaterm"
    default_replay_ratio: ClassVar[float | None] = 10.0

    name: str = "ppo_rpe"
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount factor")
    kappa: float = Field(
        default=0.5, gt=0, description="allowed share of the largest ratio deviation"
    )
    beta: float = Field(
        default=0.5, gt=0, lt=1, description="mixture factor of the relative density ratio"
    )
    decay: float = Field(
        default=0.999, ge=0, le=1, description="decay of the largest deviation, per update"
    )
    delta_min: float = Field(
        default=0.1, gt=0, le=1, description="smallest value of the largest deviation"
    )
    threshold: Literal["max", "ema"] = Field(
        default="max", description="tracking of the largest deviation: max or ema [inferred: max]"
    )
    critic_weighting: Literal["ratio", "none"] = Field(
        default="none", description="weight of the value loss: ratio or none [inferred: none]"
    )
    baseline: Literal["stored", "target"] = Field(
        default="stored",
        description="likelihood in the denominator of the ratio: stored or target [inferred: "
        "stored]",
    )
    importance: Literal["max", "mean"] = Field(
        default="max",
        description="divisor of the importance weights of prioritized replay: max or mean "
        "[inferred: max]",
    )
    reduction: Literal["mean", "sum"] = Field(
        default="sum",
        description="reduction of losses and regularization over the batch; a sum lifts "
        "gradients above the optimizer's eps [inferred: sum]",
        json_schema_extra=neutral("mean"),
    )
    acting_policy: Literal["target", "online"] = Field(
        default="target",
        description="policy that plays the episodes: target or online network [inferred: target]",
    )
    reward_scale: float | None = Field(
        default=None,
        gt=0,
        description="factor on rewards during learning; null: 1 - gamma [inferred]",
    )
    squash: Literal["tanh", "sigmoid", "none"] = Field(
        default="tanh", description="function that keeps actions in their bounds [inferred: tanh]"
    )
    time_limit: Literal["truncated", "terminated"] = Field(
        default="truncated",
        description="value at a time limit: the state's value (truncated), or 0 as at a terminal "
        "state [inferred: truncated]",
        json_schema_extra=neutral("truncated"),
    )
    initial_scale: float = Field(
        default=1.0,
        gt=0.01,
        description="initial standard deviation of the policy, before the squashing [inferred: 1]",
        json_schema_extra=neutral(1.0),
    )
    hidden: Layers = Field(
        default=(100, 100), description="neurons of the hidden layers of both networks [paper]"
    )
    num_heads: int = Field(
        default=5, ge=1, description="heads of the value network; the value is their mean [paper]"
    )
    squish_b: float = Field(
        default=4.0, gt=0, description="parameter b of the Squish activation [inferred]"
    )
    schedule: Literal["episode", "step"] = Field(
        default="episode",
        description="time of the updates: after every episode or step [inferred: after each "
        "episode]",
    )
    replay_ratio: float | None = Field(
        default=default_replay_ratio,
        gt=0,
        description="average number of times that a transition is sampled: ratio * frames / "
        "batch_size updates [inferred: 10]",
    )
    updates: int | None = Field(
        default=None,
        ge=1,
        description="number of updates per episode or step; null: set by replay_ratio, or if that "
        "is null too, one pass over the buffer per episode, or one update per step",
    )
    tau: float = Field(
        default=0.1,
        gt=0,
        le=1,
        description="rate of the t-soft update of the target networks [paper]",
    )
    nu: float = Field(
        default=1.0,
        ge=1e-30,
        description="degrees of freedom of the t-soft update; larger values are less robust "
        "[paper]",
    )

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        # The check of PPORPELoss, before a task is created.
        limit = 2.0 * (1.0 - self.beta) / (self.beta * max(1.0, 1.0 / self.beta - 1.0))
        if self.kappa >= limit:
            raise SettingError(
                "kappa", f"must be below {limit:g} with beta={self.beta:g}, got {self.kappa:g}."
            )


@settings
class SACConfig(PerStepConfig):
    """Soft actor-critic with a learned temperature."""

    name: str = "sac"
    alpha_init: float = Field(
        default=1.0, gt=0, description="initial value of the learned temperature"
    )
    target_entropy: float | Literal["scaled"] | None = Field(
        default=None,
        description="target of the policy's entropy, for actions in the task's units: a range "
        "twice as wide adds log 2 per dimension; null: minus the number of action dimensions; "
        "scaled: the same for actions scaled to [-1, 1]",
    )
    hidden: Layers = Field(
        default=(256, 256), description="neurons of the hidden layers of all networks"
    )
    scale_mapping: Literal["softplus", "exp"] = Field(
        default="softplus",
        description="function from the network's output to the policy's scale; exp is clipped to "
        "[e^-20, e^2]",
        json_schema_extra=neutral("softplus"),
    )


@settings
class TD3Config(PerStepConfig):
    """Twin delayed DDPG, with a deterministic policy."""

    name: str = "td3"
    exploration_noise: float = Field(
        default=0.1,
        ge=0,
        description="standard deviation of the action noise, relative to half the action's range",
    )
    policy_noise: float = Field(
        default=0.2,
        ge=0,
        description="standard deviation of the noise on target actions, relative to half the "
        "action's range",
    )
    noise_clip: float = Field(
        default=0.5,
        ge=0,
        description="largest noise on target actions, relative to half the action's range",
    )
    policy_delay: int = Field(
        default=2,
        ge=1,
        description="value updates per update of the policy and the target networks",
    )
    hidden: Layers = Field(
        default=(256, 256), description="neurons of the hidden layers of all networks"
    )


@settings
class PPOConfig(AlgorithmConfig):
    """Proximal policy optimization with a clipped ratio, on rollouts."""

    default_replay: ClassVar[str] = "rollout"

    name: str = "ppo"
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount factor")
    gae_lambda: float = Field(
        default=0.95,
        ge=0,
        le=1,
        description="lambda of the advantage estimate (GAE); 0: one step, 1: Monte Carlo",
    )
    clip_epsilon: float = Field(
        default=0.2,
        gt=0,
        lt=1,
        description="clip range of the likelihood ratio; larger values allow larger updates",
    )
    entropy_coeff: float = Field(
        default=0.0, ge=0, description="weight of the entropy bonus; larger values explore more"
    )
    critic_coeff: float = Field(default=0.5, gt=0, description="weight of the value loss")
    max_grad_norm: float = Field(
        default=0.5,
        gt=0,
        description="largest norm of the gradient; larger gradients are scaled down",
    )
    frames: int = Field(
        default=2048,
        ge=1,
        description="frames per rollout; without num_envs, a rollout has whole episodes and at "
        "least this many frames",
    )
    epochs: int = Field(default=10, ge=1, description="passes over a rollout")
    hidden: Layers = Field(
        default=(64, 64), description="neurons of the hidden layers of both networks"
    )
    reward_scale: float | None = Field(
        default=1.0, gt=0, description="factor on rewards during learning; null: 1 - gamma"
    )
    schedule: Literal["rollout"] = Field(
        default="rollout", description="time of the updates: after every rollout"
    )
    num_envs: int | None = Field(
        default=None,
        ge=1,
        description="number of simulators that one policy plays in turn, frames / num_envs frames "
        "each per rollout; episodes may extend over several rollouts. null: whole episodes of one "
        "simulator",
    )
    clip_actions: bool = Field(
        default=False,
        description="normal policy, with actions clipped to their bounds for the task only; "
        "false: squashed policy. Requires num_envs",
    )
    log_scale: float | None = Field(
        default=None,
        description="initial logarithm of a learned policy scale that does not depend on the "
        "state; null: the scale depends on the state",
    )
    orthogonal: bool = Field(
        default=False,
        description="orthogonal initial weights, with small weights in the policy's last layer",
    )
    activation: Literal["tanh", "relu"] = Field(
        default="tanh",
        description="activation of the hidden layers of both networks",
        json_schema_extra=neutral("tanh"),
    )
    normalize_observations: bool = Field(
        default=False,
        description="normalization of observations by their running mean and standard deviation, "
        "stored with the policy; requires num_envs",
    )
    normalize_rewards: bool = Field(
        default=False,
        description="normalization of rewards during learning by the running standard deviation of "
        "their discounted sum; requires num_envs",
    )

    def __post_init__(self) -> None:
        if self.num_envs is not None:
            if self.frames % self.num_envs:
                raise SettingError(
                    "frames",
                    f"must be a multiple of num_envs={self.num_envs}, got {self.frames}.",
                )
            return
        for name in ("clip_actions", "normalize_observations", "normalize_rewards"):
            if getattr(self, name):
                raise SettingError(
                    name, "needs num_envs, got null: set num_envs, for example to 1."
                )


ALGORITHMS: dict[str, AlgorithmConfig] = {
    "ppo_rpe": PPORPEConfig(),
    "sac": SACConfig(),
    "td3": TD3Config(),
    "ppo": PPOConfig(),
}
