"""The algorithms: each builds its networks, TorchRL's loss for them, and the policy that acts."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass

from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictParams,
    TensorDictSequential,
)
from torch import nn
from torchrl.envs import EnvBase, ExplorationType
from torchrl.modules import (
    MLP,
    Actor,
    AdditiveGaussianModule,
    EGreedyModule,
    ProbabilisticActor,
    QValueActor,
    TanhModule,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, DQNLoss, LossModule, SACLoss, SoftUpdate, TD3Loss
from torchrl.objectives.utils import TargetNetUpdater
from torchrl.objectives.value import GAE

from torchrl_l2c2.experiment.config import (
    AlgorithmConfig,
    DQNConfig,
    PPOConfig,
    PPORPEConfig,
    SACConfig,
    TD3Config,
)
from torchrl_l2c2.modules import make_actor, make_critic
from torchrl_l2c2.objectives import PPORPELoss
from torchrl_l2c2.updaters import TSoftUpdate

Regularize = Callable[[LossModule], LossModule]


@dataclass
class Parts:
    """What an algorithm is made of.

    Attributes:
        loss: regularized.
        policy: acts; shares its parameters with ``loss``, so it is always the current one.
        target_updater: moves the target networks after every update; ``None`` without any.
        exploration: the part of ``policy`` that only explores; ``None`` where it samples.
        advantage: estimates advantages of an episode, for on-policy learning.
        compilable: whether the loss compiles into one graph.
    """

    loss: LossModule
    policy: TensorDictModule
    target_updater: TargetNetUpdater | None = None
    exploration: nn.Module | None = None
    advantage: GAE | None = None
    compilable: bool = True


def make_algorithm(config: AlgorithmConfig, env: EnvBase, regularize: Regularize) -> Parts:
    """Builds an algorithm for an environment's observation and action.

    Raises:
        ValueError: a setting outside its range, or actions that the algorithm cannot take.
    """
    continuous = env.action_spec.dtype.is_floating_point
    if continuous == isinstance(config, DQNConfig):
        kind = "discrete" if isinstance(config, DQNConfig) else "continuous"
        raise ValueError(
            f"algorithm={config.name} needs {kind} actions, this task's are "
            f"{type(env.action_spec).__name__} of shape {tuple(env.action_spec.shape)}."
        )
    return BUILDERS[type(config)](config, env, regularize)


def sharing(network: TensorDictModule, parameters: TensorDictParams) -> TensorDictModule:
    """A copy of a network on a loss's own parameters: it changes as they do."""
    copy = deepcopy(network)
    parameters.data.to_module(copy)
    return copy


def _observation_size(env: EnvBase) -> int:
    return env.observation_spec["observation"].shape[-1]


def _ppo_rpe(config: PPORPEConfig, env: EnvBase, regularize: Regularize) -> Parts:
    size = _observation_size(env)
    actor = make_actor(
        size,
        env.action_spec,
        hidden=config.hidden,
        squash=config.squash,
        squish_b=config.squish_b,
    )
    critic = make_critic(
        size, num_heads=config.num_heads, hidden=config.hidden, squish_b=config.squish_b
    )
    loss = regularize(
        PPORPELoss(
            actor,
            critic,
            gamma=config.gamma,
            kappa=config.kappa,
            beta=config.beta,
            decay=config.decay,
            delta_min=config.delta_min,
            threshold=config.threshold,
            critic_weighting=config.critic_weighting,
            baseline=config.baseline,
            importance=config.importance,
        )
    )
    updater = TSoftUpdate(loss, tau=config.tau, nu=config.nu)
    acting = "target_actor_network" if config.acting_policy == "target" else "actor_network"
    return Parts(loss, sharing(loss.actor_network, getattr(loss, f"{acting}_params")), updater)


def _sac(config: SACConfig, env: EnvBase, regularize: Regularize) -> Parts:
    actor = _stochastic_actor(config.hidden, env, nn.ReLU)
    loss = SACLoss(
        actor,
        _action_value(config.hidden, env),
        num_qvalue_nets=2,
        loss_function="l2",
        alpha_init=config.alpha_init,
        action_spec=env.action_spec,
    )
    loss.make_value_estimator(gamma=config.gamma)
    # A buffer that is made when first read: in a compiled function it would be lost again.
    loss.target_entropy  # noqa: B018
    loss = regularize(loss)
    return Parts(loss, sharing(actor, loss.actor_network_params), SoftUpdate(loss, tau=config.tau))


def _td3(config: TD3Config, env: EnvBase, regularize: Regularize) -> Parts:
    spec = env.action_spec
    network = _network(config.hidden, _observation_size(env), spec.shape[-1], nn.ReLU)
    squash = TanhModule(in_keys=["action"], out_keys=["action"], spec=spec)
    actor = TensorDictSequential(Actor(network, out_keys=["action"]), squash)
    half_range = ((spec.space.high - spec.space.low) / 2).max().item()
    loss = TD3Loss(
        actor,
        _action_value(config.hidden, env),
        action_spec=spec,
        num_qvalue_nets=2,
        loss_function="l2",
        policy_noise=config.policy_noise * half_range,
        noise_clip=config.noise_clip * half_range,
    )
    loss.make_value_estimator(gamma=config.gamma)
    loss = regularize(loss)
    sigma = config.exploration_noise * half_range
    noise = AdditiveGaussianModule(spec, sigma_init=sigma, sigma_end=sigma)
    policy = TensorDictSequential(sharing(actor, loss.actor_network_params), noise)
    return Parts(loss, policy, SoftUpdate(loss, tau=config.tau), exploration=noise)


def _dqn(config: DQNConfig, env: EnvBase, regularize: Regularize) -> Parts:
    spec = env.action_spec
    network = _network(config.hidden, _observation_size(env), spec.shape[-1], nn.ReLU)
    values = QValueActor(network, spec=spec)
    loss = DQNLoss(values, action_space=spec, loss_function="l2", delay_value=True, double_dqn=True)
    loss.make_value_estimator(gamma=config.gamma)
    loss = regularize(loss)
    greedy = EGreedyModule(
        spec,
        eps_init=1.0,
        eps_end=config.epsilon_end,
        annealing_num_steps=config.epsilon_frames,
    )
    policy = TensorDictSequential(sharing(values, loss.value_network_params), greedy)
    return Parts(loss, policy, SoftUpdate(loss, tau=config.tau), exploration=greedy)


def _ppo(config: PPOConfig, env: EnvBase, regularize: Regularize) -> Parts:
    actor = _stochastic_actor(config.hidden, env, nn.Tanh)
    critic = ValueOperator(_network(config.hidden, _observation_size(env), 1, nn.Tanh))
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        entropy_bonus=config.entropy_coeff > 0,
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    loss = regularize(loss)
    advantage = GAE(
        gamma=config.gamma,
        lmbda=config.gae_lambda,
        value_network=sharing(critic, loss.critic_network_params),
    )
    policy = sharing(actor, loss.actor_network_params)
    # TorchRL's PPO losses dispatch on distributions in ways that Dynamo does not trace.
    return Parts(loss, policy, advantage=advantage, compilable=False)


def _network(
    hidden: tuple[int, ...], in_features: int, out_features: int, activation: type[nn.Module]
) -> MLP:
    return MLP(
        in_features=in_features,
        out_features=out_features,
        num_cells=list(hidden),
        activation_class=activation,
    )


def _stochastic_actor(
    hidden: tuple[int, ...], env: EnvBase, activation: type[nn.Module]
) -> TensorDictModule:
    """A tanh-squashed diagonal normal."""
    spec = env.action_spec
    network = nn.Sequential(
        _network(hidden, _observation_size(env), 2 * spec.shape[-1], activation),
        NormalParamExtractor(),
    )
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        return_log_prob=True,
        log_prob_key="action_log_prob",
        default_interaction_type=ExplorationType.RANDOM,
    )


def _action_value(hidden: tuple[int, ...], env: EnvBase) -> ValueOperator:
    size = _observation_size(env) + env.action_spec.shape[-1]
    network = _network(hidden, size, 1, nn.ReLU)
    return ValueOperator(network, in_keys=["observation", "action"])


BUILDERS: dict[type, Callable[..., Parts]] = {
    PPORPEConfig: _ppo_rpe,
    SACConfig: _sac,
    TD3Config: _td3,
    DQNConfig: _dqn,
    PPOConfig: _ppo,
}
