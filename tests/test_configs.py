"""The package's Hydra configurations, composed with those of TorchRL's trainers."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

import pytest
import torch
from hydra import compose, initialize, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException, InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, MissingMandatoryValue, ValidationError
from tensordict import TensorDict
from torch import nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.objectives import SACLoss, TD3Loss
from torchrl.trainers.algorithms import SACTrainer

from torchrl_l2c2 import (
    AdaTerm,
    ASAPLoss,
    CAPSLoss,
    CATSLoss,
    GradCAPSLoss,
    L2C2Loss,
    Neighborhood,
    NeighborTransform,
    ObservationNoise,
    PPORPELoss,
    ProgressHook,
    TSoftUpdate,
    make_actor,
    make_critic,
    trainers,
)

OURS = {
    ("loss", "smooth"): trainers.SmoothLossConfig,
    ("loss", "l2c2"): trainers.L2C2LossConfig,
    ("loss", "ppo_rpe"): trainers.PPORPELossConfig,
    ("transform", "neighbor"): trainers.NeighborTransformConfig,
    ("transform", "observation_noise"): trainers.ObservationNoiseConfig,
    ("optimizer", "adaterm"): trainers.AdaTermConfig,
    ("target_net_updater", "tsoft"): trainers.TSoftUpdateConfig,
    ("neighborhood", "l2c2"): trainers.NeighborhoodConfig,
}

# Written as a user of TorchRL's trainers would write it.
NETWORKS = {
    "actor": {
        "_target_": "torchrl.trainers.algorithms.configs.modules._make_tanh_normal_model",
        "in_keys": ["observation"],
        "out_keys": ["action"],
        "network": {
            "_target_": "torchrl.modules.MLP",
            "in_features": 3,
            "out_features": 2,
            "num_cells": [8],
        },
    },
    "qvalue": {
        "_target_": "torchrl.trainers.algorithms.configs.modules._make_value_model",
        "in_keys": ["observation", "action"],
        "out_keys": ["state_action_value"],
        "network": {
            "_target_": "torchrl.modules.MLP",
            "in_features": 4,
            "out_features": 1,
            "num_cells": [8],
        },
    },
}
NEAR = ["+neighborhood@loss.neighborhood=l2c2"]
SAC = ["+loss@loss.base_loss=sac", "++loss.base_loss.target_entropy=-1.0"]
CAPS = ["+loss=smooth", *SAC, "loss.method=caps"]


@pytest.fixture(autouse=True)
def registered():
    """The package's configurations are in Hydra's store."""
    trainers.register()


def composed(*overrides: str) -> DictConfig:
    """The configuration that these overrides make of an empty one."""
    with initialize(version_base=None, config_path=None):
        return compose(overrides=list(overrides))


def with_networks(cfg: DictConfig) -> DictConfig:
    """The configuration with a ``loss.base_loss`` given its networks."""
    OmegaConf.set_struct(cfg, False)
    cfg.networks = NETWORKS
    cfg.loss.base_loss.actor_network = "${networks.actor}"
    cfg.loss.base_loss.qvalue_network = "${networks.qvalue}"
    return cfg


def transitions(batch: int = 5) -> TensorDict:
    """Made-up transitions of three observed values and one action."""
    flags = torch.zeros(batch, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.randn(batch, 3),
            "action": torch.rand(batch, 1) - 0.5,
            "next": {
                "observation": torch.randn(batch, 3),
                "reward": torch.randn(batch, 1),
                "done": flags,
                "terminated": flags,
            },
        },
        [batch],
    )


def test_l2c2_over_sac_composes():
    """``loss: l2c2`` over ``loss: sac`` is a regularized SAC loss with the settings given."""
    cfg = with_networks(
        composed(
            "+loss=l2c2",
            *SAC,
            "loss.beta=0.5",
            *NEAR,
            "loss.neighborhood.lambda_max=0.5",
        )
    )
    loss = instantiate(cfg.loss)
    assert isinstance(loss, SACLoss)
    assert isinstance(loss, L2C2Loss)
    assert loss.l2c2_neighborhood == Neighborhood(lambda_max=0.5)
    assert loss.l2c2_beta == 0.5
    terms = {key for key in loss(transitions()).keys() if key.startswith("loss_")}
    assert terms == {
        "loss_actor",
        "loss_qvalue",
        "loss_alpha",
        "loss_l2c2_actor",
        "loss_l2c2_qvalue",
    }


def test_regularizers_nest():
    """A regularized loss can be the base of another."""
    nested = "+loss@loss.base_loss=smooth", "+loss@loss.base_loss.base_loss=sac"
    caps = "loss.base_loss.method=caps", "loss.base_loss.fold=false"
    cfg = composed("+loss=l2c2", *nested, *caps)
    OmegaConf.set_struct(cfg, False)
    cfg.networks = NETWORKS
    cfg.loss.base_loss.base_loss.update(
        {
            "actor_network": "${networks.actor}",
            "qvalue_network": "${networks.qvalue}",
            "target_entropy": -1.0,
        }
    )
    loss = instantiate(cfg.loss)
    assert isinstance(loss, L2C2Loss) and isinstance(loss, CAPSLoss) and isinstance(loss, SACLoss)


def test_l2c2_reads_nested_keys_and_sample_numbers():
    """Lists are nested keys, as everywhere in TorchRL's configurations."""
    cfg = with_networks(
        composed(
            "+loss=l2c2",
            *SAC,
            "loss.neighbor_key=[replay,near]",
            "loss.hellinger_samples=3",
            "loss.num_samples=2",
            "loss.coeff=2.0",
        )
    )
    loss = instantiate(cfg.loss)
    assert loss.l2c2_neighbor_key == ("replay", "near")
    assert loss._l2c2_distance.keywords == {"num_samples": 3}
    assert (loss.l2c2_num_samples, loss.l2c2_coeff) == (2, 2.0)


