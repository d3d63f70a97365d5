"""Twin delayed DDPG."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import Layers, PerStepConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.data import TensorSpec
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


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

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        import torch
        from tensordict.nn import TensorDictSequential
        from torch import nn
        from torchrl.modules import Actor, AdditiveGaussianModule, TanhModule
        from torchrl.objectives import SoftUpdate, TD3Loss

        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import (
            action_value,
            check_actions,
            perceptron,
            sharing,
        )

        check_actions(env, self.name, continuous=True, squashed=True, drawn=False)
        spec = env.action_spec
        network = perceptron(env, spec.shape[-1], self.hidden, nn.ReLU)
        bounds = spec.to(torch.get_default_device())
        squash = TanhModule(in_keys=["action"], out_keys=["action"], spec=bounds)
        actor = TensorDictSequential(Actor(network, out_keys=["action"]), squash)
        half_range = _half_range(spec)
        loss = TD3Loss(
            actor,
            action_value(env, self.hidden),
            action_spec=spec,
            num_qvalue_nets=2,
            loss_function="l2",
            policy_noise=self.policy_noise * half_range,
            noise_clip=self.noise_clip * half_range,
        )
        loss.make_value_estimator(gamma=self.gamma)
        loss = regularizer.add_to(loss)
        sigma = self.exploration_noise * half_range
        noise = AdditiveGaussianModule(spec, sigma_init=sigma, sigma_end=sigma)
        return Agent(
            loss,
            policy=TensorDictSequential(sharing(actor, loss.actor_network_params), noise),
            optimizer=optimizer.make(loss.parameters()),
            target_updater=SoftUpdate(loss, tau=self.tau),
            policy_terms=frozenset({"loss_actor"}),
            policy_delay=self.policy_delay,
        )


def _half_range(spec: TensorSpec) -> float:
    """Half the range of the actions, of the widest one: the unit of TD3's noise.

    Warns:
        UserWarning: some actions are narrower.
    """
    half_ranges = (spec.space.high - spec.space.low) / 2
    half_range: float = half_ranges.max().item()
    if half_ranges.min() < half_range:
        warnings.warn(
            "td3's noise is as wide for every action, a share of the largest of half their "
            f"ranges, got {half_ranges.tolist()}: it fills the narrow ones. Scale the task's "
            "actions to one range (gymnasium.wrappers.RescaleAction), or use algorithm=sac.",
            stacklevel=3,
        )
    return half_range
