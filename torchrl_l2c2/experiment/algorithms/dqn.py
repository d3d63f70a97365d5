"""Deep Q-learning."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from torchrl_l2c2.experiment.algorithms.base import Layers, PerStepConfig
from torchrl_l2c2.experiment.settings import settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig


@settings
class DQNConfig(PerStepConfig):
    """Double deep Q-learning, for discrete actions."""

    name: str = "dqn"
    epsilon_end: float = Field(default=0.05, ge=0, le=1, description="last share of random actions")
    epsilon_frames: int = Field(
        default=10_000, ge=1, description="frames until that share is reached"
    )
    hidden: Layers = Field(default=(120, 84), description="neurons of the hidden layers")

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        from tensordict.nn import TensorDictSequential
        from torch import nn
        from torchrl.modules import EGreedyModule, QValueActor
        from torchrl.objectives import DQNLoss, SoftUpdate

        from torchrl_l2c2.experiment.algorithms.agent import Agent
        from torchrl_l2c2.experiment.algorithms.networks import check_actions, perceptron, sharing

        check_actions(env, self.name, continuous=False)
        spec = env.action_spec
        network = perceptron(env, spec.shape[-1], self.hidden, nn.ReLU)
        values = QValueActor(network, spec=spec)
        loss = DQNLoss(
            values, action_space=spec, loss_function="l2", delay_value=True, double_dqn=True
        )
        loss.make_value_estimator(gamma=self.gamma)
        loss = regularizer.add_to(loss)
        greedy = EGreedyModule(
            spec, eps_init=1.0, eps_end=self.epsilon_end, annealing_num_steps=self.epsilon_frames
        )
        return Agent(
            loss,
            policy=TensorDictSequential(sharing(values, loss.value_network_params), greedy),
            optimizer=optimizer.make(loss.parameters()),
            target_updater=SoftUpdate(loss, tau=self.tau),
        )