def test_a_string_is_one_name():
    """As in Python, where a list of them is expected."""
    loss = composed("+loss=l2c2", *SAC, "loss.moved_keys=observation")
    assert instantiate(with_networks(loss).loss).l2c2_moved_keys == ["observation"]
    for settings in (
        ["+transform=neighbor"],
        ["+transform=observation_noise", "++transform.scale=1"],
    ):
        cfg = composed(*settings, "transform.in_keys=position")
        assert instantiate(cfg.transform).in_keys == ["position"]


@pytest.mark.parametrize(("name", "loss_class"), [("grad_caps", GradCAPSLoss), ("asap", ASAPLoss)])
def test_what_reads_frames_reads_nested_keys(name, loss_class):
    """With the settings given, over SAC."""
    settings = ["+loss.overrides.frames_key=[stack,frames]", "+loss.overrides.epsilon=0.3"]
    cfg = composed("+loss=smooth", *SAC, f"loss.method={name}", *settings)
    loss = instantiate(with_networks(cfg).loss)
    assert isinstance(loss, loss_class) and isinstance(loss, SACLoss)
    assert ("stack", "frames") in loss.in_keys and loss.grad_caps_epsilon == 0.3


def test_ppo_rpe_instantiates():
    """``loss: ppo_rpe`` takes its networks like TorchRL's losses and keeps its settings."""
    cfg = composed("+loss=ppo_rpe", "loss.kappa=0.25", "loss.threshold=ema")
    loss = instantiate(cfg.loss, actor_network=make_actor(3, 1), critic_network=make_critic(3))
    assert isinstance(loss, PPORPELoss)
    assert (loss.kappa, loss.threshold) == (0.25, "ema")


def test_ppo_rpe_needs_networks():
    """Networks have no default: a loss without them is an error that names them."""
    with pytest.raises(MissingMandatoryValue, match="actor_network"):
        instantiate(composed("+loss=ppo_rpe").loss)


