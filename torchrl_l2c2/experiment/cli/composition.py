"""Composition of a run's settings by Hydra, from ``conf/`` and the settings' defaults."""

from __future__ import annotations

import dataclasses
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from difflib import get_close_matches
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from omegaconf.errors import ValidationError as OmegaConfValidationError

from torchrl_l2c2.experiment.settings.config import COMMAND_SETTINGS, GROUPS, ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import SettingError, describe
from torchrl_l2c2.experiment.settings.naming import run_name
from torchrl_l2c2.experiment.settings.regularizers import (
    BEGIN_WITH_PRESET,
    REGULARIZERS,
    preset_settings,
)
from torchrl_l2c2.presets import GAIN_SETTING, KINDS, mixed_units, preset

PACKAGE = Path(__file__).parents[2]
# Next to the package in a clone, inside the package if installed.
CONF = next(folder for folder in (PACKAGE / "conf", PACKAGE.parent / "conf") if folder.is_dir())

# Other names that users may type.
ALIASES = {
    "method": ["regularizer"],
    "methods": ["regularizer"],
    "regularizer.method": ["regularizer"],
    "regularizer.ramp": ["regularizer.gain=ramp"],
}


def register() -> None:
    """Registers every choice of every group with Hydra, from the settings' defaults.

    ``conf/`` contains combinations of them.
    """
    store = ConfigStore.instance()
    for group, choices in GROUPS.items():
        for name, chosen in choices.items():
            store.store(group=group, name=name, node=_node(chosen))
    for name, algorithm in product(BEGIN_WITH_PRESET, KINDS):
        node = {"regularizer": preset_settings(name, algorithm)}
        store.store(group="regularizer_preset", name=f"{name}_{algorithm}", node=node)
    unknown = dict.fromkeys(("env_id", "noise_scale", "max_steps", "solved_at"))
    any_task = {"name": "${task.env_id}", **unknown}
    store.store(
        group="task", name="gymnasium", node={**_node(GROUPS["task"]["swingup"]), **any_task}
    )
    config = dataclasses.asdict(ExperimentConfig())
    store.store(name="settings", node={name: config[name] for name in describe(ExperimentConfig)})


def _node(chosen: Any) -> dict[str, Any]:
    values = {k: list(v) if isinstance(v, tuple) else v for k, v in vars(chosen).items()}
    if not hasattr(chosen, "default_replay"):
        return values
    defaults = [
        {"override /replay@_global_.replay": chosen.default_replay},
        {"override /optimizer@_global_.optimizer": chosen.default_optimizer},
    ]
    return {"defaults": [*defaults, "_self_"], **values}


def read(values: dict[str, Any], chosen: Any) -> tuple[ExperimentConfig, Path]:
    """Returns a run's settings and its folder: below ``outputs``, or Hydra's if set.

    Args:
        values (dict): Configuration composed by Hydra.
        chosen (HydraConf): Hydra's own configuration.

    Raises:
        SettingError: If a setting is unknown or outside its range.
    """
    check_preset(values, chosen.runtime.choices.get("preset"))
    values["outputs"] = check_outputs(values["outputs"])
    if not isinstance(allowed := values["allow_other_versions"], bool):
        raise SettingError("allow_other_versions", f"must be true or false, got {allowed!r}.")
    config = ExperimentConfig.from_dict(values)
    check_budget(config, chosen.overrides.task)
    multirun = chosen.mode == RunMode.MULTIRUN
    if multirun:
        check_folders(chosen, values["outputs"])
    folder = chosen.sweep.subdir if multirun else chosen.run.dir
    if folder == ".":
        name = run_name(config, values["preset"], preset_defaults(values, chosen.runtime.choices))
        return config, Path(values["outputs"]) / name
    return config, Path(chosen.runtime.output_dir)


def preset_defaults(
    values: Mapping[str, Any], choices: Mapping[str, Any]
) -> ExperimentConfig | None:
    """Returns the settings of the preset without other overrides; ``None`` without a preset.

    Args:
        values (Mapping): Configuration composed by Hydra.
        choices (Mapping): Chosen name by group.
    """
    if values["preset"] is None:
        return None
    names = ("task", "algorithm", "regularizer", "preset")
    composed = deepcopy(_compose(*(f"{name}={choices[name]}" for name in names)))
    if choices["task"] == "gymnasium":
        composed.task.env_id = values["task"]["env_id"]
    plain: Any = OmegaConf.to_container(composed, resolve=True)
    return ExperimentConfig.from_dict(plain)


@cache
def _compose(*overrides: str) -> DictConfig:
    return compose("config", [*overrides])


