"""Wrong settings, as the command line gives them: each a line, and none of them starts."""

import dataclasses
import math
import os
from typing import Annotated, get_type_hints

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from pydantic import TypeAdapter
from small import own_nodes

from torchrl_l2c2.experiment import Experiment, ExperimentConfig
from torchrl_l2c2.experiment.cli.composition import (
    CONF,
    check_outputs,
    composition_errors,
    read,
    register,
)
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.settings.config import GROUPS
from torchrl_l2c2.experiment.settings.fields import SettingError, describe


@pytest.fixture(scope="module")
def settings_of():
    """What the command makes of its overrides."""

    def read(line):
        plain = OmegaConf.to_container(compose("config", line.split()), resolve=True)
        return ExperimentConfig.from_dict(plain)

    with own_nodes():
        register()
        with initialize_config_dir(str(CONF), version_base="1.3"):
            yield read


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("seed=-1", "seed must be greater than or equal to 0, got -1."),
        ("seed=4294967000", "seed must be less than 2147483648, got 4294967000."),
        ("seed=zero", "seed must be a valid integer, got 'zero'."),
        ("device=mps", "device must be cpu, cuda or cuda:N with N >= 0, got 'mps'."),
        ("seed=1.5", "seed must be a valid integer, got 1.5."),
        ("threads=1e11", "threads must be less than or equal to 1024, got 100000000000."),
        (
            "task.noise_scale=1e308",
            "task.noise_scale must be less than or equal to 1000000000, got 1e+308.",
        ),
        (
            "algorithm.hidden=[10000000]",
            "algorithm.hidden must be less than or equal to 1000000, got",
        ),
        ("threads=0", "threads must be greater than or equal to 1, got 0."),
        ("compile=maybe", "compile must be a valid boolean, got 'maybe'."),
        ("test_episodes=-1", "test_episodes must be greater than or equal to 0, got -1."),
        ("evaluate_every=-5", "evaluate_every must be greater than or equal to 0, got -5."),
        ("late_share=1.1", "late_share must be less than or equal to 1, got 1.1."),
        ("checkpoint_interval=-1", "checkpoint_interval must be greater than or equal to 0"),
        ("checkpoint_interval=inf", "checkpoint_interval must be a finite number, got inf."),
        ("checkpoint_keep=0", "checkpoint_keep must be greater than or equal to 1, got 0."),
        ("task.episodes=0", "task.episodes must be greater than or equal to 1, got 0."),
        ("task.max_steps=-3", "task.max_steps must be greater than or equal to 1, got -3."),
        ("task.noise_scale=-0.1", "task.noise_scale must be greater than or equal to 0, got -0.1."),
        ("task.noise_scale=nan", "task.noise_scale must be a finite number, got nan."),
        ("task=gymnasium", "task.env_id must be given with task=gymnasium, such as Pendulum-v1"),
        ("regularizer.sigma=0", "regularizer.sigma must be greater than 0, got 0."),
        ("regularizer.beta=-1", "regularizer.beta must be greater than or equal to 0, got -1."),
        ("regularizer.lambda_min=low", "regularizer.lambda_min must be a valid number, got 'low'."),
        ("regularizer.num_samples=0", "regularizer.num_samples must be greater than or equal to 1"),
        ("regularizer=caps regularizer.mean=mode", "regularizer.mean must be 'loc' or 'action'"),
        (
            "algorithm=sac algorithm.target_entropy=low",
            "algorithm.target_entropy must be a valid number or 'scaled', got 'low'.",
        ),
        ("algorithm.reward_scale=0", "algorithm.reward_scale must be greater than 0, got 0."),
        ("algorithm.beta=0.9", "algorithm.kappa must be below 0.222222 with beta=0.9, got 0.5."),
        ("algorithm.gamma=1", "algorithm.gamma must be less than 1, got 1."),
        ("algorithm.hidden=100", "algorithm.hidden must be a list, got 100."),
        ("algorithm.hidden=[0]", "algorithm.hidden must be greater than or equal to 1, got 0."),
        ("algorithm.replay_ratio=1 algorithm.updates=1", "replay_ratio and updates both set"),
        ("optimizer=adam optimizer.betas=[0.9,1]", "betas must each be in [0, 1), got [0.9, 1.0]."),
        ("replay.batch_size=0", "replay.batch_size must be greater than or equal to 1, got 0."),
        ("replay.capacity=8", "replay.capacity must be at least the batch_size (32), got 8."),
        ("optimizer.lr=-1", "optimizer.lr must be greater than or equal to 0, got -1."),
        ("algorithm=ppo replay=uniform", "'uniform' does not work with algorithm 'ppo'"),
        ("replay=rollout", "'rollout' does not work with algorithm 'ppo_rpe'"),
    ],
)
def test_a_wrong_setting_gives_its_line(settings_of, line, message):
    """It names the setting, what was given and what is allowed."""
    with pytest.raises(SettingError) as refused:
        settings_of(line)
    assert message in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("task.epsodes=3", "task.epsodes is not a setting; did you mean task.episodes? --help"),
        ("sed=1", "sed is not a setting; did you mean seed? --help lists every setting."),
        ("algorithm.num_envs=4", "algorithm.num_envs is a setting of algorithm=ppo only."),
        (
            "regularizer=lipsnet",
            "Expected regularizer to be one of asap, caps, cats, grad_caps, l2c2,",
        ),
        (
            "task=5",
            "Config group override must be a string or a list. Got int. Each of task, algorithm,",
        ),
        ("~regularizer", "Error resolving interpolation '${regularizer}_${algorithm}'"),
        (
            "hydra/launcher=joblib hydra.launcher.n_jobs=two",
            "hydra.launcher.n_jobs: Value 'two' of type 'str' could not be converted to Integer",
        ),
        ("seed=${oder}", "Interpolation key 'oder' not found full_key: seed"),
        ("seed=[1", "cannot read 'seed=[1'. Put a value with special"),
    ],
)
def test_what_cannot_be_composed_ends_in_a_line(settings_of, monkeypatch, line, told):
    """Of a name that there is not, it says which was meant; never a traceback."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    with pytest.raises(SystemExit) as ended, composition_errors():
        settings_of(line)
    said = str(ended.value)
    assert "HYDRA_FULL_ERROR" not in os.environ
    assert said.startswith(f"error: {told}") and "\n" not in said and "search path" not in said
    assert ("in quotes" in said) is (line == "seed=[1")  # of values that Hydra cannot read


def test_a_folder_that_hydra_cannot_make_ends_in_a_line(tmp_path):
    """Of ``hydra.run.dir``, say."""
    (tmp_path / "file").touch()
    told = r"error: '.*run' cannot be created \(Not a directory\); choose another."
    with pytest.raises(SystemExit, match=told), composition_errors():
        (tmp_path / "file" / "run").mkdir(parents=True)


@pytest.mark.parametrize(
    ("line", "meant"),
    [
        ("regularizer=cap", ", got 'cap'. Did you mean regularizer=caps?"),
        (
            "task=Pendulum-v1",
            "task=pendulum? For a Gymnasium id: task=gymnasium task.env_id=Pendulum-v1.",
        ),
        (
            "sigma=2",
            "sigma is not a setting; did you mean regularizer.sigma? --help lists every setting.",
        ),
        ("outputs=~/runs", "Shells do not expand ~ here: write $HOME."),
        ("+seed=1", "Or add a second + to add or override 'seed': '++seed=1'"),
    ],
)
def test_what_cannot_be_composed_ends_with_what_was_meant(settings_of, line, meant):
    """Of choices, of settings without their group, and of a path."""
    with pytest.raises(SystemExit) as ended, composition_errors():
        settings_of(line)
    assert str(ended.value).endswith(meant)


def test_the_whole_error_is_shown_where_it_is_asked_for(settings_of, monkeypatch):
    """As Hydra has it."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(HydraException, match="Could not override 'sed'"), composition_errors():
        settings_of("sed=1")