def test_neighbor_transform_instantiates_and_is_seeded():
    """``transform: neighbor`` with one seed draws the same neighbors, with another others."""
    overrides = [
        "+transform=neighbor",
        "transform.num_samples=3",
        "transform.out_key=[replay,near]",
    ]
    batch = transitions()

    config = composed(*overrides, "transform.seed=0")

    def drawn(seed):
        config.transform.seed = seed
        transform = instantiate(config.transform)
        assert isinstance(transform, NeighborTransform)
        return transform(batch.clone())["replay", "near", "observation"]

    assert drawn(0).shape == (5, 3, 3)
    assert torch.equal(drawn(0), drawn(0))
    assert not torch.equal(drawn(0), drawn(1))


def test_neighbor_transform_reads_nested_keys():
    """Each item of ``in_keys`` is a key, a list a nested one."""
    cfg = composed("+transform=neighbor", "transform.in_keys=[[agents,observation],position]")
    assert instantiate(cfg.transform).in_keys == [("agents", "observation"), "position"]


def test_neighborhood_is_shared():
    """One ``neighborhood`` node serves the loss and the replay buffer's transform."""
    cfg = with_networks(
        composed(
            "+neighborhood@near=l2c2",
            "near.sigma=0.5",
            "+loss=l2c2",
            *SAC,
            "loss.neighborhood=${near}",
            "+replay_buffer=tensordict",
            "replay_buffer.batch_size=4",
            "+storage@replay_buffer.storage=list",
            "replay_buffer.storage.max_size=10",
            "+transform@replay_buffer.transform=neighbor",
            "replay_buffer.transform.neighborhood=${near}",
        )
    )
    replay = instantiate(cfg.replay_buffer)
    assert isinstance(replay, TensorDictReplayBuffer)
    replay.extend(transitions())
    distance = replay.sample()["neighbor", "distance"]
    near = Neighborhood(sigma=0.5)
    assert (distance <= near.radius + near.epsilon).all()
    assert instantiate(cfg.loss).l2c2_neighborhood == near


@pytest.mark.parametrize("name", ["neighbor", "observation_noise"])
def test_a_transforms_generator_is_on_its_device(name):
    """Batches on a GPU want one that is there."""
    node = composed(
        f"+transform={name}",
        "transform.seed=0",
        "transform.device=cuda",
        *(["transform.scale=1"] if name == "observation_noise" else []),
    ).transform
    if torch.cuda.is_available():
        assert instantiate(node).generator.device.type == "cuda"
        return
    with pytest.raises(InstantiationException, match="cuda"):
        instantiate(node)


@pytest.mark.parametrize("scale", [0.5, [0.5, 0.0, 0.0]])
def test_observation_noise_instantiates_and_is_seeded(scale):
    """``transform: observation_noise`` takes a number or a list, and a seed."""
    cfg = composed("+transform=observation_noise", f"transform.scale={scale}", "transform.seed=3")

    def observed():
        noise = instantiate(cfg.transform)
        assert isinstance(noise, ObservationNoise)
        env = TransformedEnv(GymEnv("Pendulum-v1"), noise)
        env.set_seed(0)
        return env.reset()["observation"]

    env = GymEnv("Pendulum-v1")
    env.set_seed(0)
    drawn = torch.randn(3, generator=torch.Generator().manual_seed(3))
    expected = env.reset()["observation"] + drawn * torch.tensor(scale)
    torch.testing.assert_close(observed(), expected)


def test_adaterm_is_partial():
    """``optimizer: adaterm`` waits for the parameters, as TorchRL's trainers give them."""
    cfg = composed("+optimizer=adaterm", "optimizer.lr=0.02")
    optimizer = instantiate(cfg.optimizer)(params=nn.Linear(2, 1).parameters())
    assert isinstance(optimizer, AdaTerm)
    assert optimizer.param_groups[0]["lr"] == 0.02


def test_tsoft_is_partial():
    """``target_net_updater: tsoft`` waits for the loss, as TorchRL's trainers give it."""
    cfg = composed("+target_net_updater=tsoft", "target_net_updater.nu=inf")
    updater = instantiate(cfg.target_net_updater)(PPORPELoss(make_actor(3, 1), make_critic(3)))
    assert isinstance(updater, TSoftUpdate)
    assert (updater.tau, updater.nu) == (0.1, float("inf"))


