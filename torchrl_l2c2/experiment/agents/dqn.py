"""Double deep Q-learning."""

from __future__ import annotations

from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, QValueActor
from torchrl.objectives import DQNLoss, SoftUpdate

from torchrl_l2c2.experiment.agents.agent import Agent
from torchrl_l2c2.experiment.agents.networks import check_actions, perceptron, shared_copy
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer
from torchrl_l2c2.experiment.settings.algorithms import DQNConfig
from torchrl_l2c2.experiment.settings.optimizers import OptimizerConfig
from torchrl_l2c2.experiment.settings.regularizers import RegularizerConfig


def make_dqn(
    config: DQNConfig, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
) -> Agent:
    """Builds DQN, with the arguments of :func:`~.build.make_algorithm`."""
    check_actions(env, config.name, continuous=False)
    spec = env.action_spec
    network = perceptron(env, spec.shape[-1], config.hidden, nn.ReLU)
    values = QValueActor(network, spec=spec)
    loss = DQNLoss(values, action_space=spec, loss_function="l2", delay_value=True, double_dqn=True)
    loss.make_value_estimator(gamma=config.gamma)
    loss = add_regularizer(loss, regularizer)
    greedy = EGreedyModule(
        spec, eps_init=1.0, eps_end=config.epsilon_end, annealing_num_steps=config.epsilon_frames
    )
    return Agent(
        loss,
        policy=TensorDictSequential(shared_copy(values, loss.value_network_params), greedy),
        optimizer=make_optimizer(optimizer, loss.parameters()),
        target_updater=SoftUpdate(loss, tau=config.tau),
    )
