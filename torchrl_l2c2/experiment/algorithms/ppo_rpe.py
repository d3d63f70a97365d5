"""PPO-RPE, the paper's algorithm."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import Layers, OffPolicyConfig
from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


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
    )
    initial_scale: float = Field(
        default=1.0,
        gt=0.01,
        description="deviation of the policy's normal at first, before the squashing [inferred: 1]",
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

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        import torch

        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import (
            check_actions,
            image_encoder,
            observation_size,
            sharing,
        )
        from torchrl_l2c2.modules import make_actor, make_critic
        from torchrl_l2c2.objectives import PPORPELoss
        from torchrl_l2c2.updaters import TSoftUpdate

        check_actions(env, self.name, continuous=True, squashed=self.squash != "none")
        size = observation_size(env)
        actor = make_actor(
            size,
            env.action_spec.to(torch.get_default_device()),
            hidden=self.hidden,
            squash=self.squash,
            scale_mapping=f"biased_softplus_{self.initial_scale}",
            squish_b=self.squish_b,
            encoder=image_encoder(env),
        )
        critic = make_critic(
            size,
            num_heads=self.num_heads,
            hidden=self.hidden,
            squish_b=self.squish_b,
            encoder=image_encoder(env),
        )
        loss = PPORPELoss(
            actor,
            critic,
            gamma=self.gamma,
            kappa=self.kappa,
            beta=self.beta,
            decay=self.decay,
            delta_min=self.delta_min,
            threshold=self.threshold,
            critic_weighting=self.critic_weighting,
            baseline=self.baseline,
            importance=self.importance,
            reduction=self.reduction,
        )
        if self.time_limit == "terminated":
            loss.set_keys(terminated="done")
        loss = regularizer.add_to(loss)
        acting = "target_actor_network" if self.acting_policy == "target" else "actor_network"
        return Agent(
            loss,
            policy=sharing(loss.actor_network, getattr(loss, f"{acting}_params")),
            optimizer=optimizer.make(loss.parameters()),
            target_updater=TSoftUpdate(loss, tau=self.tau, nu=self.nu),
            policy_terms=frozenset({"loss_actor"}),
        )