def test_trainer_composes():
    """A whole SAC trainer of TorchRL's, regularized by configuration alone, trains."""
    cfg = with_networks(
        composed(
            "+env@training_env=gym",
            "training_env.env_name=Pendulum-v1",
            "+collector=sync",
            "collector.create_env_fn=${training_env}",
            "collector.policy=${networks.actor}",
            "collector.frames_per_batch=16",
            "collector.total_frames=32",
            "+replay_buffer=tensordict",
            "replay_buffer.batch_size=8",
            "+storage@replay_buffer.storage=lazy_tensor",
            "replay_buffer.storage.max_size=100",
            "+sampler@replay_buffer.sampler=prioritized",
            "replay_buffer.sampler.max_capacity=100",
            "replay_buffer.sampler.alpha=1.0",
            "replay_buffer.sampler.beta=0.5",
            "replay_buffer.sampler.eps=1e-8",
            "replay_buffer.sampler.reduction=max",
            "+transform@replay_buffer.transform=neighbor",
            "replay_buffer.transform.seed=0",
            "+loss=l2c2",
            *SAC,
            "+optimizer=adaterm",
            "+target_net_updater=tsoft",
            "+trainer=sac",
            "trainer.collector=${collector}",
            "trainer.replay_buffer=${replay_buffer}",
            "trainer.loss_module=${loss}",
            "trainer.optimizer=${optimizer}",
            "trainer.target_net_updater=${target_net_updater}",
            "trainer.logger=null",
            "trainer.save_trainer_file=null",
            "trainer.total_frames=32",
            "trainer.optim_steps_per_batch=2",
            "trainer.progress_bar=false",
            "trainer.enable_logging=false",
        )
    )
    trainer = instantiate(cfg.trainer)
    assert isinstance(trainer, SACTrainer)
    assert isinstance(trainer.loss_module, L2C2Loss)
    assert isinstance(trainer.optimizer, AdaTerm)
    assert isinstance(trainer.target_net_updater, TSoftUpdate)
    trainer.train()
    assert len(trainer._log_dict["loss_l2c2_qvalue"]) == 2


def test_td3s_trainer_gives_the_smoothed_loss_its_networks():
    """It calls the loss's node, as the plain loss's: both have ``_partial_``."""
    cfg = composed(
        *("+env@training_env=gym", "training_env.env_name=Pendulum-v1", "+collector=sync"),
        *("collector.create_env_fn=${training_env}", "collector._partial_=true"),
        *("collector.policy=null", "collector.frames_per_batch=16", "collector.total_frames=16"),
        *("+loss=smooth", "+loss@loss.base_loss=td3", "loss._partial_=true", "loss.strength=3"),
        *("+optimizer=adaterm", "+target_net_updater=tsoft", "+trainer=td3"),
        *("+replay_buffer=tensordict", "replay_buffer.batch_size=8"),
        *("+storage@replay_buffer.storage=lazy_tensor", "replay_buffer.storage.max_size=100"),
        *("trainer.collector=${collector}", "trainer.loss_module=${loss}"),
        *("trainer.optimizer=${optimizer}", "trainer.replay_buffer=${replay_buffer}"),
        *("trainer.target_net_updater=${target_net_updater}", "trainer.total_frames=16"),
        *("trainer.logger=null", "trainer.save_trainer_file=null", "trainer.progress_bar=false"),
        *("trainer.optim_steps_per_batch=1", "trainer.enable_logging=false"),
        *("trainer.actor_network=${networks.actor}", "trainer.qvalue_network=${networks.qvalue}"),
    )
    OmegaConf.set_struct(cfg, False)
    network = {"_target_": "torchrl.modules.MLP", "in_features": 3, "out_features": 1}
    actor = {"_target_": "torchrl.modules.Actor", "module": network, "in_keys": ["observation"]}
    cfg.networks = {**NETWORKS, "actor": actor}
    cfg.loss.base_loss["_partial_"] = True
    trainer = instantiate(cfg.trainer)
    assert isinstance(trainer.loss_module, TD3Loss) and trainer.loss_module.strength == 3.0
    trainer.train()


