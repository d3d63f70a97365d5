"""The settings: declared once, and what cannot be is refused with what is allowed."""

import dataclasses
import inspect
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from small import composed, ready_to_compose

import torchrl_l2c2
from torchrl_l2c2 import PPORPELoss, make_actor, make_critic
from torchrl_l2c2.experiment import (
    AdamConfig,
    CAPSConfig,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    SACConfig,
    TaskConfig,
)
from torchrl_l2c2.experiment.cli.composition import (
    CONF,
    check_budget,
    check_folders,
    check_preset,
    describe_preset,
    preset_defaults,
)
from torchrl_l2c2.experiment.cli.manual import manual, page
from torchrl_l2c2.experiment.settings.config import GROUPS
from torchrl_l2c2.experiment.settings.fields import SettingError, describe
from torchrl_l2c2.experiment.settings.naming import run_name
from torchrl_l2c2.experiment.settings.regularizers import (
    BEGIN_WITH_PRESET,
    REGULARIZERS,
    preset_settings,
)
from torchrl_l2c2.experiment.settings.tasks import FIELD_TASKS, PAPER_TASKS, TASKS
from torchrl_l2c2.presets import KINDS, preset

ROOT = Path(__file__).parent.parent


def test_the_command_has_the_defaults_of_the_classes():
    """A script without Hydra runs what `python train.py` runs."""
    assert ExperimentConfig.from_dict(composed()) == ExperimentConfig()


# An algorithm brings its replay; of the others, one of each group is chosen at a time.
APART = ("algorithm", "replay")
CHOICES = [((group, name),) for group in APART for name in GROUPS[group]]
CHOICES += zip_longest(*([(g, name) for name in GROUPS[g]] for g in GROUPS if g not in APART))


@pytest.mark.parametrize("chosen", [dict(filter(None, each)) for each in CHOICES], ids=str)
def test_every_choice_is_the_object_of_its_name(chosen):
    """From the command line and from its name alone."""
    # The frames of one rollout are what on-policy learning alone can use.
    extra = ["algorithm=ppo"] if chosen.get("replay") == "rollout" else []
    given = [f"{group}={name}" for group, name in chosen.items()]
    config = ExperimentConfig.from_dict(composed(*given, *extra))
    for group, name in chosen.items():
        assert getattr(config, group) == GROUPS[group][name]
        assert GROUPS[group][name].name == name


@pytest.mark.parametrize("algorithm", GROUPS["algorithm"])
def test_an_algorithm_brings_its_usual_replay_and_optimizer(algorithm):
    """On the command line as in a script."""
    files = ExperimentConfig.from_dict(composed(f"algorithm={algorithm}"))
    assert files == ExperimentConfig(algorithm=GROUPS["algorithm"][algorithm])


@pytest.mark.parametrize("name", REGULARIZERS)
def test_a_partial_group_has_the_defaults_of_its_name(name):
    """What is not given is the choice's, not the class's."""
    read = ExperimentConfig.from_dict({"regularizer": {"name": name}}).regularizer
    assert read == REGULARIZERS[name]


def signature_defaults(component):
    return {
        name: parameter.default
        for name, parameter in inspect.signature(component).parameters.items()
        if parameter.default is not inspect.Parameter.empty
    }


@pytest.mark.parametrize(
    ("settings", "component"),
    [
        (L2C2Config(), torchrl_l2c2.Neighborhood),
        (L2C2Config(), torchrl_l2c2.L2C2Loss.__init__),
        (CAPSConfig(), torchrl_l2c2.CAPSLoss.__init__),
        (PPORPEConfig(), torchrl_l2c2.PPORPELoss),
        (GROUPS["optimizer"]["adaterm"], torchrl_l2c2.AdaTerm),
        (PPORPEConfig(), torchrl_l2c2.make_critic),
    ],
    ids=lambda value: getattr(value, "__qualname__", ""),
)
def test_settings_and_components_have_the_same_defaults(settings, component):
    """The paper's values, whether a component is used alone or by the experiment.

    But for the reduction: a component's is that of TorchRL's losses.
    """
    shared = (signature_defaults(component).keys() & vars(settings).keys()) - {"reduction"}
    assert shared
    assert {n: getattr(settings, n) for n in shared} == {
        n: signature_defaults(component)[n] for n in shared
    }


def test_a_comparison_chooses_the_folder_of_its_runs():
    """A command chooses another one."""
    chosen = ("experiment=filters", "task=pendulum")
    assert composed(*chosen)["outputs"] == "outputs_filters"
    assert composed(*chosen, "outputs=mine")["outputs"] == "mine"


COMPARISONS = sorted({p.stem for p in (CONF / "experiment").glob("*.yaml")} - {"none"})


@pytest.mark.parametrize("name", COMPARISONS)
@pytest.mark.parametrize("regularizer", ["none", "l2c2"])
def test_every_comparison_is_made_of_valid_runs(name, regularizer):
    """With the task and sizes that its file says."""
    # Its sweep chooses the tasks and the algorithms.
    chosen = ["task=pendulum", "algorithm=ppo"] if name.startswith(("field_", "filters")) else []
    config = ExperimentConfig.from_dict(
        composed(f"experiment={name}", f"regularizer={regularizer}", *chosen)
    )
    env_id, algorithm, size = {
        "table3": (TaskConfig().env_id, "ppo_rpe", 32),
        "table3_tau": (TaskConfig().env_id, "ppo_rpe", 32),
        "pendulum": ("Pendulum-v1", "ppo_rpe", 64),
        "field_gains": ("Pendulum-v1", "ppo", 64),
        "field_table": ("Pendulum-v1", "ppo", 64),
        "new_tasks": ("Reacher-v5", "ppo", 64),
        "filters": ("Pendulum-v1", "ppo", 64),
    }[name]
    if algorithm == "ppo_rpe":
        assert config.algorithm.tau == (0.5 if name == "table3_tau" else 0.1)
    assert config.algorithm.name == algorithm and config.replay.batch_size == size
    assert config.regularizer.name == regularizer
    assert config.task.env_id == env_id


# What each sweeps over: the seeds, tasks and methods of a published table.
PAPERS = "none,caps,l2c2,l2c2_policy"
RIVALS = "none,caps,l2c2_paper,l2c2_constant,l2c2_ramp,cats"
SWEEPS = {
    "table3": ("range(0,18)", "swingup,reacher,hopper,ant", PAPERS),
    "table3_tau": ("range(0,18)", "swingup", "l2c2,l2c2_policy"),
    "field_table": ("range(0,10)", "pendulum,lunarlander,hopper_v5,walker2d_v5", RIVALS),
    "field_gains": ("100,101,102", "pendulum,lunarlander", None),
}


@pytest.mark.parametrize("name", SWEEPS)
def test_a_table_is_of_all_its_runs(name):
    """Narrowed by the command line alone."""
    params = OmegaConf.load(CONF / "experiment" / f"{name}.yaml").hydra.sweeper.params
    assert (params.seed, params.task, params.get("regularizer")) == SWEEPS[name]


# Of rl_zoo3 2.9.2 and, where it is silent, of Stable-Baselines3; PPO's n_steps are all
# environments' together here.
PPO_ZOO = {"clip_actions": True, "clip_epsilon": 0.2, "entropy_coeff": 0.0, "critic_coeff": 0.5}
PPO_ZOO |= {"max_grad_norm": 0.5, "log_scale": 0.0, "orthogonal": True, "hidden": (64, 64)}
PPO_ZOO |= {"activation": "tanh", "normalize_observations": False, "normalize_rewards": False}
MUJOCO = {"num_envs": 1, "frames": 512, "normalize_observations": True, "normalize_rewards": True}
SAC_ZOO = {"scale_mapping": "exp", "hidden": (256, 256), "tau": 0.005, "random_frames": 10_000}
# Frames, batches, learning rate, and what is of the algorithm.
ZOO = {
    ("pendulum", "ppo"): (
        (500_000, 64, 1e-3),
        {"num_envs": 4, "frames": 4096, "epochs": 10, "gamma": 0.9, "gae_lambda": 0.95},
    ),
    ("lunarlander", "ppo"): (
        (500_000, 64, 3e-4),
        {"num_envs": 16, "frames": 16384, "epochs": 4, "gamma": 0.999, "gae_lambda": 0.98}
        | {"entropy_coeff": 0.01},
    ),
    ("hopper_v5", "ppo"): (
        (1_000_000, 32, 9.80828e-5),
        MUJOCO
        | {"epochs": 5, "gamma": 0.999, "gae_lambda": 0.99, "entropy_coeff": 0.00229519}
        | {"critic_coeff": 0.835671, "max_grad_norm": 0.7, "log_scale": -2.0, "orthogonal": False}
        | {"hidden": (256, 256), "activation": "relu"},
    ),
    ("walker2d_v5", "ppo"): (
        (1_000_000, 32, 5.05041e-5),
        MUJOCO
        | {"epochs": 20, "gamma": 0.99, "gae_lambda": 0.95, "entropy_coeff": 0.000585045}
        | {"critic_coeff": 0.871923, "max_grad_norm": 1.0, "clip_epsilon": 0.1},
    ),
    ("pendulum", "sac"): ((100_000, 256, 1e-3), {"random_frames": 100}),
    ("lunarlander", "sac"): ((500_000, 256, 7.3e-4), {"hidden": (400, 300), "tau": 0.01}),
    ("hopper_v5", "sac"): ((1_000_000, 256, 3e-4), {}),
    ("walker2d_v5", "sac"): ((1_000_000, 256, 3e-4), {}),
}


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("task", FIELD_TASKS)
def test_a_preset_is_of_a_task_and_an_algorithm(task, algorithm):
    """Whichever way they are chosen."""
    values = composed("preset=rl_zoo", f"task={task}", f"algorithm={algorithm}")
    config = ExperimentConfig.from_dict(values)
    assert values["preset"] == "rl_zoo"
    sizes, own = ZOO[task, algorithm]
    assert (config.task.frames, config.replay.batch_size, config.optimizer.lr) == sizes
    expected = (PPO_ZOO if algorithm == "ppo" else SAC_ZOO | {"gamma": 0.99}) | own
    assert {name: getattr(config.algorithm, name) for name in expected} == expected
    # Adam's epsilon is PPO's there alone; one task's learning rate falls.
    assert config.optimizer.eps == (1e-5 if algorithm == "ppo" else 1e-8)
    assert config.optimizer.linear == ((task, algorithm) == ("lunarlander", "sac"))
    assert (config.task.env_id, config.test_episodes) == (FIELD_TASKS[task].env_id, 10)


def test_what_is_given_beside_a_preset_goes_before():
    """Whatever it has of it."""
    chosen = ["preset=rl_zoo", "task=hopper_v5", "algorithm=ppo", "algorithm.gamma=0.5"]
    assert ExperimentConfig.from_dict(composed(*chosen)).algorithm.gamma == 0.5


def test_baselines_settings_of_hopper_are_those_of_stable_baselines_normalized():
    """PPO's defaults there, which are those of Baselines, with a learning rate that falls."""
    chosen = ["preset=baselines", "task=hopper_v5", "algorithm=ppo"]
    config = ExperimentConfig.from_dict(composed(*chosen))
    expected = PPO_ZOO | MUJOCO | {"frames": 2048, "epochs": 10, "gamma": 0.99, "gae_lambda": 0.95}
    assert {name: getattr(config.algorithm, name) for name in expected} == expected
    assert (config.task.frames, config.replay.batch_size) == (1_000_000, 64)
    adam = config.optimizer
    assert (adam.lr, adam.eps, adam.linear) == (3e-4, 1e-5, True)
    zoo = ExperimentConfig.from_dict(composed("preset=rl_zoo", *chosen[1:]))
    tests = ("test_episodes", "late_share", "checkpoint_interval")
    assert [getattr(config, name) for name in tests] == [getattr(zoo, name) for name in tests]


@pytest.mark.parametrize(("task", "algorithm"), ZOO)
def test_the_fields_table_has_the_zoos_settings_where_these_learn(task, algorithm):
    """And Baselines' where they stand still."""
    chosen = [f"task={task}", f"algorithm={algorithm}"]
    stands = (task, algorithm) == ("hopper_v5", "ppo")
    expected = composed(f"preset={'baselines' if stands else 'rl_zoo'}", *chosen)
    assert composed("experiment=field_table", *chosen) == expected


