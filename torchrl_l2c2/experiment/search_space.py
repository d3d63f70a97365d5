"""What is searched: settings in Hydra's grammar, checked before they are proposed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Glob, IntervalSweep, Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf

from torchrl_l2c2.experiment.composition import CONF, refusal, register
from torchrl_l2c2.experiment.config import ExperimentConfig
from torchrl_l2c2.experiment.errors import UserError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

DIGITS = 6
# Of an interval; no whole number where others are proposed.
WITHIN = 0.5**0.5


def read_space(overrides: Sequence[str]) -> tuple[dict[str, BaseDistribution], list[str]]:
    """What is searched, as Optuna has it, and what is not.

    Raises:
        ValueError: what Hydra cannot read, or a range that cannot be.
    """
    from optuna.distributions import CategoricalDistribution

    space: dict[str, BaseDistribution] = {}
    fixed = []
    for override in _parsed(overrides):
        name, value = override.get_key_element(), override.value()
        if isinstance(value, IntervalSweep):
            space[name] = _interval(override)
        elif isinstance(value, ChoiceSweep) and not value.simple_form:
            space[name] = CategoricalDistribution(_choices(override))
        else:
            assert override.input_line is not None
            fixed.append(override.input_line)
    return space, fixed


def check_settings(overrides: Sequence[str]) -> None:
    """Refuses what no run could begin with, so that no trial is spent on it.

    Tried are a value within every interval, as its ends may be open; all choices; and the first
    value of a sweep.

    Raises:
        ValueError: a name that there is not, or a value that cannot be; says which.
    """
    register()
    # A glob stands for names that there are.
    tryable = [each for each in _parsed(overrides) if not isinstance(each.value(), Glob)]
    own = [each.get_key_element() for each in tryable]
    if given := sorted({"outputs", "resume"}.intersection(own)):
        raise UserError(f"{given[0]} is the trials' own, below --output: leave it out.")
    parsed = [each for each in tryable if not each.is_hydra_override()]
    choices = [len(_tried(override)) for override in parsed]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for number in range(max(choices, default=1)):
            tried = [found[number % len(found)] for found in map(_tried, parsed)]
            try:
                values: Any = OmegaConf.to_container(compose("config", tried), resolve=True)
            except HydraException as error:
                raise UserError(refusal(error)) from error
            ExperimentConfig.from_dict(values)


def _tried(override: Override) -> list[str]:
    """Assignments that have a run begin in the place of a searched setting or a sweep."""
    name, value = override.get_key_element(), override.value()
    if isinstance(value, IntervalSweep):
        assert value.start is not None and value.end is not None
        within = value.start + WITHIN * (value.end - value.start)
        return [f"{name}={int(within) if isinstance(value.start, int) else short(within)}"]
    if not override.is_sweep_override():
        return [f"{override.input_line}"]
    choices = [f"{name}={choice}" for choice in _choices(override)]
    return choices if isinstance(value, ChoiceSweep) and not value.simple_form else choices[:1]


def _parsed(overrides: Sequence[str]) -> list[Override]:
    try:
        return OverridesParser.create().parse_overrides([*overrides])
    except OverrideParseException as error:
        raise UserError(
            f"{error.override!r} cannot be read: settings are NAME=VALUE in Hydra's grammar, such "
            "as regularizer.beta=interval(0,1)."
        ) from error


def _interval(override: Override) -> BaseDistribution:
    from optuna.distributions import FloatDistribution, IntDistribution

    sweep: Any = override.value()
    start, end, log = sweep.start, sweep.end, "log" in sweep.tags
    if not (start <= end and math.isfinite(start) and math.isfinite(end)):
        raise UserError(
            f"{override.input_line!r}: an interval goes from a finite number to one that is not "
            f"smaller, got {start:g} to {end:g}."
        )
    if log and start <= 0:
        raise UserError(
            f"{override.input_line!r}: a logarithmic scale begins above 0, got {start:g}."
        )
    kind = IntDistribution if isinstance(start, int) else FloatDistribution
    return kind(start, end, log=log)


def _choices(override: Override) -> list[str]:
    return [str(choice) for choice in override.sweep_string_iterator()]


def short(value: Any) -> Any:
    """Names of folders have it in them; more digits change nothing that a search could find."""
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