def documented(number: int, folder: Path, *overrides: str) -> DictConfig:
    """A YAML block of the documentation's page, composed, with networks."""
    page = (Path(__file__).parents[1] / "docs" / "trainers.md").read_text()
    block = re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)[number]
    (folder / "config.yaml").write_text(block)
    with initialize_config_dir(str(folder), version_base=None):
        cfg = compose("config", overrides=[*overrides, "+networks={}"])
    OmegaConf.set_struct(cfg, False)
    cfg.networks = NETWORKS
    return cfg


def test_documented_smooth_composes(tmp_path):
    """The page's first YAML is SAC's preset, with what its shell command changes."""
    changes = ["loss.strength=2", "+loss.overrides.lambda_max=500"]
    cfg = documented(0, tmp_path, *changes)
    loss = instantiate(cfg.loss)
    assert [type(hook) for hook in instantiate(cfg.trainer.hooks)] == [ProgressHook]
    assert isinstance(loss, SACLoss) and isinstance(loss, L2C2Loss)
    assert loss.l2c2_neighborhood == Neighborhood(lambda_min=10, lambda_max=500, neighbors="line")
    assert loss.regularizer_gain == 2.0 and loss.folded


def test_documented_components_compose(tmp_path):
    """The page's second YAML is a loss and a buffer with the same neighborhood: SAC's preset."""
    cfg = documented(1, tmp_path, "near.lambda_max=500")
    loss, transform = instantiate(cfg.loss), instantiate(cfg.replay_buffer.transform)
    assert isinstance(loss, SACLoss) and isinstance(loss, L2C2Loss)
    near = Neighborhood(lambda_min=10.0, lambda_max=500.0, neighbors="line")
    assert loss.l2c2_neighborhood == transform.neighborhood == near
    assert loss.l2c2_policy_distance == "mean" and loss.policy_terms == loss.added_terms


def test_smooth_reads_methods_and_nested_keys():
    """``loss: smooth`` has the table of presets; lists are names of entries."""
    settings = ["loss.method=cats", "loss.fold=false", "+loss.overrides.lambda_temporal=3"]
    loss = instantiate(with_networks(composed("+loss=smooth", *SAC, *settings)).loss)
    assert isinstance(loss, CATSLoss) and loss.cats_lambda_temporal == 3.0
    assert "loss_cats" in loss(transitions()).keys()
    keys = [
        "+loss.overrides.neighbor_key=[replay,near]",
        "+loss.overrides.moved_keys=[observation]",
    ]
    loss = instantiate(with_networks(composed("+loss=smooth", *SAC, *keys)).loss)
    assert loss.l2c2_neighbor_key == ("replay", "near")
    assert loss.l2c2_moved_keys == ["observation"]


def test_a_neighborhood_is_shared_with_a_smoothed_loss():
    """As a node, by its name: OmegaConf makes a configuration of what it instantiated."""
    near = ["+neighborhood@near=l2c2", "near.lambda_min=10", "near.lambda_max=1000"]
    near += ["near.neighbors=line", "+loss.overrides.neighborhood=${near}"]
    loss = instantiate(with_networks(composed("+loss=smooth", *SAC, *near)).loss)
    expected = Neighborhood(lambda_min=10.0, lambda_max=1000.0, neighbors="line")
    assert loss.l2c2_neighborhood == expected


@pytest.mark.parametrize(
    "overrides,message",
    [
        (["+loss=l2c2", *SAC, "loss.beta=-1.0"], "l2c2_beta must be finite and at least 0"),
        (["+loss=l2c2", *SAC, *NEAR, "loss.neighborhood.sigma=0.0"], "sigma must be finite"),
        (["+loss=l2c2", *SAC, "loss.num_samples=0"], "num_samples must be at least 1"),
        ([*CAPS, "+loss.overrides.sigma=-0.2"], "sigma must be finite and greater"),
        ([*CAPS, "+loss.overrides.mean=median"], "mean must be 'loc' or 'action'"),
        (["+loss=smooth", *SAC, "loss.method=l2c3"], "one of .*'l2c2', .* got 'l2c3'"),
        (["+loss=smooth", *SAC, "+loss.overrides.bett=1"], r"Expected settings of l2c2, .*'bett'"),
    ],
)
def test_wrong_loss_settings_give_the_loss_errors(overrides, message):
    """What a loss refuses from Python, it refuses from a configuration, in the same words."""
    with pytest.raises(InstantiationException, match=message):
        instantiate(with_networks(composed(*overrides)).loss)


