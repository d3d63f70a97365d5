"""Every setting in words, made from where it is declared: for ``--help`` and for the docs.

``python -m torchrl_l2c2.experiment.manual`` prints the page of the docs.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from torchrl_l2c2.experiment.config import GROUPS, ExperimentConfig
from torchrl_l2c2.experiment.regularizers import BEGIN_WITH_PRESET, preset_settings
from torchrl_l2c2.experiment.settings import describe
from torchrl_l2c2.presets import KINDS

HEAD = """\
Trains the paper's experiment: task=swingup regularizer=l2c2, and what else is chosen below.

  group=name          chooses, as in task=hopper
  group.setting=value sets, as in regularizer.sigma=2
  -m seed=0,1,2       runs every combination, one after another
  experiment=name     a whole comparison, with -m; conf/experiment/ holds them
  resume=FOLDER       continues another run here; the same command continues its own
  outputs=FOLDER      holds every run's folder
"""
ANY_TASK = "gymnasium: any other task, by its task.env_id"


def manual(width: int = 100) -> str:
    """The help of the command."""
    lines = [HEAD, "The run as a whole:", *_entries(ExperimentConfig(), "", width)]
    for group, choices in GROUPS.items():
        lines += ["", f"{group}="]
        for name, chosen, first in _by_kind(choices):
            about = f"  {name}: {_about(name, chosen, first)}"
            lines.append(textwrap.fill(about, width, subsequent_indent=" " * 6))
            lines += _entries(chosen, f"{group}.", width) if chosen is first else []
        lines += [f"  {ANY_TASK}"] if group == "task" else []
    return "\n".join(lines) + "\n"


def page() -> str:
    """The same as a page of the docs."""
    lines = ["# Settings", "", "Made by `python -m torchrl_l2c2.experiment.manual`.", ""]
    lines += ["## The run as a whole", "", *_table(ExperimentConfig(), ""), ""]
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


def _entries(group: Any, prefix: str, width: int) -> Iterator[str]:
    for name, (allowed, meaning) in describe(type(group)).items():
        text = meaning + (f" ({allowed})" if allowed else "")
        head = f"    {prefix}{name}={_written(getattr(group, name))}".ljust(38)
        yield textwrap.fill(text, width, initial_indent=f"{head}  ", subsequent_indent=" " * 40)


def _table(group: Any, prefix: str) -> Iterator[str]:
    yield "| setting | default | allowed | what it is |"
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


if __name__ == "__main__":
    print(page(), end="")
