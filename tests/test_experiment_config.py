"""The settings: YAML and Python agree, and what cannot be is refused with what is allowed."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from torchrl_l2c2.experiment import ExperimentConfig, TaskConfig
from torchrl_l2c2.experiment.config import GROUPS, SACConfig

CONF = Path(__file__).parent.parent / "conf"


def composed(*overrides):
    """What `python train.py` composes; other tests store TorchRL's nodes under the same names."""
    store = ConfigStore.instance()
    stored = store.repo
    store.repo = {name: nodes for name, nodes in stored.items() if name not in GROUPS}
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return OmegaConf.to_container(compose("config", list(overrides)), resolve=True)
    finally:
        store.repo = stored


def test_the_defaults_of_the_files_are_those_of_the_classes():
    """A script without Hydra has the defaults of the command line."""
    assert ExperimentConfig.from_dict(composed()) == ExperimentConfig()


@pytest.mark.parametrize(
    ("group", "name"),
    [(g, p.stem) for g in GROUPS for p in sorted((CONF / g).glob("*.yaml"))],
)
def test_every_file_of_every_group_is_a_valid_choice(group, name):
    """The file's values are the class's defaults, but for a variant's own."""
    # The frames of one rollout are what on-policy learning alone can use.
    extra = ["algorithm=ppo"] if name == "rollout" else []
    config = getattr(ExperimentConfig.from_dict(composed(f"{group}={name}", *extra)), group)
    assert config.name == name
    if name not in ("l2c2_policy",):
        assert config == GROUPS[group][name](name=name)


@pytest.mark.parametrize("algorithm", GROUPS["algorithm"])
def test_an_algorithm_brings_its_usual_replay_and_optimizer(algorithm):
    """From the files as from the classes."""
    files = ExperimentConfig.from_dict(composed(f"algorithm={algorithm}"))
    assert files == ExperimentConfig(algorithm=GROUPS["algorithm"][algorithm]())


@pytest.mark.parametrize("name", sorted(p.stem for p in (CONF / "experiment").glob("*.yaml")))
@pytest.mark.parametrize("regularizer", ["none", "l2c2"])
def test_every_comparison_is_made_of_valid_runs(name, regularizer):
    """With the task and sizes that its file says."""
    config = ExperimentConfig.from_dict(
        composed(f"experiment={name}", f"regularizer={regularizer}")
    )
    env_id, algorithm, size = {
        "swingup_table": (TaskConfig().env_id, "ppo_rpe", 32),
        "pendulum": ("Pendulum-v1", "ppo_rpe", 64),
        "cartpole": ("CartPole-v1", "dqn", 64),
    }[name]
    assert config.algorithm.name == algorithm and config.replay.batch_size == size
    assert config.regularizer.name == regularizer
    assert config.task.env_id == env_id


@pytest.mark.parametrize("task", ["swingup", "reacher", "hopper", "ant"])
def test_the_papers_tasks_have_the_papers_noise(task):
    """Scale .01 for Swingup and Reacher, .001 for Hopper and Ant."""
    config = ExperimentConfig.from_dict(composed(f"task={task}")).task
    assert config.noise_scale == {"swingup": 0.01, "reacher": 0.01}.get(task, 0.001)


def test_every_key_of_every_file_has_a_comment():
    """No setting without a word on what it is."""
    bare = [
        f"{path.relative_to(CONF)}: {line}"
        for path in CONF.rglob("*.yaml")
        for line in path.read_text().splitlines()
        if line[:1].isalpha()
        and not line.startswith(("name:", "defaults:", "hydra:"))
        and "#" not in line
    ]
    assert bare == []


def test_settings_survive_a_round_trip():
    """What a run's folder holds can be read back."""
    config = ExperimentConfig(task=TaskConfig(episodes=3), seed=7)
    assert ExperimentConfig.from_dict(config.to_dict()) == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": {"episode": 3}}, "unknown setting task.episode; allowed here are task.env_id"),
        ({"task": {"episodes": 0}}, "TaskConfig.episodes must be a whole number of at least 1"),
        ({"task": {"noise_scale": -1.0}}, "noise_scale must be at least 0, got -1.0"),
        ({"regularizer": {"name": "lipsnet"}}, "regularizer.name must be one of .*'l2c2'"),
        ({"algorithm": {"name": "ppo_rpe", "schedule": "now"}}, "schedule must be one of"),
        ({"replay": {"name": "uniform", "capacity": 8}}, "capacity must be at least the batch"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"sed": 1}, "unknown setting sed"),
    ],
)
def test_wrong_settings_are_refused_with_what_is_allowed(settings, message):
    """The error names the setting, what was given and what is allowed."""
    with pytest.raises(ValueError, match=message):
        ExperimentConfig.from_dict(settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_workers": 0}, "num_workers must be a whole number of at least 1, got 0"),
        ({"num_workers": 3}, r"task.episodes=200 must be a multiple of num_workers=3.*use 198"),
        (
            {"num_workers": 2, "algorithm": SACConfig()},
            "algorithm.schedule=step updates after every frame",
        ),
    ],
)
def test_workers_that_cannot_share_the_episodes_are_refused(settings, message):
    """With what would be allowed."""
    with pytest.raises(ValueError, match=message):
        ExperimentConfig(**settings)
