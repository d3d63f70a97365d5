"""``settings``: every setting with default, range and meaning, for ``--help`` and the docs."""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from torchrl_l2c2.experiment.settings.config import COMMAND_SETTINGS, GROUPS, ExperimentConfig
from torchrl_l2c2.experiment.settings.fields import describe
from torchrl_l2c2.experiment.settings.regularizers import BEGIN_WITH_PRESET, preset_settings
from torchrl_l2c2.presets import KINDS

HEAD = """\
Trains a policy: python train.py task=swingup regularizer=l2c2 seed=1

  group=name          selects, as in task=hopper
  group.setting=value sets, as in regularizer.sigma=2
  -m seed=0,1,2       runs every combination, one after another

"""
ANY_TASK = "gymnasium: any other task, by its task.env_id"
WIDTH, COLUMN = 100, 38


def manual() -> str:
    """The help of the command: every choice, and every setting in one line."""
    lines = [f"{f'  {n}={v[0]}':{COLUMN}}{v[1]}" for n, v in COMMAND_SETTINGS.items()]
    for name, (_, meaning) in describe(ExperimentConfig).items():
        lines.append(_line(name, getattr(ExperimentConfig(), name), meaning))
    for group, choices in GROUPS.items():
        names = [*choices, *(["gymnasium"] if group == "task" else [])]
        choice = f"{group}={' | '.join(names)}"
        lines += ["", textwrap.fill(choice, WIDTH, subsequent_indent=" " * (len(group) + 1))]
        kinds: dict[type, Any] = {}
        for chosen in choices.values():
            kinds.setdefault(type(chosen), chosen)
        having: dict[str, list[Any]] = {}
        for chosen in kinds.values():
            for name in describe(type(chosen)):
                having.setdefault(name, []).append(chosen)
        for name, those in having.items():
            _, meaning = describe(type(those[0]))[name]
            lacking = [kind.name for kind in kinds.values() if kind not in those]
            only = f"not {', '.join(lacking)}" if lacking else ""
            if len(lacking) >= len(those):
                only = ", ".join(each.name for each in those)
            lines.append(_line(f"{group}.{name}", getattr(those[0], name), meaning, only))
    end = "Ranges and full texts: python -m torchrl_l2c2 settings"
    return HEAD + "\n".join([*lines, "", end]) + "\n"


def _line(name: str, default: Any, meaning: str, only: str = "") -> str:
    """A setting in one line, with the choices that have it if not all have."""
    start = f"  {name}={_written(default)} ".ljust(COLUMN)
    note = f" ({only})" if only else ""
    room = max(20, WIDTH - len(start) - len(note))
    return start + textwrap.shorten(meaning, room, placeholder=" ...") + note


def page() -> str:
    """Every setting as a page of the docs."""
    lines = ["# Settings", "", "Made by `python -m torchrl_l2c2 settings`.", ""]
    lines += ["## The command", "", "| setting | default | meaning |", "| --- | --- | --- |"]
    lines += [f"| `{n}` | `{v[0]}` | {v[1]} |" for n, v in COMMAND_SETTINGS.items()]
    lines += ["", "## The run as a whole", "", *_table(ExperimentConfig(), ""), ""]
    for group, choices in GROUPS.items():
        for name, chosen, first in _by_kind(choices):
            lines += [f"## {group}={name}", "", _about(name, chosen, first), ""]
            lines += [*_table(chosen, f"{group}."), ""] if chosen is first else []
        lines += [f"## {group}=gymnasium", "", ANY_TASK, ""] if group == "task" else []
    return "\n".join(lines).rstrip() + "\n"


def _by_kind(choices: Any) -> Iterator[tuple[str, Any, Any]]:
    """Every choice of a group, with the first one that has the same settings."""
    firsts: dict[type, Any] = {}
    for name, chosen in choices.items():
        yield name, chosen, firsts.setdefault(type(chosen), chosen)


def _about(name: str, chosen: Any, first: Any) -> str:
    names = [n for n in describe(type(chosen)) if getattr(chosen, n) != getattr(first, n)]
    differing = _together({name: getattr(chosen, name) for name in names})
    doc = (chosen.__doc__ or "").splitlines()[0]
    begins = {}
    for kind in KINDS if name in BEGIN_WITH_PRESET else ():
        settings = preset_settings(name, kind)
        others = {n: v for n, v in settings.items() if getattr(chosen, n) != v}
        if others:
            begins[kind] = f" (With algorithm={kind}: {_together(others)}.)"
    # The first of its kind begins with a preset; the paper's does not.
    of_first = first.name == "l2c2" and name not in BEGIN_WITH_PRESET
    like = "l2c2_paper" if of_first else first.name
    return (f"{like} with {differing}" if differing else doc) + "".join(begins.values())


def _together(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={_written(value)}" for name, value in values.items())


def _table(group: Any, prefix: str) -> Iterator[str]:
    yield "| setting | default | allowed | meaning |"
    yield "| --- | --- | --- | --- |"
    for name, (allowed, meaning) in describe(type(group)).items():
        default = f"`{_written(getattr(group, name))}`"
        cells = (f"`{prefix}{name}`", default, allowed, meaning)
        yield "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _written(value: Any) -> str:
    """A value as the command line takes it."""
    if isinstance(value, tuple):
        return f"[{','.join(map(_written, value))}]"
    words = {None: "null", True: "true", False: "false"}
    return words[value] if value is None or isinstance(value, bool) else str(value)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the settings as Markdown."""
    argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 settings", description="Prints every setting as Markdown."
    ).parse_args(arguments)
    print(page(), end="")
