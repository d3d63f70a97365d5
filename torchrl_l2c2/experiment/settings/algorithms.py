"""Settings of the algorithms."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings.fields import SettingError, neutral, settings

Layers = tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...]
"""Neurons of hidden layers."""


class AlgorithmConfig:
    """Settings that every algorithm has, and the replay buffer and optimizer that it defaults to.

    Attributes:
        usual_replay: name of the replay buffer that it comes with.
        usual_optimizer: name of the optimizer that it comes with.
        frames: least that an update learns from; 0 where a replay buffer has them.
        num_envs: simulators that one policy plays at once; ``None`` where it plays one.
        random_frames: played with random actions before learning starts.
    """

    usual_replay: ClassVar[str] = "uniform"
    usual_optimizer: ClassVar[str] = "adam"

    frames: int = 0
    num_envs: int | None = None
    random_frames: int = 0

    name: str
    gamma: float
    reward_scale: float | None
    schedule: str

    @property
    def reward_factor(self) -> float:
        """What rewards are multiplied with to be learned from."""
        return 1.0 - self.gamma if self.reward_scale is None else self.reward_scale


class OffPolicyConfig(AlgorithmConfig):
    """An algorithm that learns from a replay buffer.

    Attributes:
        usual_replay_ratio: the default of ``replay_ratio``.
    """

    usual_replay_ratio: ClassVar[float | None] = None

    replay_ratio: float | None
    updates: int | None

    def __post_init__(self) -> None:
        # A usual ratio gives way to a number of updates, a chosen one does not.
        chosen = self.replay_ratio not in (None, self.usual_replay_ratio)
        if chosen and self.updates is not None:
            raise SettingError(
                "replay_ratio",
                f"and updates both say how many updates there are: leave one at null, got "
                f"{self.replay_ratio} and {self.updates}.",
            )

    def updates_after(self, frames: int, last_frame: int, stored: int, batch_size: int) -> int:
        """How many updates follow some frames.

        Args:
            frames (int): frames that were played.
            last_frame (int): frames of the run up to and with them.
            stored (int): transitions in the replay buffer.
            batch_size (int): transitions that an update draws.
        """
        if self.updates is not None:
            return self.updates
        if self.replay_ratio is None:
            return 1 if self.schedule == "step" else stored // batch_size
        # A fraction of an update is made up for later.
        each = self.replay_ratio / batch_size
        return int(each * last_frame) - int(each * (last_frame - frames))


@settings
class PerStepConfig(OffPolicyConfig):
    """One that makes an update after every step, with target networks that follow."""

    name: str = ""
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount")
    tau: float = Field(default=0.005, gt=0, le=1, description="pace of the target networks")
    random_frames: int = Field(
        default=1000, ge=0, description="frames with random actions, before learning starts"
    )
    reward_scale: float | None = Field(
        default=1.0, gt=0, description="factor on rewards while learning; null: 1 - gamma"
    )
    schedule: Literal["step", "episode"] = Field(default="step", description="when updates happen")
    replay_ratio: float | None = Field(
        default=None,
        gt=0,
        description="times that a transition is drawn on average, instead of updates: "
        "ratio * frames / batch_size of them",
    )
    updates: int | None = Field(
        default=1,
        ge=1,
        description="per step, or per episode; null: by the replay ratio, else one, or one pass "
        "over the buffer",
    )


@settings
class PPORPEConfig(OffPolicyConfig):
    """PPO-RPE with target networks, the paper's algorithm and kappa, beta, decay, delta_min."""

    usual_replay: ClassVar[str] = "prioritized"
    usual_optimizer: ClassVar[str] = "adaterm"
    usual_replay_ratio: ClassVar[float | None] = 10.0

    name: str = "ppo_rpe"
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount")
    kappa: float = Field(
        default=0.5, gt=0, description="share of the largest ratio deviation that is allowed"
    )
    beta: float = Field(
        default=0.5, gt=0, lt=1, description="mixture of the relative density ratio"
    )
    decay: float = Field(
        default=0.999, ge=0, le=1, description="of the largest deviation, per update"
    )
    delta_min: float = Field(default=0.1, gt=0, le=1, description="floor of that deviation")
    threshold: Literal["max", "ema"] = Field(
        default="max", description="how the deviation is tracked [inferred: max]"
    )
    critic_weighting: Literal["ratio", "none"] = Field(
        default="none", description="weight of the value loss [inferred: none]"
    )
    baseline: Literal["stored", "target"] = Field(
        default="stored", description="likelihood that the ratio is taken to [inferred: stored]"
    )
    importance: Literal["max", "mean"] = Field(
        default="max",
        description="what the weights of prioritized replay are divided by [inferred: max]",
    )
    reduction: Literal["mean", "sum"] = Field(
        default="sum",
        description="of losses and regularization over the batch; a sum lifts gradients above the "
        "optimizer's eps [inferred: sum]",
        json_schema_extra=neutral("mean"),
    )
    acting_policy: Literal["target", "online"] = Field(
        default="target", description="which copy of the policy acts [inferred: target]"
    )
    reward_scale: float | None = Field(
        default=None,
        gt=0,
        description="factor on rewards while learning; null: 1 - gamma [inferred]",
    )
    squash: Literal["tanh", "sigmoid", "none"] = Field(
        default="tanh", description="how actions are kept in their bounds [inferred: tanh]"
    )
    time_limit: Literal["truncated", "terminated"] = Field(
        default="truncated",
        description="whether the value at a time limit is that of the state, or 0 as at a terminal "
        "one [inferred: truncated]",
        json_schema_extra=neutral("truncated"),
    )
    initial_scale: float = Field(
        default=1.0,
        gt=0.01,
        description="deviation of the policy's normal at first, before the squashing [inferred: 1]",
        json_schema_extra=neutral(1.0),
    )
    hidden: Layers = Field(
        default=(100, 100), description="neurons of the hidden layers of both networks [paper]"
    )
    num_heads: int = Field(
        default=5, ge=1, description="outputs of the value network; the value is their mean [paper]"
    )
    squish_b: float = Field(
        default=4.0, gt=0, description="bend of the Squish activation [inferred]"
    )
    schedule: Literal["episode", "step"] = Field(
        default="episode", description="when updates happen [inferred: after each episode]"
    )
    replay_ratio: float | None = Field(
        default=usual_replay_ratio,
        gt=0,
        description="times that a transition is drawn on average: ratio * frames / batch_size "
        "updates [inferred: 10]",
    )
    updates: int | None = Field(
        default=None,
        ge=1,
        description="per episode, or per step, instead; null: by the replay ratio, and where that "
        "is null too, one pass over the buffer, or one",
    )
    tau: float = Field(
        default=0.1, gt=0, le=1, description="t-soft update: pace of the target networks [paper]"
    )
    nu: float = Field(
        default=1.0,
        ge=1e-30,
        description="t-soft update: degrees of freedom; larger is less robust [paper]",
    )

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        # As in PPORPELoss, which could say it only once a task has been made.
        widest = 2.0 * (1.0 - self.beta) / (self.beta * max(1.0, 1.0 / self.beta - 1.0))
        if self.kappa >= widest:
            raise SettingError(
                "kappa", f"must be below {widest:g} with beta={self.beta:g}, got {self.kappa:g}."
            )


