"""Files that are read back, and may be damaged by then: what cannot be read is named."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl_l2c2.experiment.config import GROUPS, NEUTRAL_SETTINGS, REMOVED_SETTINGS
from torchrl_l2c2.experiment.errors import UserError

REMEDY = "it was changed or cut since it was written; restore it."
ANEW = " Or delete it: the command that made the run tests its policy again."


@contextmanager
def read_back(run: str | Path) -> Iterator[None]:
    """What is not as it was written is an error of the folder, whatever it is found by.

    Raises:
        ValueError: names the folder, in the place of errors of what was read in it.
    """
    try:
        yield
    except UserError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        found = f"{type(error).__name__}: {error}"
        raise UserError(f"the run in {str(run)!r} is damaged ({found}): {REMEDY}") from error


def read_json(path: str | Path) -> dict[str, Any]:
    """Reads a JSON object.

    Raises:
        ValueError: names the file, which is no JSON or no object.
    """
    try:
        value = json.loads(_read_text(path))
    except json.JSONDecodeError as error:
        again = ANEW if Path(path).name == "evaluation.json" else ""
        raise UserError(f"{path} is no JSON ({error}): {REMEDY}{again}") from None
    except RecursionError:
        raise UserError(f"{path} has brackets within brackets without end: {REMEDY}") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} must hold an object, {{...}}, got {value!r:.40}: {REMEDY}")
    return value


def read_rows(path: str | Path) -> tuple[list[str], list[dict[str, str]]]:
    """Reads the header of a CSV file, and its lines by the names in it.

    Raises:
        ValueError: names the file, and the line that has fewer or more cells than the header.
    """
    lines = csv.reader(io.StringIO(_read_text(path)))
    rows = []
    try:
        header = next(lines, [])
        for cells in filter(None, lines):
            if len(cells) != len(header):
                many = f"{len(cells)} cells, where the header has {len(header)}"
                raise UserError(f"{path}, line {lines.line_num}: {many}: {REMEDY}")
            rows.append(dict(zip(header, cells, strict=True)))
    except csv.Error as error:
        raise UserError(f"{path}, line {lines.line_num}: {error}: {REMEDY}") from None
    return header, rows


def read_config(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``config.json``, :func:`as it was <as_it_was>`.

    Raises:
        ValueError: as :func:`read_json`; or it does not say what was run, which no default may.
    """
    path = Path(run) / "config.json"
    config = read_json(path)
    for group in ("task", "algorithm", "regularizer"):
        chosen = config.get(group)
        if not isinstance(chosen, dict) or "name" not in chosen:
            raise UserError(f"{path} does not name its {group}: {REMEDY}")
    return as_it_was(config)


def as_it_was(config: Mapping[str, Any]) -> dict[str, Any]:
    """Saved settings, with those that are newer as all runs had them when there was no setting.

    Their defaults may be others by now. Removed settings are left out.

    Args:
        config (Mapping): of ``config.json`` or of a checkpoint, which names its groups' choices.
    """
    whole = {
        k: dict(v) if isinstance(v, Mapping) else v
        for k, v in config.items()
        if k not in REMOVED_SETTINGS
    }
    for setting, value in NEUTRAL_SETTINGS.items():
        group, _, name = setting.rpartition(".")
        values = whole[group] if group else whole
        if not group or _has(group, values["name"], name):
            values.setdefault(name, value)
    return whole


def read_evaluation(run: str | Path) -> dict[str, Any]:
    """Reads a run's ``evaluation.json``.

    Raises:
        ValueError: as :func:`read_json`; or its tests have other than numbers in their summaries.
    """
    path = Path(run) / "evaluation.json"
    evaluation = read_json(path)
    for test in (evaluation, evaluation.get("sampled") or {}):
        summary = test.get("summary", {}) if isinstance(test, dict) else None
        # Of what could not be measured there is null.
        numbers = isinstance(summary, dict) and all(
            value is None or isinstance(value, int | float) for value in summary.values()
        )
        if not numbers:
            raise UserError(f"{path} has no numbers where it must, but {test!r:.40}: {REMEDY}")
    if not isinstance(evaluation.get("training", {}), dict):
        raise UserError(f"{path} must say of training what is known: {REMEDY}")
    return evaluation


def _has(group: str, chosen: Any, setting: str) -> bool:
    settings = GROUPS[group].get(str(chosen))  # None: a name that is not known, refused elsewhere.
    return settings is not None and setting in {f.name for f in dataclasses.fields(settings)}


def _read_text(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{path} is not there, which a run's folder has: restore it."
        ) from None
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text in UTF-8 ({error.reason}): {REMEDY}") from None
