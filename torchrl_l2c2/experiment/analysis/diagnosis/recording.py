"""Diagnosis of recorded actions: of a robot, or of a policy in another library."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded

from torchrl_l2c2.experiment.analysis.diagnosis.measured import (
    FEWEST_STEPS,
    Diagnosis,
    bounds_of,
    check_names,
)
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.evaluation import measure
from torchrl_l2c2.metrics import action_variation

TIME = "time"  # the column of seconds
LIKELY = (1e-5, 1.0)  # seconds from one step to the next
GAP = 2.5  # times the median time step: a longer one is a gap
LOST = 1.75  # times the median time step: from here on, a step may have lost a row
Bounds = tuple[float, float]
BEYOND = 0.5  # share of an action that may lie beyond its bounds, where a task would clip it
EVEN = 0.9  # share of the actions that are repeated equally often, if a logger repeats them
REPEATED = 1.3  # how often a logger that is faster than the policy repeats an action, at least


def diagnose_actions(
    actions: Tensor,
    *,
    name: str = "recording",
    action_names: Sequence[str] = (),
    bounds: Bounds | Sequence[Bounds] | None = None,
    rate: float | None = None,
) -> Diagnosis:
    """Measures how recorded actions shake; why they do, only :func:`~.measured.diagnose` can tell.

    A logger that is faster than the policy repeats every action. Repetitions are then left out,
    with a warning.

    Args:
        actions (Tensor): The actions of one recording without resets, ``[T, A]``, one row for each
            control step, at least 20.

    Keyword Args:
        name (str): name of the recording, for comparisons. Default ``"recording"``.
        action_names (sequence of str): name of each action. Default: ``action[0]`` and so on.
        bounds (tuple of float, or sequence of them, optional): lower and upper bound of all
            actions, or of each action. Shares in the findings are relative to their distance.
            Default: none; then every action's own span takes its place, and no action is said to be
            at its bounds.
        rate (float, optional): rows per second, greater than 0, for frequencies in hertz. Default:
            shares of the control rate.

    Returns:
        Diagnosis: The input of :func:`~.words.findings` and :func:`~.page.write_page`, without
        everything that needs the policy or its observations.

    Raises:
        ValueError: the shape, the bounds, the rate or the number of names is wrong, an action is
            not finite, or most of an action lies beyond the bounds.

    Examples:
        >>> flips = torch.tensor([[1.0], [-1.0]]).repeat(50, 1)
        >>> found = diagnose_actions(flips, action_names=["knee"], bounds=(-2.0, 2.0), rate=50.0)
        >>> from torchrl_l2c2.experiment import findings
        >>> findings(found)[0].text[:66]
        'knee flips from step to step, which is shaking at 25 Hz, half the '
    """
    if actions.ndim != 2 or len(actions) < FEWEST_STEPS or not actions.shape[1]:
        raise UserError(
            f"{name}: actions must have the shape [T, A] with at least {FEWEST_STEPS} steps and "
            f"one action, got {list(actions.shape)}."
        )
    check_names("action_names", action_names, actions.shape[1], "actions")
    spec = _spec(actions.shape[1], bounds)
    if rate is not None and not 0.0 < rate < math.inf:
        raise UserError(f"rate must be a number of steps per second above 0, got {rate}.")
    actions = actions.detach().float().cpu()
    if not actions.isfinite().all():
        row = int((~actions.isfinite()).any(1).nonzero()[0])
        raise UserError(
            f"{name}: actions must be finite, got {actions[row].tolist()} in row {row}: leave such "
            "rows out."
        )
    actions, repeated = _without_repetitions(actions)
    if repeated > 1:
        rate = rate and rate / repeated
        warnings.warn(
            f"{name} has every action {repeated:.3g} times, as of a logger that is faster than the "
            "policy: every action is kept once.",
            stacklevel=2,
        )
    low, high, bounded = bounds_of(spec, actions)
    found = Diagnosis(
        name=name,
        measures={
            "length": float(len(actions)),
            "action_variation": action_variation(actions).item(),
            **measure(actions, spec),
        },
        actions=actions,
        low=low,
        high=high,
        bounded=bounded,
        action_names=tuple(action_names),
        rate=rate,
    )
    if bounded:
        _check_bounds(found)
    return found


def diagnose_recording(
    path: str | Path,
    *,
    name: str | None = None,
    columns: Sequence[str] | None = None,
    bounds: Bounds | Sequence[Bounds] | None = None,
) -> Diagnosis:
    """Measures the actions in a CSV file: a column for each action, a row for each control step.

    The first line names the columns, which are separated by commas, semicolons or tabs. A column
    ``time``, in seconds, is no action: it gives the rate.

    Args:
        path (str or Path): The file.

    Keyword Args:
        name (str, optional): Name of the recording. Default: the file.
        columns (sequence of str, optional): The columns that are actions. Default: all but
            ``time``.
        bounds (tuple of float, or sequence of them, optional): As for :func:`diagnose_actions`.

    Raises:
        ValueError: the file is no such table; the message names the line.
        OSError: the file cannot be read.
    """
    path = Path(path)
    header, lines = _read(path)
    chosen = [each for each in header if each != TIME] if columns is None else list(columns)
    if missing := [each for each in chosen if each not in header]:
        raise UserError(f"{path} has no column {missing[0]!r}: choose from {', '.join(header)}.")
    if double := [each for each in chosen if chosen.count(each) > 1]:
        raise UserError(f"the column {double[0]!r} was chosen twice: name it once.")
    actions = {each: _numbers(path, header.index(each), each, lines) for each in chosen}
    for each, values in actions.items():
        if columns is None and len(values) >= FEWEST_STEPS and (values.diff() > 0.0).all():
            raise UserError(
                f"{path}: {each!r} increases in every row, which no action does. If it is the time "
                f"in seconds, name it {TIME!r}; otherwise leave it out, or name the actions with "
                "--columns."
            )
    rate = None
    if TIME in header:
        rate = _rate(_numbers(path, header.index(TIME), TIME, lines), path, lines)
    table = torch.stack(list(actions.values()), 1) if actions else torch.empty(len(lines), 0)
    return diagnose_actions(
        table, name=name or str(path), action_names=chosen, bounds=bounds, rate=rate
    )


def _without_repetitions(actions: Tensor) -> tuple[Tensor, float]:
    """Actions of which each is kept once if all are repeated about equally often, and how often."""
    starts = torch.cat(
        (torch.zeros(1, dtype=torch.long), (actions.diff(dim=0) != 0).any(1).nonzero()[:, 0] + 1)
    )
    lengths = torch.cat((starts, torch.tensor([len(actions)]))).diff()
    often = lengths.median().item()
    tolerance, most_held = often / 10, math.inf
    if len(actions[starts].unique(dim=0)) > len(starts) / 2:
        # Most actions differ, so equal rows in succession come from the logger. Its rate may be no
        # multiple of the policy's.
        often = lengths[lengths <= 2 * often].float().mean().item()
        # Some runs of lost packets are long.
        tolerance, most_held = max(often / 4, 1.0), 1
    # An action may be held for several steps, and a step may take a row more or less.
    held = (lengths / often).round().clamp_min(1)
    even = ((lengths - held * often).abs() <= tolerance) & (held <= most_held)
    if often < REPEATED or len(starts) < FEWEST_STEPS or even.float().mean() < EVEN:
        return actions, 1.0
    return actions[starts].repeat_interleave(held.long(), 0), often


def _spec(actions: int, bounds: Bounds | Sequence[Bounds] | None) -> TensorSpec:
    """The space of this many actions."""
    if bounds is None:
        return Unbounded((actions,))
    pairs: Any = [bounds] if isinstance(bounds[0], Real) else bounds
    pairs = pairs * actions if len(pairs) == 1 else pairs
    if len(pairs) != actions:
        raise UserError(
            f"bounds must be one pair for all actions, or a pair for each of the {actions}, got "
            f"{len(pairs)} pairs."
        )
    for pair in pairs:
        if not -math.inf < pair[0] < pair[1] < math.inf:
            raise UserError(
                f"bounds must be two finite numbers, the lower one first, got {tuple(pair)}."
            )
    low, high = torch.tensor(pairs, dtype=torch.float32).T
    return Bounded(low, high, (actions,))


def _check_bounds(found: Diagnosis) -> None:
    relative = found.relative
    beyond = ((relative < 0.0) | (relative > 1.0)).float().mean(0)
    most = int(beyond.argmax())
    if beyond[most] > BEYOND:
        raise UserError(
            f"{found.name}: {beyond[most]:.0%} of {found.action_name(most)} lies beyond the bounds "
            f"{found.low[most]:g} and {found.high[most]:g}, as {found.actions[:, most].max():g}: "
            "give bounds in the actions' units."
        )


def _read(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """The names of the columns, and the number and the cells of each line with content."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        try:
            first = file.readline()
            separator = max(",;\t", key=first.count)
            (header,) = csv.reader([first], delimiter=separator)
            names = [cell.strip().lstrip("# ") for cell in header]
            _check_columns(names, path)
            rest = csv.reader(file, delimiter=separator)
            lines = [(rest.line_num + 1, cells) for cells in rest if cells]
        except (csv.Error, UnicodeDecodeError) as error:
            raise UserError(f"{path} is not a CSV file of numbers: {error}.") from error
    for number, cells in lines:
        if len(cells) != len(names):
            raise UserError(
                f"{path}, line {number}: expected {len(names)} cells as in the first line, got "
                f"{len(cells)}."
            )
    return names, lines


