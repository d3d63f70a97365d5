"""Soft actor-critic."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import Layers, PerStepConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


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
    )

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        from torch import nn
        from torchrl.objectives import SACLoss, SoftUpdate

        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import (
            action_value,
            check_actions,
            normal_actor,
            sharing,
        )

        check_actions(env, self.name, continuous=True, squashed=True)
        actor = normal_actor(env, self.hidden, nn.ReLU, exponential=self.scale_mapping == "exp")
        loss = SACLoss(
            actor,
            action_value(env, self.hidden),
            num_qvalue_nets=2,
            loss_function="l2",
            alpha_init=self.alpha_init,
            action_spec=env.action_spec,
            target_entropy="auto" if self.target_entropy is None else self.target_entropy,
        )
        loss.make_value_estimator(gamma=self.gamma)
        # A buffer that is made when first read: in a compiled function it would be lost again.
        loss.target_entropy  # noqa: B018
        loss = regularizer.add_to(loss)
        return Agent(
            loss,
            policy=sharing(actor, loss.actor_network_params),
            optimizer=optimizer.make(loss.parameters()),
            target_updater=SoftUpdate(loss, tau=self.tau),
            policy_terms=frozenset({"loss_actor"}),
        )
