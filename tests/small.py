"""Small settings of every algorithm, for tests that are not about learning well."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from torchrl_l2c2.experiment import (
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SACConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.cli.composition import CONF, register
from torchrl_l2c2.experiment.settings.config import GROUPS

ALGORITHMS = {
    "ppo_rpe": PPORPEConfig(hidden=(8,), replay_ratio=2.0),
    "sac": SACConfig(random_frames=10, hidden=(8,)),
    "td3": TD3Config(random_frames=10, hidden=(8,)),
    "ppo": PPOConfig(frames=30, epochs=2, hidden=(8,)),
}


def replay_of(name):
    """What an algorithm learns from, in batches of 16."""
    return (RolloutReplayConfig if name == "ppo" else UniformReplayConfig)(batch_size=16)


@contextmanager
def own_nodes() -> Iterator[None]:
    """Room for the nodes of the command; other tests store TorchRL's, of the same names."""
    store = ConfigStore.instance()
    stored = store.repo
    store.repo = {name: nodes for name, nodes in stored.items() if name not in GROUPS}
    try:
        yield
    finally:
        store.repo = stored


def composed(*overrides: str) -> dict[str, Any]:
    """What the command composes."""
    return copy.deepcopy(_composed_once(overrides))


@cache
def _composed_once(overrides: tuple[str, ...]) -> Any:
    with ready_to_compose():
        return OmegaConf.to_container(compose("config", list(overrides)), resolve=True)


@contextmanager
def ready_to_compose() -> Iterator[None]:
    """Hydra as within the command."""
    with own_nodes():
        register()
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield
