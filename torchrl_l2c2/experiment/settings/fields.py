"""Classes of settings: frozen dataclasses whose fields have a default, a range and a description.

Settings do not import torch, so help and errors appear at once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar, dataclass_transform, get_type_hints

import pydantic.dataclasses
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from torchrl_l2c2.experiment.errors import UserError

Group = TypeVar("Group")

# Metadata of a setting, for ``Field(json_schema_extra=...)``, used by ``settings/identity.py``.
# The setting changes no numbers, or only the length of training: a continued run may change it.
CHANGES_NO_NUMBERS: dict[str, Any] = {"changes_no_numbers": True}


def neutral(value: Any) -> dict[str, Any]:
    """Returns metadata: the value at which a setting does not change a run's numbers."""
    return {"neutral": value}


class SettingError(UserError):
    """A setting that is unknown or outside its range.

    Attributes:
        setting: Name of the setting within its group; empty if several are involved.
        problem: Allowed values and the given value.
    """

    def __init__(self, setting: str, problem: str, group: str = "") -> None:
        self.setting, self.problem = setting, problem
        super().__init__(f"{'.'.join(filter(None, (group, setting)))} {problem}".strip())


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def settings(cls: type[Group]) -> type[Group]:
    """Makes a class of settings: a frozen dataclass that checks types and ranges.

    Args:
        cls (type): Class whose fields are settings.

    Returns:
        type: The dataclass. Creating an object with an unknown setting or a value outside its range
        raises a :class:`SettingError`.

    Examples:
        >>> from pydantic import Field
        >>> @settings
        ... class Targets:
        ...     tau: float = Field(default=0.1, gt=0, le=1, description="rate of the soft update")
        >>> Targets(tau=2.0)
        Traceback (most recent call last):
        torchrl_l2c2.experiment.settings.fields.SettingError: Targets.tau must be less than or equal to 1, got 2.0.
    """  # noqa: E501
    strict = ConfigDict(
        strict=True, extra="forbid", allow_inf_nan=False, arbitrary_types_allowed=True
    )
    made = pydantic.dataclasses.dataclass(frozen=True, config=strict)(cls)
    checked = made.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            checked(self, *args, **values)
        except ValidationError as error:
            raise _first_error(error, made) from None

    made.__init__ = __init__  # type: ignore[method-assign]
    return made  # type: ignore[return-value]


def read(make: Callable[..., Group], values: Mapping[str, Any], prefix: str) -> Group:
    """Creates settings from the plain values of a file or a command line.

    Lists become tuples, and whole floats become integers, as in ``task.frames=1e6``.

    Args:
        make (Callable): Class of settings, or a ``functools.partial`` of ``dataclasses.replace``
            and an object of such a class.
        values (Mapping): Values by name.
        prefix (str): Name of the group in error messages, such as ``"task"``.

    Returns:
        The object that ``make`` returns.

    Raises:
        SettingError: If a name is unknown or a value is outside its range.
    """
    plain = {name: _plain(value) for name, value in values.items()}
    try:
        return make(**plain)
    except SettingError as error:
        raise SettingError(error.setting, error.problem, prefix) from None


def _plain(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_plain, value))
    # If the field is a float, pydantic converts the integer back.
    whole = isinstance(value, float) and value.is_integer() and abs(value) < 2**63
    return int(value) if whole else value


# A cache: help and Hydra's nodes ask many times.
_described: dict[type, dict[str, tuple[str, str]]] = {}


def describe(group: type) -> dict[str, tuple[str, str]]:
    """Returns the allowed values and the description of each setting of a class, by name."""
    if group not in _described:
        types = get_type_hints(group)
        _described[group] = {
            field.name: (_allowed(types[field.name], field.default), meaning)
            for field in dataclasses.fields(group)
            if (meaning := getattr(field.default, "description", None))
        }
    return _described[group]


NUMBERS = ("number", "integer")
_LIMITS = {
    "exclusiveMinimum": "> {}",
    "minimum": ">= {}",
    "exclusiveMaximum": "< {}",
    "maximum": "<= {}",
}


def _allowed(annotation: Any, declared: Any) -> str:
    schema = TypeAdapter(Annotated[annotation, declared]).json_schema()
    kinds = schema.get("anyOf", [schema])
    choices = [str(choice) for kind in kinds for choice in kind.get("enum", _constant(kind))]
    limits = [
        form.format(kind[key]) for kind in kinds for key, form in _LIMITS.items() if key in kind
    ]
    if choices and not limits and any(kind.get("type") in NUMBERS for kind in kinds):
        limits = ["a number"]
    return " | ".join([*choices, *([", ".join(limits)] if limits else [])])


def _constant(kind: dict[str, Any]) -> list[Any]:
    return [kind["const"]] if "const" in kind else []


def _first_error(error: ValidationError, cls: type) -> SettingError:
    """Converts pydantic's first error into one line."""
    errors = error.errors(include_url=False, include_context=True)
    first = errors[0]
    where, given = [str(part) for part in first["loc"]], first["input"]
    name = next((part for part in where if part in {f.name for f in dataclasses.fields(cls)}), "")
    if first["type"] == "value_error":
        cause = first["ctx"]["error"]
        if isinstance(cause, SettingError):
            return SettingError(cause.setting, cause.problem, cls.__name__)
        return SettingError(name, str(cause), cls.__name__)
    if first["type"] == "unexpected_keyword_argument":
        known = ", ".join(sorted(f.name for f in dataclasses.fields(cls)))
        return SettingError(where[0], f"is not a setting; choose from {known}.", cls.__name__)
    if first["type"] == "missing":  # A tuple is too short.
        return SettingError(name, f"must have more entries, got {list(given)}.", cls.__name__)
    # A setting that may be of several types has an error for each.
    same = [each["msg"] for each in errors if each["input"] is given and each["loc"][0] == where[0]]
    allowed = " or ".join(part.removeprefix("Input should be ") for part in dict.fromkeys(same))
    allowed = "must be " + allowed.replace("a valid tuple", "a list")
    return SettingError(name, f"{allowed}, got {given!r}.", cls.__name__)