@pytest.mark.parametrize("given", ["no", "perhaps", 5])
def test_what_is_no_flag_is_refused(given):
    """Any text would count as true."""
    values = {**dataclasses.asdict(ExperimentConfig()), "outputs": "outputs"}
    values["allow_other_versions"] = given
    with pytest.raises(SettingError, match="allow_other_versions must be true or false, got "):
        read(values, OmegaConf.create({"runtime": {"choices": {}}}))


@pytest.mark.parametrize("given", [None, "", [1], False])
def test_what_is_no_folder_is_refused(given):
    """A number may name one."""
    with pytest.raises(SettingError, match="outputs must be a folder, got "):
        check_outputs(given)
    assert check_outputs(2026) == "2026"


def kinds_of_settings():
    """Every number that is set, with the schema that says its range."""
    for group, choices in {"": {"": ExperimentConfig()}, **GROUPS}.items():
        for name, chosen in choices.items():
            hints = get_type_hints(type(chosen))
            for field in dataclasses.fields(chosen):
                if field.name in describe(type(chosen)):
                    schema = TypeAdapter(Annotated[hints[field.name], field.default]).json_schema()
                    for kind in schema.get("anyOf", [schema]):
                        if kind.get("type") in ("integer", "number"):
                            yield group, name, field.name, kind


