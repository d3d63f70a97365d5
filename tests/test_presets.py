"""What is learned with the RL Zoo's settings: the equations of Stable-Baselines3, by hand."""

import math
import re
import shlex
from pathlib import Path

import pytest
import torch
from small import composed
from tensordict import TensorDict
from torch.distributions import Normal

from torchrl_l2c2.experiment import ExperimentConfig
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.envs.environments import make_env


def agent_of(task, algorithm, *more):
    config = ExperimentConfig.from_dict(
        composed(
            "preset=rl_zoo", f"task={task}", f"algorithm={algorithm}", "regularizer=none", *more
        )
    )
    torch.manual_seed(0)
    return config, make_agent(config, make_env(config.task, config.seed))


def batch_of(agent, size, observations, actions):
    generator = torch.Generator().manual_seed(0)
    draw = torch.randn(6, size, 1, generator=generator)
    seen = torch.randn(2, size, observations, generator=generator)
    done = draw[5] > 0.5
    following = {"observation": seen[1], "reward": draw[0], "terminated": done, "done": done}
    return TensorDict(
        {
            "observation": seen[0],
            "action": torch.randn(size, actions, generator=generator),
            "action_log_prob": draw[1].squeeze(-1) - 4.0,
            "advantage": 3.0 * draw[2] + 1.0,
            "value_target": draw[3],
            "next": following,
        },
        [size],
    )


def test_ppo_has_the_loss_of_stable_baselines():
    """The surrogate with normalized advantages, the entropy, the squared error of the values."""
    config, agent = agent_of("hopper_v5", "ppo")
    chosen, batch = config.algorithm, batch_of(agent, 32, 11, 3)
    terms = agent.loss(batch.copy())
    written = agent.loss.actor_network(batch.copy())
    policy = Normal(written["loc"], written["scale"])
    log_prob = policy.log_prob(batch["action"]).sum(-1)
    ratio = (log_prob - batch["action_log_prob"]).exp()
    advantage = batch["advantage"].squeeze(-1)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    clipped = ratio.clamp(1 - chosen.clip_epsilon, 1 + chosen.clip_epsilon)
    surrogate = -torch.min(advantage * ratio, advantage * clipped).mean()
    entropy = policy.entropy().sum(-1).mean()
    value = agent.advantage.value_network(batch.copy())["state_value"]
    error = (value - batch["value_target"]).square().mean()
    torch.testing.assert_close(terms["loss_objective"], surrogate)
    torch.testing.assert_close(terms["loss_entropy"], -0.00229519 * entropy)
    torch.testing.assert_close(terms["loss_critic"], 0.835671 * error)
    assert written["scale"].log().flatten().tolist() == pytest.approx([-2.0] * 96)


def test_sac_has_the_targets_of_stable_baselines():
    """The lesser of two target values, less temperature times likelihood, unless it ended."""
    _, agent = agent_of("hopper_v5", "sac", "algorithm.hidden=[8]")
    loss, batch = agent.loss, batch_of(agent, 32, 11, 3)
    batch["action"].clamp_(-0.9, 0.9)
    assert loss.target_entropy.item() == -3.0
    torch.manual_seed(1)
    terms = loss(batch.copy())
    # The values' loss draws first.
    torch.manual_seed(1)
    with torch.no_grad():
        drawn = _critic_draw(loss, batch)
        values = loss._vmap_qnetworkN0(
            drawn.select(*loss.qvalue_network.in_keys), loss.target_qvalue_network_params
        )["state_action_value"]
        soft = values.min(0).values - loss._alpha * drawn["action_log_prob"].unsqueeze(-1)
        ended = batch["next", "terminated"]
        target = batch["next", "reward"] + 0.99 * soft * ~ended
    predicted = loss._vmap_qnetworkN0(
        batch.select(*loss.qvalue_network.in_keys), loss.qvalue_network_params
    )["state_action_value"]
    expected = (predicted - target).square().sum(0).mean()
    torch.testing.assert_close(terms["loss_qvalue"], expected)


def test_sacs_temperature_keeps_the_entropy_of_scaled_actions():
    """Halved, Pendulum's have an entropy of -1; the temperature's loss is of what differs."""
    _, agent = agent_of("pendulum", "sac", "algorithm.hidden=[8]")
    halved = torch.distributions.AffineTransform(0.0, 0.5)
    log_density = -halved.log_abs_det_jacobian(torch.zeros(()), torch.zeros(()))
    target = agent.loss.target_entropy.item()
    assert target - log_density.item() == pytest.approx(-1.0, abs=1e-5)
    torch.manual_seed(0)
    terms = agent.loss(batch_of(agent, 16, 3, 1))
    assert terms["loss_alpha"].item() == 0.0  # of a temperature of 1, whose logarithm is 0
    (gradient,) = torch.autograd.grad(terms["loss_alpha"], agent.loss.log_alpha)
    assert gradient.item() == pytest.approx(terms["entropy"].item() - target, rel=1e-4)