@pytest.mark.parametrize(
    ("preset", "algorithm", "known"),
    [
        ("rl_zoo", "ppo", "any task with algorithm=sac; task=hopper_v5, .* with algorithm=ppo"),
        ("baselines", "sac", r"any task with algorithm=ppo\. Choose"),
        ("field", "ppo", "task=hopper_v5, lunarlander, .* with algorithm=ppo; task=hopper_v5"),
    ],
)
def test_a_preset_without_settings_of_a_task_is_refused(preset, algorithm, known):
    """And not left at the defaults."""
    with pytest.raises(SettingError, match=f"preset must have settings of task=swingup.*{known}"):
        check_preset(composed(f"preset={preset}", f"algorithm={algorithm}"), preset)


@pytest.mark.parametrize(
    ("preset", "algorithm", "named"),
    [("baselines", "ppo", "hopper_v5"), ("rl_zoo", "sac", "walker2d_v5")],
)
def test_a_general_preset_gives_any_task_the_settings_of_a_named_one(preset, algorithm, named):
    """A MuJoCo-like task of a user's own needs no other settings."""
    chosen = [f"preset={preset}", f"algorithm={algorithm}"]
    values = composed(*chosen, "task=gymnasium", "task.env_id=Reacher-v5")
    check_preset(values, preset)
    own, expected = ExperimentConfig.from_dict(values), composed(*chosen, f"task={named}")
    assert own.task.env_id == "Reacher-v5"
    known = ExperimentConfig.from_dict(expected)
    if algorithm == "sac":  # Walker2d's actions are in [-1, 1].
        own = replace(own, algorithm=replace(own.algorithm, target_entropy=None))
    assert replace(own, task=known.task) == known and own.task.frames == known.task.frames


@pytest.mark.parametrize(
    ("preset", "task", "changed", "named"),
    [
        ("baselines", "gymnasium", ["task.env_id=Reacher-v5"], "Reacher-v5/ppo/l2c2/baselines"),
        ("field", "hopper_v5", [], "hopper_v5/ppo/l2c2/baselines"),
        (
            "rl_zoo",
            "pendulum",
            ["algorithm.gamma=0.8", "optimizer=adaterm", "compile=false", "task.frames=9"],
            "pendulum/ppo/l2c2/rl_zoo_gamma-0.8_optimizer-adaterm_compile-false",
        ),
        ("none", "pendulum", ["regularizer.sigma=2"], "pendulum/ppo/l2c2/sigma-2.0"),
    ],
)
def test_a_folder_has_the_presets_name_and_the_settings_changed_from_it(
    preset, task, changed, named
):
    """Also of a preset that takes another one's settings for the task."""
    choices = {"task": task, "algorithm": "ppo", "regularizer": "l2c2", "preset": preset}
    values = composed(*(f"{group}={name}" for group, name in choices.items()), *changed)
    with ready_to_compose():
        defaults = preset_defaults(values, choices)
    config = ExperimentConfig.from_dict(values)
    assert run_name(config, values["preset"], defaults) == f"{named}/seed_0"


def test_episodes_beside_a_presets_frames_are_refused():
    """They would not be read; frames that are switched off leave them."""
    chosen = ["preset=rl_zoo", "task=pendulum", "algorithm=ppo", "task.episodes=5"]
    config = ExperimentConfig.from_dict(composed(*chosen))
    with pytest.raises(SettingError, match=r"task\.episodes has no effect .*500000: set task\."):
        check_budget(config, chosen)
    for prefix in ("+", "++"):
        with pytest.raises(SettingError, match=r"task\.episodes has no effect"):
            check_budget(config, [*chosen[:-1], f"{prefix}task.episodes=5"])
    check_budget(config, chosen[:-1])
    check_budget(ExperimentConfig.from_dict(composed(*chosen, "task.frames=null")), chosen)


