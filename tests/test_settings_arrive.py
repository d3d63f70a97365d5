"""What is set reaches what it is a setting of: losses, optimizers, replay, noise, targets."""

import pytest
import torch
from losses import BOUNDS, critic, deterministic_actor, gaussian_actor, qvalue, transitions
from tensordict import TensorDict
from torchrl.objectives import PPOLoss, TD3Loss

from torchrl_l2c2.experiment import (
    AdamConfig,
    AdaTermConfig,
    CAPSConfig,
    CATSConfig,
    GradCAPSConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    PrioritizedReplayConfig,
    SACConfig,
    SR2LConfig,
    TaskConfig,
    TD3Config,
    make_env,
)
from torchrl_l2c2.experiment.agents.agent import Agent, exploration_module
from torchrl_l2c2.experiment.agents.build import make_algorithm
from torchrl_l2c2.experiment.agents.optimizers import make_optimizer
from torchrl_l2c2.experiment.agents.regularizers import add_regularizer, make_neighborhood
from torchrl_l2c2.experiment.learn.replay import make_buffer
from torchrl_l2c2.experiment.learn.update import make_update
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS, GainConfig

OF_PPO_RPE = {
    "kappa": 0.25,
    "beta": 0.4,
    "decay": 0.9,
    "delta_min": 0.2,
    "threshold": "ema",
    "critic_weighting": "ratio",
    "baseline": "target",
    "importance": "mean",
    "gamma": 0.5,
}


def agent_of(algorithm, env_id="Pendulum-v1"):
    env = make_env(TaskConfig("task", env_id), 0)
    return make_algorithm(algorithm, env, NoRegularizerConfig(), AdamConfig())


def normal():
    torch.manual_seed(0)
    return PPOLoss(gaussian_actor(), critic())


def test_those_of_ppo_rpe():
    """One by one: in a run some hide behind others."""
    algorithm = PPORPEConfig(
        hidden=(8,), num_heads=2, tau=0.3, nu=2.0, acting_policy="online", **OF_PPO_RPE
    )
    agent = agent_of(algorithm)
    assert {name: getattr(agent.loss, name) for name in OF_PPO_RPE} == OF_PPO_RPE
    assert (agent.target_updater.tau, agent.target_updater.nu) == (0.3, 2.0)
    states = TensorDict({"observation": torch.zeros(4, 3)}, [4])
    values = agent.loss.evaluate_at_batch("critic_network", states)
    assert values["state_value_heads"].shape == (4, 2)
    acting = next(iter(agent.policy.parameters()))
    online = next(iter(agent.loss.actor_network_params.values(True, True)))
    assert acting.data_ptr() == online.data_ptr()


def test_those_of_ppo():
    """Which presets have as TorchRL's own defaults."""
    agent = agent_of(PPOConfig(hidden=(8,), clip_epsilon=0.1, max_grad_norm=0.3))
    assert float(agent.loss.clip_epsilon) == pytest.approx(0.1) and agent.max_grad_norm == 0.3


def test_td3s_noise():
    """As a share of half the range, which is 2 for Pendulum."""
    settings = {"policy_noise": 0.3, "noise_clip": 0.7, "exploration_noise": 0.4}
    agent = agent_of(TD3Config(hidden=(8,), policy_delay=3, **settings))
    sigma = exploration_module(agent.policy).sigma.item()
    found = (agent.loss.policy_noise, agent.loss.noise_clip, sigma)
    assert (*found, agent.policy_delay) == pytest.approx((0.6, 1.4, 0.8, 3))


@pytest.mark.parametrize("kind", [SACConfig, TD3Config])
def test_the_discount_and_the_pace_of_the_targets(kind):
    """After a step of .25 the targets are a quarter of the way."""
    agent = agent_of(kind(hidden=(8,), gamma=0.5, tau=0.25))
    assert float(agent.loss.value_estimator.gamma) == 0.5
    updater = agent.target_updater
    before = [target.clone() for target in updater._targets.values(True, True)]
    for source in updater._sources.values(True, True):
        source.data += 1.0
    updater.step()
    for old, new in zip(before, updater._targets.values(True, True), strict=True):
        torch.testing.assert_close(new, old + 0.25)


