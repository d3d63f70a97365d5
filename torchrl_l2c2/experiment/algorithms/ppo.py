"""Proximal policy optimization with a clipped ratio."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import AlgorithmConfig, Layers
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    from tensordict.nn import TensorDictModule
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.algorithms.normalization import Normalization
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


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
        default="tanh", description="of the hidden layers of both networks"
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

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        from torch import nn
        from torchrl.modules import ValueOperator
        from torchrl.objectives.value import GAE

        from torchrl_l2c2.experiment._torchrl_internals import TraceableClipPPOLoss
        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import (
            check_actions,
            normal_actor,
            orthogonal,
            perceptron,
            sharing,
        )

        check_actions(env, self.name, continuous=True, squashed=not self.clip_actions)
        activation = {"tanh": nn.Tanh, "relu": nn.ReLU}[self.activation]
        actor = normal_actor(
            env, self.hidden, activation, squash=not self.clip_actions, log_scale=self.log_scale
        )
        critic = ValueOperator(perceptron(env, 1, self.hidden, activation))
        if self.orthogonal:
            orthogonal(actor, last=0.01)
            orthogonal(critic, last=1.0)
        loss = TraceableClipPPOLoss(
            actor,
            critic,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coeff,
            entropy_bonus=self.entropy_coeff > 0,
            critic_coeff=self.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        loss = regularizer.add_to(loss)
        advantage = GAE(
            gamma=self.gamma,
            lmbda=self.gae_lambda,
            value_network=sharing(critic, loss.critic_network_params),
        )
        normalization = self._normalization(env)
        return Agent(
            loss,
            policy=self._acting(sharing(actor, loss.actor_network_params), normalization, env),
            optimizer=optimizer.make(loss.parameters()),
            advantage=advantage,
            max_grad_norm=self.max_grad_norm,
            policy_terms=frozenset({"loss_objective", "loss_entropy"}),
            normalization=normalization,
        )

    def _normalization(self, env: EnvBase) -> Normalization | None:
        from torchrl_l2c2.experiment.algorithms.normalization import Normalization

        if not (self.normalize_observations or self.normalize_rewards):
            return None
        shape = env.observation_spec["observation"].shape
        if len(shape) != 1:
            raise UserError(
                "algorithm.normalize_observations and normalize_rewards are of tasks that show one "
                f"vector, this one shows an image of shape {tuple(shape)}: set both to false."
            )
        return Normalization(
            shape[0],
            observations=self.normalize_observations,
            rewards=self.normalize_rewards,
            gamma=self.gamma,
            streams=self.num_envs or 1,
        )

    def _acting(
        self, policy: TensorDictModule, normalization: Normalization | None, env: EnvBase
    ) -> TensorDictModule:
        """The policy that a task sees: all that belongs to it is inside."""
        from torchrl_l2c2.experiment.algorithms.networks import clip_bounds
        from torchrl_l2c2.experiment.algorithms.normalization import ActingPolicy

        if normalization is None and not self.clip_actions:
            return policy
        bounds = clip_bounds(env) if self.clip_actions else ()
        return ActingPolicy(policy, normalization, *bounds)