def check_preset(values: dict[str, Any], name: str | None) -> None:
    """Checks that a preset has settings of the task and the algorithm.

    Args:
        values (dict): Configuration composed by Hydra.
        name (str, optional): Name of the preset.

    Raises:
        SettingError: If it has none; states the preset's tasks and algorithms.
    """
    if values.get("preset") != "???":  # A preset replaces this mark.
        return
    folder, prefix = CONF / "preset", f"{name}_"
    general = (path.stem.removeprefix(prefix) for path in folder.glob(f"general/{prefix}*.yaml"))
    known = [f"any task with algorithm={each}" for each in sorted(general)]
    stems = [path.stem.rpartition("_") for path in (folder / str(name)).glob("*.yaml")]
    for each in sorted({stem[-1] for stem in stems}):
        tasks = sorted(task for task, _, algorithm in stems if algorithm == each)
        known.append(f"task={', '.join(tasks)} with algorithm={each}")
    task, algorithm = values["task"]["name"], values["algorithm"]["name"]
    raise SettingError(
        "preset",
        f"must have settings of task={task} with algorithm={algorithm}; {name} has settings of "
        f"{'; '.join(known)}. Choose one of these, or preset=none.",
    )


def check_budget(config: ExperimentConfig, given: Sequence[str]) -> None:
    """Checks that the command line sets no episodes if a preset sets frames.

    Args:
        config (ExperimentConfig): Settings of the run.
        given (sequence of str): Overrides on the command line.

    Raises:
        SettingError: If ``task.episodes`` would be ignored.
    """
    episodes = any(each.lstrip("+").startswith("task.episodes=") for each in given)
    if episodes and config.task.frames is not None:
        raise SettingError(
            "task.episodes",
            f"has no effect with task.frames={config.task.frames}: set task.frames=... instead, or "
            "add task.frames=null.",
        )


def is_length_given(given: Sequence[str]) -> bool:
    """Checks whether overrides name the length of training."""
    return any(each.lstrip("+").startswith(("task.episodes=", "task.frames=")) for each in given)


def check_folders(chosen: Any, outputs: str) -> None:
    """Checks that a sweep sets no run folders by Hydra's settings, which sweeps ignore.

    Args:
        chosen (HydraConf): Hydra's configuration.
        outputs (str): Folder of the sweep's runs.

    Raises:
        SettingError: If such a setting is changed.
    """
    whole = chosen.sweep.subdir == "." and chosen.sweep.dir != outputs
    for name, given in {
        "hydra.sweep.dir": chosen.sweep.dir if whole else None,
        "hydra.run.dir": None if chosen.run.dir == "." else chosen.run.dir,
    }.items():
        if given is not None:
            raise SettingError(
                name, f"does not set the folder of a sweep, got {given!r}: set outputs={given}."
            )


@contextmanager
def composition_errors() -> Iterator[None]:
    """Shows errors of Hydra's composition in one line and exits.

    With the environment variable ``HYDRA_FULL_ERROR``, Hydra shows a traceback instead.

    Raises:
        SystemExit: With the error's line.
    """
    shown = "HYDRA_FULL_ERROR" in os.environ
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    try:
        yield
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        if shown:
            raise
        sys.exit(f"error: {one_line_message(error)}")
    except OSError as error:  # Hydra cannot create the run's folder.
        if shown or error.filename is None:
            raise
        sys.exit(f"error: {error.filename!r} cannot be created ({error.strerror}); choose another.")
    finally:
        if not shown:
            os.environ.pop("HYDRA_FULL_ERROR", None)


def one_line_message(error: Exception) -> str:
    """Returns an error of Hydra or OmegaConf as one line, with a suggestion.

    It uses the attributes of the errors, not their messages.
    """
    cause = error.__cause__
    if isinstance(error, ConfigCompositionException) and isinstance(cause, OmegaConfBaseException):
        if isinstance(cause, OmegaConfValidationError):
            return f"{cause.full_key}: {' '.join(str(cause.msg).split())}."
        if cause.full_key:
            return unknown_setting(cause.full_key)
    if isinstance(error, MissingConfigException) and error.options and error.missing_cfg_file:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return _unknown_choice(group, name, error.options)
    if isinstance(error, OverrideParseException):
        home = " Shells do not expand ~ here: write $HOME." if "=~" in error.override else ""
        return (
            f"cannot read {error.override!r}. Put a value with special characters in quotes within "
            f"quotes: 'name=\"a b\"'.{home}"
        )
    message = " ".join(str(error).split())
    named = any(word in message for word in ("group", *GROUPS))
    if named and isinstance(error, (ValueError, ConfigCompositionException)):
        message += (
            f". Each of {', '.join(GROUPS)} takes one name (regularizer=none for none); -m runs "
            "several."
        )
    return message


def _unknown_choice(group: str, name: str, choices: Sequence[str]) -> str:
    """Returns a message about a choice that a group does not have, with a similar name."""
    near = get_close_matches(name, choices, 1)
    suggestion = f" Did you mean {group}={near[0]}?" if near else ""
    gymnasium = f" For a Gymnasium id: task=gymnasium task.env_id={name}."
    return (
        f"Expected {group} to be one of {', '.join(choices)}, got {name!r}.{suggestion}"
        f"{gymnasium if group == 'task' else ''}"
    )


def unknown_setting(name: str) -> str:
    """Returns a message about an unknown setting: the choices that have it, or a similar name.

    Examples:
        >>> unknown_setting("task.epsodes")
        'task.epsodes is not a setting; did you mean task.episodes? --help lists every setting.'
        >>> unknown_setting("algorithm.num_envs")
        'algorithm.num_envs is a setting of algorithm=ppo only.'
        >>> unknown_setting("algorithm.lr")
        'algorithm.lr is not a setting; did you mean optimizer.lr? --help lists every setting.'
        >>> unknown_setting("sigma")
        'sigma is not a setting; did you mean regularizer.sigma? --help lists every setting.'
        >>> unknown_setting("methods")
        'methods is not a setting; did you mean regularizer? --help lists every setting.'
        >>> unknown_setting("regularizer.ramp").partition("; ")[2]
        'did you mean regularizer.gain=ramp? --help lists every setting.'
    """
    group, _, setting = name.partition(".")
    settings = {
        (each, choice): {field.name for field in dataclasses.fields(of)}
        for each, choices in GROUPS.items()
        for choice, of in choices.items()
    }
    if having := [of[1] for of, names in settings.items() if of[0] == group and setting in names]:
        chosen = f"{group}={' or '.join(having)}"
        return f"{name} is a setting of {chosen} only.{_suggest_two_commands(group, having)}"
    known = {*COMMAND_SETTINGS, *(field.name for field in dataclasses.fields(ExperimentConfig))}
    known |= {f"{of[0]}.{each}" for of, names in settings.items() for each in names}
    near = sorted(each for each in known if each.endswith(f".{setting or name}"))
    near = near or ALIASES.get(name) or get_close_matches(name, sorted(known), 1, cutoff=0.7)
    suggestion = f"; did you mean {near[0]}?" if near else "."
    return f"{name} is not a setting{suggestion} --help lists every setting."


def _suggest_two_commands(group: str, having: Sequence[str]) -> str:
    """Returns advice for sweeps over choices of which only some have the setting."""
    prefix = f"{group}="
    swept = next((each for each in sys.argv if each.startswith(prefix) and "," in each), "")
    choices = swept.removeprefix(prefix).split(",") if swept else []
    lacking = [choice for choice in choices if choice not in having]
    if not lacking or len(lacking) == len(choices):
        return ""
    others = ",".join(choice for choice in choices if choice in having)
    return (
        f" Run two commands: {prefix}{','.join(lacking)} without the setting, and {prefix}{others} "
        "with it."
    )


def check_outputs(given: Any) -> str:
    """Returns the folder of ``outputs`` as text; its name may be a number.

    Args:
        given: Value of the setting.

    Raises:
        SettingError: If the value is not the name of a folder.
    """
    named = str(given) if type(given) in (int, float) else given
    if not isinstance(named, str) or not named:
        raise SettingError("outputs", f"must be a folder, got {given!r}.")
    return named


def describe_preset(config: ExperimentConfig) -> str | None:
    """Describes the regularizer's preset in one line; ``None`` if it uses no presets.

    Another line warns of a gain that probably does not suit ``relative``.
    """
    regularizer, algorithm = config.regularizer, config.algorithm.name
    if regularizer.name not in BEGIN_WITH_PRESET:
        return None
    method, _ = BEGIN_WITH_PRESET[regularizer.name]
    initial, source = preset_settings(method, algorithm), preset(method, algorithm)
    usual = REGULARIZERS[method]
    expected = {name: getattr(usual, name) for name in describe(type(usual))} | initial
    changed = [name for name in expected if getattr(regularizer, name) != expected[name]]
    shown = dict.fromkeys([*initial, *changed])
    chosen = ", ".join(f"{name}={getattr(regularizer, name)}" for name in shown)
    origin = f": {source.evidence}, on {source.tasks}" if source.evidence else ", not tuned"
    note = f" except {', '.join(changed)}" if changed else origin
    line = f"regularizer={regularizer.name}: {chosen} (the preset for {algorithm}{note})"
    gain, relative = (getattr(regularizer, name) for name in (GAIN_SETTING[method], "relative"))
    mixed = mixed_units(method, source, gain, relative)
    if mixed is None:
        return line
    name = f"regularizer.{GAIN_SETTING[method]}"
    given = f"regularizer.relative={str(relative).lower()}"
    return f"{line}\nwarning: {mixed}, and {given}: set {name}, too, unless this is meant."


def show_sweep_hint() -> None:
    """Prints a hint if the configuration describes a comparison, but only one run is trained."""
    chosen = HydraConfig.get()
    if chosen.sweeper.params:
        sweeps = " ".join(f"{name}={value}" for name, value in chosen.sweeper.params.items())
        print(f"one run of the comparison {sweeps}: add -m for all runs", flush=True)