NUMBERS = list(kinds_of_settings())


def limits(kind):
    lowest = kind.get("minimum", kind.get("exclusiveMinimum", -math.inf))
    highest = kind.get("maximum", kind.get("exclusiveMaximum", math.inf))
    return lowest, highest


def values(kind, inside):
    """Numbers of a kind, within its range or beyond."""
    lowest, highest = limits(kind)
    open_ends = (kind.get("exclusiveMinimum"), kind.get("exclusiveMaximum"))
    least, most = max(lowest, -1e6), min(highest, 1e6)
    integer = kind["type"] == "integer"
    if inside and integer:
        return st.integers(math.ceil(least), math.floor(most))
    if inside:
        return st.floats(least, most).filter(lambda value: value not in open_ends)
    step = 1 if integer else 1e-3
    beyond = [st.just(end) for end in open_ends if end is not None]
    beyond += [st.just(lowest - step)] if lowest > -math.inf else []
    beyond += [st.just(highest + step)] if highest < math.inf else []
    beyond += [] if integer else [st.sampled_from([math.nan, math.inf])]
    made = st.one_of(*beyond)
    return made.map(int) if integer else made


def settings_with(group, choice, name, value):
    if not group:
        return {name: value}
    # What a group's choice goes with; the rest is as usual.
    rest = {"algorithm": {"name": "ppo"}} if choice == "rollout" else {}
    return {**rest, group: {"name": choice, name: value}}


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_no_number_beyond_its_range_is_taken(data):
    """Just beyond an end, at an open one, not a number, infinite."""
    group, choice, name, kind = data.draw(st.sampled_from(NUMBERS))
    bounded = limits(kind) != (-math.inf, math.inf)
    assume(bounded or kind["type"] == "number")
    value = data.draw(values(kind, inside=False))
    with pytest.raises(SettingError) as refused:
        ExperimentConfig.from_dict(settings_with(group, choice, name, value))
    assert name in str(refused.value) and "\n" not in str(refused.value)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_every_number_within_its_range_is_taken_or_refused_in_a_line(data):
    """Refused where it does not go together with the others."""
    group, choice, name, kind = data.draw(st.sampled_from(NUMBERS))
    value = data.draw(values(kind, inside=True))
    try:
        config = ExperimentConfig.from_dict(settings_with(group, choice, name, value))
    except SettingError as refused:
        assert "\n" not in str(refused)
    else:
        assert getattr(getattr(config, group) if group else config, name) == value


SMALL = {
    "task": {"name": "Pendulum-v1", "env_id": "Pendulum-v1", "episodes": 1, "max_steps": 40},
    "compile": False,
    "late_share": 0.0,
    "algorithm": {"name": "ppo_rpe", "replay_ratio": 2.0},
}
OF_COMPONENTS = [
    (group, choice, name, kind)
    for group, choice, name, kind in NUMBERS
    if (group, choice) in {("algorithm", "ppo_rpe"), ("regularizer", "l2c2"),
                           ("regularizer", "caps"), ("optimizer", "adaterm")}
    # How much there is of it, which takes long and cannot fail.
    and name not in {"updates", "replay_ratio", "num_heads", "num_samples"}
]  # fmt: skip


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
def test_what_is_taken_begins_to_learn_or_is_refused_by_its_component(data):
    """No other error before the first update; numbers that are not finite there are told."""
    group, choice, name, kind = data.draw(st.sampled_from(OF_COMPONENTS))
    value = data.draw(values(kind, inside=True))
    few = SMALL["algorithm"] if choice == "ppo_rpe" else {}
    chosen = SMALL | {group: {**few, "name": choice, name: value}}
    try:
        experiment = Experiment(ExperimentConfig.from_dict(chosen))
    except UserError as refused:
        assert "\n" not in str(refused)
        return
    try:
        experiment.train()
    except FloatingPointError as told:
        assert "update" in str(told)
    else:
        assert experiment.learner.updates > 0