@settings
class SACConfig(PerStepConfig):
    """Soft actor-critic with a learned temperature."""

    name: str = "sac"
    alpha_init: float = Field(default=1.0, gt=0, description="first temperature; it is learned")
    target_entropy: float | None = Field(
        default=None,
        description="entropy that the temperature keeps, of actions in the task's units: actions "
        "over twice the range have log 2 more; null: minus the number of their dimensions",
    )
    hidden: Layers = Field(
        default=(256, 256), description="neurons of the hidden layers of all networks"
    )
    scale_mapping: Literal["softplus", "exp"] = Field(
        default="softplus",
        description="from the network's output to the policy's scale; exp: cut to e^-20 and e^2",
        json_schema_extra=neutral("softplus"),
    )


@settings
class TD3Config(PerStepConfig):
    """Twin delayed DDPG: a deterministic policy."""

    name: str = "td3"
    exploration_noise: float = Field(
        default=0.1,
        ge=0,
        description="standard deviation of the noise on actions, of half their range",
    )
    policy_noise: float = Field(
        default=0.2, ge=0, description="of the noise on the target's actions, likewise"
    )
    noise_clip: float = Field(default=0.5, ge=0, description="largest such noise, likewise")
    policy_delay: int = Field(
        default=2,
        ge=1,
        description="updates of the value per update of the policy and of the target networks",
    )
    hidden: Layers = Field(
        default=(256, 256), description="neurons of the hidden layers of all networks"
    )


