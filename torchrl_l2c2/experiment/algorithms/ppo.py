"""Proximal policy optimization with a clipped ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import AlgorithmConfig, Layers
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


@settings
class PPOConfig(AlgorithmConfig):
    """Proximal policy optimization with a clipped ratio, on rollouts of whole episodes."""

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
        default=1.0, description="factor on rewards while learning; null: 1 - gamma"
    )
    schedule: Literal["rollout"] = Field(
        default="rollout", description="updates follow every rollout"
    )

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        from torch import nn
        from torchrl.modules import ValueOperator
        from torchrl.objectives import ClipPPOLoss
        from torchrl.objectives.value import GAE

        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import (
            check_actions,
            perceptron,
            sharing,
            tanh_normal_actor,
        )

        check_actions(env, self.name, continuous=True, squashed=True)
        actor = tanh_normal_actor(env, self.hidden, nn.Tanh)
        critic = ValueOperator(perceptron(env, 1, self.hidden, nn.Tanh))
        loss = ClipPPOLoss(
            actor,
            critic,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coeff,
            entropy_bonus=self.entropy_coeff > 0,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        loss = regularizer.wrap(loss)
        advantage = GAE(
            gamma=self.gamma,
            lmbda=self.gae_lambda,
            value_network=sharing(critic, loss.critic_network_params),
        )
        return Agent(
            loss,
            policy=sharing(actor, loss.actor_network_params),
            optimizer=optimizer.make(loss.parameters()),
            advantage=advantage,
            max_grad_norm=self.max_grad_norm,
            policy_terms=frozenset({"loss_objective", "loss_entropy"}),
        )
