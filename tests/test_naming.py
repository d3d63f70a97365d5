"""The names of runs' folders: the same for the same settings, and taken as they are everywhere."""

import shlex
from dataclasses import replace

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from torchrl_l2c2.experiment import (
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPORPEConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.settings.config import GROUPS
from torchrl_l2c2.experiment.settings.naming import MAX_PART_LENGTH, run_name

SWINGUP = GROUPS["task"]["swingup"]


@pytest.mark.parametrize(
    ("settings", "name"),
    [
        ({}, "swingup/ppo_rpe/l2c2/seed_0"),
        ({"regularizer": NoRegularizerConfig(), "seed": 7}, "swingup/ppo_rpe/none/seed_7"),
        ({"regularizer": L2C2Config(beta=0.2)}, "swingup/ppo_rpe/l2c2/beta-0.2/seed_0"),
        # The algorithm, the replay buffer and the optimizer have a beta of their own.
        ({"algorithm": PPORPEConfig(beta=0.2)}, "swingup/ppo_rpe/l2c2/algorithm.beta-0.2/seed_0"),
        (
            {"compile": False, "test_episodes": 5},
            "swingup/ppo_rpe/l2c2/compile-false",
        ),
        (
            {"algorithm": TD3Config(hidden=(8, 9)), "regularizer": NoRegularizerConfig()},
            "swingup/td3/none/hidden-8x9/seed_0",
        ),
        ({"replay": UniformReplayConfig()}, "swingup/ppo_rpe/l2c2/replay-uniform/seed_0"),
        ({"task": TaskConfig("A:B/C v1", "A:B/C v1")}, "A-B-C-v1/ppo_rpe/l2c2/seed_0"),
        (
            {"task": TaskConfig("mine", "A-v1")},
            "mine/ppo_rpe/l2c2/env_id-A-v1/seed_0",
        ),
        ({"task": replace(SWINGUP, max_steps=9)}, "swingup/ppo_rpe/l2c2/max_steps-9/seed_0"),
    ],
)
def test_a_name_has_what_is_not_usual(settings, name):
    """Task, algorithm, regularizer, then settings other than usual, then the seed."""
    assert run_name(ExperimentConfig(**settings)).startswith(name)


def test_what_changes_no_number_changes_no_name():
    """The same command with more episodes goes on in the same folder."""
    other = ExperimentConfig(
        task=replace(SWINGUP, episodes=400, solved_at=1.0),
        logger=GROUPS["logger"]["tensorboard"],
        test_episodes=3,
        late_share=0.5,
        threads=2,
    )
    assert run_name(other) == run_name(ExperimentConfig())


@given(
    beta=st.floats(0, 1e6),
    env_id=st.text(min_size=1, max_size=200),
    hidden=st.lists(st.integers(1, 999), min_size=1, max_size=40),
)
def test_shells_hydra_and_every_file_system_take_a_name_as_it_is(beta, env_id, hidden):
    """Not quoted, not escaped, no longer than a file's name may be."""
    name = run_name(
        ExperimentConfig(
            task=TaskConfig(env_id, env_id),
            regularizer=L2C2Config(beta=beta),
            algorithm=PPORPEConfig(hidden=tuple(hidden)),
        )
    )
    assert shlex.quote(name) == name
    (override,) = OverridesParser.create().parse_overrides([f"hydra.run.dir=outputs/{name}"])
    assert override.value() == f"outputs/{name}" and not override.is_sweep_override()
    for part in name.split("/"):
        assert 0 < len(part) <= MAX_PART_LENGTH and not part.endswith(".")


def test_long_names_of_different_settings_differ():
    """A hash of the whole stands for what is cut off."""
    long = [tuple(range(100, 130)), (*range(100, 129), 7)]
    names = {run_name(ExperimentConfig(algorithm=PPORPEConfig(hidden=h))) for h in long}
    assert len(names) == 2


def test_long_names_begin_with_what_is_compared():
    """The regularizer's settings; short ones are in the order of the groups."""
    regularizer = L2C2Config(gain="ramp", beta=0.2)
    short, long = (
        run_name(ExperimentConfig(algorithm=PPORPEConfig(hidden=h), regularizer=regularizer))
        for h in ((8,), tuple(range(100, 130)))
    )
    assert short.split("/")[3] == "hidden-8_gain-ramp_beta-0.2"
    assert long.split("/")[3].startswith("gain-ramp_beta-0.2_hidden-100x101x")