def test_another_simulator_is_no_named_task():
    """It would have the task's length, noise and place in tables."""
    told = r"^task.env_id must be .*Reacher.* with name='reacher', .*task.env_id=Pend"
    with pytest.raises(SettingError, match=told):
        ExperimentConfig.from_dict(composed("task=reacher", "task.env_id=Pendulum-v1"))
    assert ExperimentConfig.from_dict(composed("task=reacher")).task == TASKS["reacher"]
    own = ExperimentConfig.from_dict(composed("task=gymnasium", "task.env_id=Pendulum-v1"))
    assert (own.task.name, own.task.env_id) == ("Pendulum-v1", "Pendulum-v1")


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (
            lambda: TaskConfig("pendulum"),
            r"with name='pendulum': write TASKS\['pendulum'\]\.$",
        ),
        (lambda: TaskConfig(name="ant", episodes=3), r"name='ant': write TASKS\['ant'\]\.$"),
        (lambda: TaskConfig("my_robot"), r"'my_robot': write TaskConfig\('my_robot', ENV_ID\)\.$"),
        (
            lambda: TaskConfig("hopper", "Hopper-v5"),
            "HopperBullet.* name='hopper', got Hopper",
        ),
        (lambda: TaskConfig(env_id="Pendulum-v1"), "Swingup.* with name='swingup', got Pendulum"),
        (lambda: replace(TASKS["ant"], name="reacher"), "Reacher.* name='reacher', got pybullet"),
    ],
)
def test_a_task_in_python_has_the_simulator_of_its_name(make, told):
    """It was Swingup, whatever the name was."""
    with pytest.raises(SettingError, match=rf"^TaskConfig.env_id must be .*{told}"):
        make()


@pytest.mark.parametrize(
    ("method", "setting", "value"),
    [
        ("l2c2", "policy_distance", "kl"),
        ("sr2l", "policy_distance", "kl"),
        ("lcp", "of", "log_prob"),
    ],
)
def test_a_deterministic_policy_is_no_distribution(method, setting, value):
    """So says the configuration, not the loss after seconds; PPO and SAC have distributions."""
    regularizer = replace(REGULARIZERS[method], **{setting: value})
    for name in ("ppo", "sac"):
        ExperimentConfig(algorithm=GROUPS["algorithm"][name], regularizer=regularizer)
    with pytest.raises(SettingError, match=f"regularizer.{setting} must not be {value} with alg"):
        ExperimentConfig(algorithm=GROUPS["algorithm"]["td3"], regularizer=regularizer)


@pytest.mark.parametrize("name", ["ppo", "ppo_rpe"])
def test_a_relative_penalty_needs_action_values(name):
    regularizer = replace(REGULARIZERS["l2c2"], relative=True)
    for by_value in ("sac", "td3"):
        ExperimentConfig(algorithm=GROUPS["algorithm"][by_value], regularizer=regularizer)
    with pytest.raises(SettingError, match=f"relative must be false with algorithm={name}, which"):
        ExperimentConfig(algorithm=GROUPS["algorithm"][name], regularizer=regularizer)


def test_swingup_may_have_another_name():
    """If it is said that it is meant."""
    assert TaskConfig("quiet", TaskConfig().env_id, 0.0).env_id == TaskConfig("swingup").env_id


@pytest.mark.parametrize("name", ["hydra.sweep.dir", "hydra.run.dir"])
def test_hydras_folders_are_none_of_a_sweep(name):
    """Runs would go elsewhere, and older ones there pass for its own."""
    given = {"hydra.sweep.dir": "outputs", "hydra.sweep.subdir": ".", "hydra.run.dir": "."}
    hydra = OmegaConf.create({"hydra": {"sweep": {}, "run": {}}})
    for key, value in given.items():
        OmegaConf.update(hydra, key, value)
    check_folders(hydra.hydra, "outputs")
    OmegaConf.update(hydra, name, "mine")
    with pytest.raises(SettingError, match=f"{name}.*'mine': set outputs=mine"):
        check_folders(hydra.hydra, "outputs")
    if name == "hydra.sweep.dir":
        hydra.hydra.sweep.subdir = "a"  # A folder of each run, which is read.
        check_folders(hydra.hydra, "outputs")