def test_the_general_presets_target_entropy_is_of_scaled_actions():
    """Whatever the range of a task's actions; tasks of their own preset keep their settings."""
    general = ("task.env_id=Pendulum-v1", "algorithm.hidden=[8]")
    config, agent = agent_of("gymnasium", "sac", *general)
    assert config.algorithm.target_entropy == "scaled"
    assert agent.loss.target_entropy.item() == pytest.approx(-1.0 + math.log(2.0))
    config, _ = agent_of("lunarlander", "sac", "algorithm.hidden=[8]")
    assert config.algorithm.target_entropy is None


def _critic_draw(loss, batch):
    following = TensorDict({"observation": batch["next", "observation"]}, batch.batch_size)
    with loss.actor_network_params.to_module(loss.actor_network):
        distribution = loss.actor_network.get_dist(following)
    action = distribution.rsample()
    log_prob = distribution.log_prob(action)
    return following.update({"action": action, "action_log_prob": log_prob})


def test_first_weights_are_orthogonal_and_the_first_policy_near_zero():
    """Gains of the root of 2, of .01 and of 1."""
    _, agent = agent_of("pendulum", "ppo")
    actor = agent.loss.actor_network_params.flatten_keys(".")
    critic = agent.loss.critic_network_params.flatten_keys(".")
    gains = {}
    for name, network in (("actor", actor), ("critic", critic)):
        weights = [value.detach() for key, value in network.items() if key.endswith("weight")]
        gains[name] = [torch.linalg.matrix_norm(weight, 2).item() for weight in weights]
        biases = [value for key, value in network.items() if key.endswith("bias")]
        assert len(biases) == 3 and not any(bias.any() for bias in biases)
    root = 2**0.5
    assert gains["actor"] == pytest.approx([root, root, 0.01], rel=1e-4)
    assert gains["critic"] == pytest.approx([root, root, 1.0], rel=1e-4)


PAGE = Path(__file__).parents[1] / "docs" / "stable_baselines3.md"
# What Stable-Baselines3 2.9 does by default, in this package's names.
DEFAULTS = {
    "ppo": {
        "optimizer": {"lr": 3e-4, "eps": 1e-5, "linear": False},
        "replay": {"batch_size": 64},
        "algorithm": {
            **{"frames": 2048, "epochs": 10, "gamma": 0.99, "gae_lambda": 0.95},
            **{"clip_epsilon": 0.2, "entropy_coeff": 0.0, "critic_coeff": 0.5},
            **{"max_grad_norm": 0.5, "hidden": (64, 64), "activation": "tanh", "log_scale": 0.0},
            **{"orthogonal": True, "normalize_observations": False, "normalize_rewards": False},
        },
    },
    "sac": {
        "optimizer": {"lr": 3e-4, "eps": 1e-8, "linear": False},
        "replay": {"batch_size": 256, "capacity": 1_000_000},
        "algorithm": {
            **{"gamma": 0.99, "tau": 0.005, "updates": 1, "random_frames": 100},
            **{"hidden": (256, 256), "alpha_init": 1.0, "scale_mapping": "exp"},
        },
    },
}


@pytest.mark.parametrize("algorithm", DEFAULTS)
def test_the_pages_commands_have_the_defaults_of_stable_baselines(algorithm):
    """Those in place of PPO("MlpPolicy", env) and SAC("MlpPolicy", env)."""
    commands = re.findall(r"train\.py (task=gymnasium (?:.*\\\n)*.*)", PAGE.read_text())
    chosen = [shlex.split(command) for command in commands]
    (overrides,) = [each for each in chosen if f"algorithm={algorithm}" in each]
    config = ExperimentConfig.from_dict(composed(*(each for each in overrides if each.strip())))
    for part, defaults in DEFAULTS[algorithm].items():
        assert {name: getattr(getattr(config, part), name) for name in defaults} == defaults


def test_the_pages_names_are_settings():
    """Of PPO or of SAC, as its table has them."""
    named = re.findall(r"`((?:task|algorithm|replay|optimizer)\.\w+)", PAGE.read_text())
    sections = PAGE.with_stem("settings").read_text().split("\n## ")
    chosen = ("task=", "algorithm=ppo\n", "algorithm=sac\n", "replay=", "optimizer=adam\n")
    found = "\n".join(section for section in sections if section.startswith(chosen))
    known = set(re.findall(r"^\| `([^`]+)`", found, re.M))
    assert len(named) > 20
    assert set(named) <= known