def test_those_of_replay_and_optimizers():
    """By what TorchRL's sampler and the optimizers have."""
    sampler = make_buffer(PrioritizedReplayConfig(alpha=0.3, beta=0.9), 0, 1).sampler
    assert (sampler._alpha, sampler._beta) == (0.3, 0.9)
    parameters = [torch.nn.Parameter(torch.ones(1))]
    adam = make_optimizer(AdamConfig(betas=(0.5, 0.6), eps=1e-3), parameters).defaults
    assert (adam["betas"], adam["eps"]) == ((0.5, 0.6), 1e-3)
    adaterm = make_optimizer(AdaTermConfig(beta=0.5, nu_min=3.0), parameters).defaults
    assert (adaterm["beta"], adaterm["nu_min"]) == (0.5, 3.0)


@pytest.mark.parametrize("norm", [0.01, 0.02])
def test_gradients_are_scaled_down_to_their_norm(norm):
    """A step of plain descent at a rate of 1 is the gradient."""
    torch.manual_seed(0)
    loss = TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS)
    descent = torch.optim.SGD(loss.parameters(), lr=1.0)
    agent = Agent(loss, loss.actor_network, descent, max_grad_norm=norm)
    before = [parameter.detach().clone() for parameter in loss.parameters()]
    make_update(agent, compile=False)(True, transitions(6))
    moved = [new.detach() - old for new, old in zip(loss.parameters(), before, strict=True)]
    total = torch.cat([part.flatten() for part in moved]).norm().item()
    assert total == pytest.approx(norm, rel=1e-3)


@pytest.mark.parametrize(
    ("config", "attributes"),
    [
        (
            L2C2Config(beta=0.0, fraction=0.5, num_samples=4, over_neighbors="max", max_step=2.0),
            {"l2c2_fraction": 0.5, "l2c2_num_samples": 4, "l2c2_over_neighbors": "max"},
        ),
        (CAPSConfig(sigma=0.7, mean="action"), {"caps_sigma": 0.7, "caps_mean": "action"}),
        (CATSConfig(mean="action"), {"cats_mean": "action"}),
        (
            GradCAPSConfig(epsilon=0.7, mean="action"),
            {"grad_caps_epsilon": 0.7, "grad_caps_mean": "action"},
        ),
        (SR2LConfig(epsilon=0.7, steps=3), {"sr2l_epsilon": 0.7, "sr2l_steps": 3}),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_those_of_a_regularizer(config, attributes):
    """Two runs of the same settings agree also where these are dropped."""
    loss = add_regularizer(normal(), config)
    assert {name: getattr(loss, name) for name in attributes} == attributes
    if make_neighborhood(config) is not None:
        assert loss.l2c2_neighborhood.max_step == 2.0


def test_relative_makes_penalties_follow_the_action_values():
    """By the size of the loss's own term, which is minus the action value."""
    batch, penalties = transitions(6), []
    for relative in (False, True):
        torch.manual_seed(0)
        loss = TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS)
        loss = add_regularizer(loss, CATSConfig(relative=relative))
        torch.manual_seed(1)
        terms = loss(batch.copy())
        penalties.append(terms["loss_cats"])
    size = terms["state_action_value_actor"][0].abs().mean()  # The first of two is maximized.
    torch.testing.assert_close(penalties[1], penalties[0] * size)


@pytest.mark.parametrize(
    "config",
    [config for config in REGULARIZERS.values() if isinstance(config, GainConfig)],
    ids=lambda config: config.name,
)
def test_one_gain_scales_every_term_of_the_policy(config):
    """Otherwise ramps and targets would change nothing."""
    loss, batch, found = add_regularizer(normal(), config), transitions(6), []
    batch["previous_observation"] = batch["observation"] + 0.1
    if config.name == "asap":  # whose prediction is the policy's at first
        for parameter in loss.asap_predictor.parameters():
            parameter.data.add_(0.1)
    for gain in (1.0, 0.5):
        loss.regularizer_gain = gain
        torch.manual_seed(1)
        found.append(loss.policy_regularizer(batch.copy()))
    for key in loss.policy_terms:
        assert found[0][key] > 0
        torch.testing.assert_close(found[1][key], 0.5 * found[0][key])