@pytest.mark.parametrize(
    ("name", "algorithm"),
    [*(("l2c2", kind) for kind in KINDS), *((name, "ppo") for name in sorted(BEGIN_WITH_PRESET))],
)
def test_a_regularizer_begins_with_the_preset_of_the_algorithm(name, algorithm):
    """Of the one table; given settings replace its own, and a run says which it has."""
    chosen = [f"algorithm={algorithm}", f"regularizer={name}"]
    config = ExperimentConfig.from_dict(composed(*chosen))
    method, own = BEGIN_WITH_PRESET[name]
    table = preset(method, algorithm)
    for setting, value in {**table.settings, **own}.items():
        assert getattr(config.regularizer, setting) == value
    ramped = own.get("gain", "constant" if table.ramp is None else "ramp") == "ramp"
    assert config.regularizer.ramped == ramped
    told = describe_preset(config)
    assert all(f"{setting}={value}" in told for setting, value in table.settings.items())
    other = "gain" in own and own["gain"] != ("constant" if table.ramp is None else "ramp")
    assert ("except gain)" if other else table.evidence or "not tuned") in told


def test_the_strength_is_set_beside_a_preset():
    """It replaces none of the preset's settings."""
    usual, stronger = (
        ExperimentConfig.from_dict(composed("algorithm=sac", "regularizer=l2c2", *given))
        for given in ([], ["regularizer.strength=0.5"])
    )
    assert stronger.regularizer == dataclasses.replace(usual.regularizer, strength=0.5)
    told = describe_preset(stronger)
    assert "strength=0.5 (the preset for sac except strength)" in told and "results" not in told


def test_l2c2_paper_begins_with_the_papers_settings():
    """With any algorithm."""
    paper = ExperimentConfig.from_dict(composed("algorithm=sac", "regularizer=l2c2_paper"))
    assert dataclasses.replace(paper.regularizer, name="l2c2") == L2C2Config()
    assert describe_preset(paper) is None and preset_settings("l2c2_paper", "sac") == {}


@pytest.mark.parametrize("task", PAPER_TASKS)
def test_the_papers_tasks_have_the_papers_noise(task):
    """Scale .01 for Swingup and Reacher, .001 for Hopper and Ant; none for what is not its own."""
    expected = {"swingup": 0.01, "reacher": 0.01}.get(task, 0.001)
    assert ExperimentConfig.from_dict(composed(f"task={task}")).task.noise_scale == expected
    other = composed("task=gymnasium", "task.env_id=Pendulum-v1")
    assert ExperimentConfig.from_dict(other).task.noise_scale == 0.0


def test_every_setting_says_what_it_is():
    """In a line of the command's help, once, and with its whole text on the page of the docs."""
    text, written = manual(), page()
    assert len(text.splitlines()) <= 150
    for group, choices in {"": {"": ExperimentConfig()}, **GROUPS}.items():
        for chosen in choices.values():
            described = describe(type(chosen))
            groups = {*GROUPS, "name"}
            assert described.keys() == {
                f.name for f in dataclasses.fields(chosen) if f.name not in groups
            }
            for name, (_, meaning) in described.items():
                prefix = f"{group}." if group else ""
                assert text.count(f"\n  {prefix}{name}=") == 1
                assert f"| `{prefix}{name}` |" in written
                assert meaning.replace("|", "\\|") in written
    assert (ROOT / "docs" / "settings.md").read_text() == written, "write it anew"


def test_the_help_has_the_defaults_of_the_usual_choice():
    """And those of the others after their names; a number may stand among words."""
    lines = {line.split("=")[0].strip(): line for line in manual().splitlines() if "=" in line}
    distance = lines["regularizer.policy_distance"]
    assert "=hellinger " in distance and distance.endswith("(sr2l, l2c2; sr2l: jeffreys)")
    assert "=0.001 " in lines["optimizer.lr"] and lines["optimizer.lr"].endswith("(adam: 0.0003)")
    assert describe(SACConfig)["target_entropy"][0] == "scaled | a number"