@settings
class PPOConfig(AlgorithmConfig):
    """Proximal policy optimization with a clipped ratio, on rollouts."""

    usual_replay: ClassVar[str] = "rollout"

    name: str = "ppo"
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount")
    gae_lambda: float = Field(
        default=0.95,
        ge=0,
        le=1,
        description="of the advantage estimate: 0 is one-step, 1 is Monte Carlo",
    )
    clip_epsilon: float = Field(
        default=0.2, gt=0, lt=1, description="largest change of the likelihood ratio that pays"
    )
    entropy_coeff: float = Field(default=0.0, ge=0, description="bonus on the policy's entropy")
    critic_coeff: float = Field(default=0.5, gt=0, description="gain of the value loss")
    max_grad_norm: float = Field(
        default=0.5, gt=0, description="gradients are scaled down to this norm"
    )
    frames: int = Field(
        default=2048,
        ge=1,
        description="at least so many, in whole episodes, are learned from at once",
    )
    epochs: int = Field(default=10, ge=1, description="passes over them")
    hidden: Layers = Field(
        default=(64, 64), description="neurons of the hidden layers of both networks"
    )
    reward_scale: float | None = Field(
        default=1.0, gt=0, description="factor on rewards while learning; null: 1 - gamma"
    )
    schedule: Literal["rollout"] = Field(
        default="rollout", description="updates follow every rollout"
    )
    num_envs: int | None = Field(
        default=None,
        ge=1,
        description="simulators that one policy plays at once, in turn, each for frames / num_envs "
        "frames of a rollout, which an episode may outlast; null: whole episodes of one",
    )
    clip_actions: bool = Field(
        default=False,
        description="actions are those of a normal, clipped into their bounds for the task alone, "
        "instead of squashed; needs num_envs",
    )
    log_scale: float | None = Field(
        default=None,
        description="what the logarithm of the policy's scale begins with, where that does not "
        "depend on the state; null: it does",
    )
    orthogonal: bool = Field(
        default=False, description="orthogonal first weights, small ones of the policy's output"
    )
    activation: Literal["tanh", "relu"] = Field(
        default="tanh",
        description="of the hidden layers of both networks",
        json_schema_extra=neutral("tanh"),
    )
    normalize_observations: bool = Field(
        default=False,
        description="by their running mean and deviation, which the policy keeps; needs num_envs",
    )
    normalize_rewards: bool = Field(
        default=False,
        description="by the running deviation of their discounted sum while learning; needs "
        "num_envs",
    )

    def __post_init__(self) -> None:
        if self.num_envs is not None:
            if self.frames % self.num_envs:
                raise SettingError(
                    "frames",
                    f"must be a multiple of num_envs={self.num_envs}, which play as many each, got "
                    f"{self.frames}.",
                )
            return
        for name in ("clip_actions", "normalize_observations", "normalize_rewards"):
            if getattr(self, name):
                raise SettingError(name, "needs num_envs, got null: set it, to 1 for example.")


@settings
class DQNConfig(PerStepConfig):
    """Double deep Q-learning, for discrete actions."""

    name: str = "dqn"
    epsilon_end: float = Field(default=0.05, ge=0, le=1, description="last share of random actions")
    epsilon_frames: int = Field(
        default=10_000, ge=1, description="frames until that share is reached"
    )
    hidden: Layers = Field(default=(120, 84), description="neurons of the hidden layers")


ALGORITHMS: dict[str, AlgorithmConfig] = {
    "ppo_rpe": PPORPEConfig(),
    "sac": SACConfig(),
    "td3": TD3Config(),
    "ppo": PPOConfig(),
    "dqn": DQNConfig(),
}
