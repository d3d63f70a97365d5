"""Diagnosis of recorded actions: of a robot, or of a policy in another library."""

from __future__ import annotations

import csv
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded

from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis, bounds_of
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.evaluation import LEAST_STEPS, measure
from torchrl_l2c2.metrics import action_variation

TIME = "time"  # the column of seconds
GAP = 1.5  # times the median time step: a longer one is a gap


def diagnose_actions(
    actions: Tensor,
    *,
    name: str = "recording",
    action_names: Sequence[str] = (),
    bounds: tuple[float, float] | None = None,
    rate: float | None = None,
) -> Diagnosis:
    """Measures how recorded actions shake; why they do, only :func:`~.measured.diagnose` can tell.

    Args:
        actions (Tensor): The actions of one recording without resets, ``[T, A]``, one row for each
            control step, at least 4.

    Keyword Args:
        name (str): name of the recording, for comparisons. Default ``"recording"``.
        action_names (sequence of str): name of each action. Default: ``action[0]`` and so on.
        bounds (tuple of float, optional): lower and upper bound of all actions. Shares in the
            findings are relative to their distance. Default: none; then every action's own span
            takes its place, and no action is said to be at its bounds.
        rate (float, optional): control steps per second, greater than 0, for frequencies in hertz.
            Default: cycles per step.

    Returns:
        Diagnosis: The input of :func:`~.words.findings` and :func:`~.page.write_page`, without
        everything that needs the policy or its observations.

    Raises:
        ValueError: the shape, the bounds, the rate or the number of names is wrong, or an action is
            not finite.

    Examples:
        >>> flips = torch.tensor([[1.0], [-1.0]]).repeat(50, 1)
        >>> found = diagnose_actions(flips, action_names=["knee"], bounds=(-2.0, 2.0), rate=50.0)
        >>> from torchrl_l2c2.experiment import findings
        >>> findings(found)[0].text[:66]
        'knee flips from step to step, which is shaking at 25 Hz, half the '
    """
    if actions.ndim != 2 or len(actions) < LEAST_STEPS or not actions.shape[1]:
        raise UserError(
            f"{name}: actions must have the shape [T, A] with at least {LEAST_STEPS} steps and one "
            f"action, got {list(actions.shape)}."
        )
    if action_names and len(action_names) != actions.shape[1]:
        raise UserError(
            f"{name}: {actions.shape[1]} actions need as many action_names, got "
            f"{len(action_names)}."
        )
    if bounds is not None and not -math.inf < bounds[0] < bounds[1] < math.inf:
        raise UserError(f"bounds must be two finite numbers, the lower one first, got {bounds}.")
    if rate is not None and not 0.0 < rate < math.inf:
        raise UserError(f"rate must be a number of steps per second above 0, got {rate}.")
    actions = actions.detach().float().cpu()
    if not actions.isfinite().all():
        step = int((~actions.isfinite()).any(1).nonzero()[0])
        raise UserError(f"{name}: actions must be finite, got {actions[step].tolist()} at {step}.")
    shape = actions.shape[1:]
    spec: TensorSpec = Unbounded(shape) if bounds is None else Bounded(*bounds, shape)
    low, high, bounded = bounds_of(spec, actions)
    measures = {
        "length": float(len(actions)),
        "action_variation": action_variation(actions).item(),
        **measure(actions, spec),
    }
    return Diagnosis(
        name=name,
        measures=measures,
        actions=actions,
        low=low,
        high=high,
        bounded=bounded,
        action_names=tuple(action_names),
        rate=rate,
    )


def diagnose_recording(
    path: str | Path, *, name: str | None = None, bounds: tuple[float, float] | None = None
) -> Diagnosis:
    """Measures the actions in a CSV file: a column for each action, a row for each control step.

    The first line names the columns. A column ``time``, in seconds, is no action: it gives the
    rate.

    Args:
        path (str or Path): The file.

    Keyword Args:
        name (str, optional): Name of the recording. Default: the file.
        bounds (tuple of float, optional): As for :func:`diagnose_actions`.

    Raises:
        ValueError: the file is no such table; the message names the line.
        OSError: the file cannot be read.
    """
    columns, rows = _read(Path(path))
    table = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(columns))
    rate = None
    if TIME in columns:
        place = columns.index(TIME)
        rate = _rate(table[:, place], str(path))
        others = [number for number in range(len(columns)) if number != place]
        columns, table = [columns[number] for number in others], table[:, others]
    return diagnose_actions(
        table, name=name or str(path), action_names=columns, bounds=bounds, rate=rate
    )


def _read(path: Path) -> tuple[list[str], list[list[float]]]:
    """The names of the columns, and the rows."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = csv.reader(file)
        try:
            columns = [cell.strip() for cell in next(lines, [])]
            _check_names(columns, path)
            rows = []
            for cells in filter(None, lines):
                rows.append([number for cell in cells if (number := _number(cell)) is not None])
                if len(rows[-1]) != len(columns) or len(cells) != len(columns):
                    raise UserError(
                        f"{path}, line {lines.line_num}: expected {len(columns)} numbers, got "
                        f"{cells}."
                    )
        except (csv.Error, UnicodeDecodeError) as error:
            raise UserError(f"{path} is not a CSV file of numbers: {error}.") from error
    return columns, rows


def _check_names(columns: list[str], path: Path) -> None:
    numbers = all(_number(name) is not None for name in columns)
    if numbers or "" in columns or len(set(columns)) < len(columns):
        raise UserError(
            f"{path}, line 1: expected a different name for each action, got {columns}. For "
            "example, np.savetxt(file, actions, delimiter=',', header='hip,knee', comments='') "
            "writes them."
        )


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def _rate(seconds: Tensor, name: str) -> float:
    steps = seconds.diff()
    if not len(steps) or not bool((steps > 0.0).all()):
        raise UserError(f"{name}: the column {TIME!r} must increase, in seconds.")
    median = steps.median()
    gaps = steps > GAP * median
    if gaps.any():
        warnings.warn(
            f"the column {TIME!r} of {name} has gaps ({int(gaps.sum())}, the first after row "
            f"{int(gaps.nonzero()[0]) + 1}): the measures treat all steps as equally long.",
            stacklevel=3,
        )
    return 1.0 / median.item()