def test_settings_are_read_without_torch():
    """So that help and errors come at once."""
    code = (
        "import sys, torchrl_l2c2.experiment.cli.train as command; command.register()\n"
        "from torchrl_l2c2.experiment import ExperimentConfig; ExperimentConfig()\n"
        "assert not {'torch', 'torchrl', 'tensordict', 'gymnasium'} & sys.modules.keys()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_settings_survive_a_round_trip():
    """What a run's folder holds can be read back."""
    config = ExperimentConfig(task=TaskConfig(episodes=3), optimizer=AdamConfig(), seed=7)
    assert ExperimentConfig.from_dict(config.to_dict()) == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"task": {"episode": 3}},
            "task.episode is not a setting; choose from action_rate, env_id",
        ),
        ({"task": {"episodes": 0}}, "task.episodes must be greater than or equal to 1, got 0"),
        ({"task": {"noise_scale": -1.0}}, "task.noise_scale must be greater than or equal to 0"),
        ({"regularizer": {"name": "lipsnet"}}, "regularizer.name must be one of .*'l2c2'"),
        ({"regularizer": {"sigma": 2.0}}, "regularizer.name must be one of .*, got None"),
        ({"regularizer": {"name": "l2c2", "over_neighbors": "max"}}, "num_samples must be above 1"),
        ({"regularizer": {"name": "l2c2", "gain": "target"}}, "regularizer.gain_target must be"),
        ({"regularizer": {"name": "caps", "mean": "median"}}, "mean must be 'loc' or 'action'"),
        ({"algorithm": {"name": "ppo_rpe", "schedule": "now"}}, "schedule must be 'episode' or"),
        ({"algorithm": {"name": "sac", "hidden": 100}}, "algorithm.hidden must be a list, got 100"),
        ({"algorithm": {"name": "sac", "hidden": [0]}}, "algorithm.hidden must be greater than"),
        ({"algorithm": {"name": "ppo", "clip_actions": True}}, "clip_actions needs num_envs, got"),
        ({"algorithm": {"name": "ppo", "num_envs": 3}}, "frames must be a multiple of num_envs=3"),
        ({"optimizer": {"name": "adam", "lr": "fast"}}, "optimizer.lr must be a valid number, got"),
        ({"replay": {"name": "uniform", "capacity": 8}}, "replay.capacity must be at least the b"),
        ({"seed": -1}, "seed must be greater than or equal to 0, got -1"),
        ({"compile": 1}, "compile must be a valid boolean, got 1"),
        ({"test_episodes": True}, "test_episodes must be a valid integer, got True"),
        ({"sed": 1}, "sed is not a setting; choose from algorithm"),
        (
            {"regularizer": {"name": "l2c2", "lambda_min": 2.0}},
            r"regularizer\.lambda_max must be above lambda_min .*, here above 2, got 1: increase",
        ),
        (
            {"regularizer": {"name": "l2c2", "sigma": 4.0, "lambda_min": 0.5}},
            r"regularizer\.lambda_max must be above .* sigma \* lambda_min, here above 2, got 1",
        ),
    ],
)
def test_wrong_settings_are_refused_with_what_is_allowed(settings, message):
    """One line names the setting, what was given and what is allowed."""
    with pytest.raises(SettingError, match=message) as refused:
        ExperimentConfig.from_dict(settings)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"regularizer": L2C2Config(name="mine")},
            r"regularizer.name must be one of \['l2c2', .* with L2C2Config, got 'mine'",
        ),
        ({"regularizer": L2C2Config(name="caps")}, r"regularizer.name must .*, got 'caps'"),
        ({"algorithm": SACConfig(name="td3")}, r"one of \['sac'\] with SACConfig, got 'td3'"),
        (
            {"replay": GROUPS["replay"]["rollout"]},
            "'rollout' does not work with algorithm 'ppo_rpe'",
        ),
        (
            {"algorithm": PPOConfig(), "replay": GROUPS["replay"]["uniform"]},
            "'uniform' does not work with algorithm 'ppo'",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused(settings, message):
    """With what would be allowed."""
    with pytest.raises(SettingError, match=message):
        ExperimentConfig(**settings)


@pytest.mark.parametrize("beta", [0.05, 0.3, 0.5, 0.7, 0.95])
def test_kappa_is_refused_where_the_loss_would_refuse_it(beta):
    """Just below its bound both take it, at it neither does."""
    widest = 2 * (1 - beta) / max(beta, 1 - beta)
    networks = make_actor(3, 1), make_critic(3)
    for kappa, taken in ((0.999 * widest, True), (1.001 * widest, False)):
        for make in (PPORPEConfig, partial(PPORPELoss, *networks)):
            with nullcontext() if taken else pytest.raises(ValueError, match="kappa must be"):
                make(kappa=kappa, beta=beta)