def _check_columns(names: list[str], path: Path) -> None:
    if not any(names) or all(_number(name) is not None for name in names):
        raise UserError(
            f"{path}, line 1: expected the names of the columns, got {names[:4]}. For example, "
            "np.savetxt(file, actions, delimiter=',', header='hip,knee', comments='') writes them."
        )
    if "" in names:
        raise UserError(
            f"{path}, line 1: column {names.index('') + 1} has no name. If it is the index of a "
            "DataFrame, write the file with to_csv(file, index=False)."
        )
    if double := [name for name in names if names.count(name) > 1]:
        raise UserError(f"{path}, line 1: several columns are named {double[0]!r}: rename them.")


def _numbers(path: Path, place: int, name: str, lines: Sequence[tuple[int, list[str]]]) -> Tensor:
    """The numbers of a column."""
    values = []
    for number, cells in lines:
        value = _number(cells[place])
        if value is None or not math.isfinite(value):
            raise UserError(
                f"{path}, line {number}: {name!r} must be a finite number, got {cells[place]!r}: "
                f"{_remedy(cells[place])}."
            )
        values.append(value)
    return torch.tensor(values, dtype=torch.float64)


def _remedy(cell: str) -> str:
    """Names the remedy for a cell that is no number."""
    if "," in cell and _number(cell.replace(",", ".")) is not None:
        return "write a decimal point instead of the comma"
    if len(cell.split()) > 1 and all(_number(part) is not None for part in cell.split()):
        return "separate the columns by commas, semicolons or tabs"
    return "leave such lines out, or choose other columns with --columns"


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _rate(seconds: Tensor, path: Path, lines: Sequence[tuple[int, list[str]]]) -> float | None:
    """Rows per second."""
    steps = seconds.diff()
    if not len(steps):
        return None
    if (back := (steps <= 0.0).nonzero()).numel():
        raise UserError(
            f"{path}, line {lines[int(back[0]) + 1][0]}: the column {TIME!r} must increase from "
            "line to line. If an episode begins here, write a file for each episode."
        )
    median = steps.median().item()
    if not LIKELY[0] <= median <= LIKELY[1]:
        raise UserError(
            f"{path}: the column {TIME!r} must be in seconds, got steps of {median:g}: divide it, "
            "by 1e3 if it has milliseconds, by 1e9 if it has nanoseconds."
        )
    if (steps == 1.0).all():
        warnings.warn(
            f"the column {TIME!r} of {path} has steps of 1 s: if it counts the steps, multiply it "
            "by the seconds of a step, or leave it out. Frequencies are wrong otherwise.",
            stacklevel=3,
        )
    gaps = (steps > GAP * median).nonzero()[:, 0]
    if len(gaps):
        warnings.warn(
            f"the column {TIME!r} of {path} has gaps ({len(gaps)}, the first before line "
            f"{lines[int(gaps[0]) + 1][0]}, the longest of {steps.max():.3g} s): the measures "
            "treat all steps as equally long.",
            stacklevel=3,
        )
    # Rounded times have steps of two lengths, and the median is one of them.
    return 1.0 / steps[steps < LOST * median].mean().item()