@pytest.mark.parametrize(
    "overrides,message",
    [
        (["+node=neighbor", "node.num_samples=0"], "num_samples must be at least 1"),
        (["+node=observation_noise", "node.scale=-0.1"], "scale must be finite and at least 0"),
    ],
)
def test_wrong_transform_settings_give_the_transform_errors(overrides, message):
    """Likewise for transforms."""
    overrides = [overrides[0].replace("+node", "+transform@node"), overrides[1]]
    with pytest.raises(InstantiationException, match=message):
        instantiate(composed(*overrides).node)


def test_wrong_optimizer_and_updater_settings_give_their_errors():
    """Likewise for what waits for its parameters: when it gets them."""
    optimizer = instantiate(composed("+optimizer=adaterm", "optimizer.beta=1.5").optimizer)
    with pytest.raises(ValueError, match="beta"):
        optimizer(params=nn.Linear(2, 1).parameters())
    updater = instantiate(
        composed("+target_net_updater=tsoft", "target_net_updater.tau=0.0").target_net_updater
    )
    with pytest.raises(ValueError, match="tau must be in"):
        updater(PPORPELoss(make_actor(3, 1), make_critic(3)))


@pytest.mark.parametrize("node", OURS)
def test_unknown_settings_are_refused(node):
    """A misspelled setting is an error of the composition, which names it."""
    group, name = node
    with pytest.raises(ConfigCompositionException, match="bett") as caught:
        composed(f"+{group}@node={name}", "node.bett=1")
    assert isinstance(caught.value.__cause__, ConfigAttributeError)


@pytest.mark.parametrize("node", OURS)
def test_values_of_another_type_are_refused(node):
    """Numbers are checked where they are composed, before anything is built."""
    group, name = node
    kinds = get_type_hints(OURS[node])
    numbers = [f.name for f in fields(OURS[node]) if kinds[f.name] in (float, int, int | None)]
    made = composed(f"+{group}@node={name}").node
    for number in numbers:
        with pytest.raises(ValidationError, match="many"):
            made[number] = "many"
    assert numbers or node == ("transform", "observation_noise")


def test_a_value_of_another_type_ends_the_composition():
    """With what was given."""
    with pytest.raises(ConfigCompositionException, match="many"):
        composed("+loss@node=l2c2", "node.coeff=many")


def test_a_base_loss_is_required():
    """``loss: l2c2`` alone has nothing to regularize and says what is missing."""
    with pytest.raises(MissingMandatoryValue, match="base_loss"):
        instantiate(composed("+loss=l2c2").loss)


def test_registering_twice_changes_nothing():
    """All our names, and TorchRL's own, are there once, the second call as the first."""

    def stored():
        repo = ConfigStore.instance().repo
        groups = {group for group, _ in OURS}
        return {(group, name): node.node for group in groups for name, node in repo[group].items()}

    before = stored()
    trainers.register()
    assert stored() == before
    assert {(group, f"{name}.yaml") for group, name in OURS} <= set(before)
    assert ("loss", "sac.yaml") in before


def test_targets_are_the_package_own():
    """No node of ours names anything but this package's classes and builders to be called."""
    nodes = composed(*(f"+{group}@{group}_{name}={name}" for group, name in OURS))
    assert len(nodes) == len(OURS)
    for node in OmegaConf.to_container(nodes).values():
        targets = [node["_target_"]]
        targets += [v["_target_"] for v in node.values() if isinstance(v, dict) and v]
        assert all(target.startswith("torchrl_l2c2.") for target in targets)
