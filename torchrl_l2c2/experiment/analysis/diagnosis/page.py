"""The page of diagnoses: findings, pictures and a film of policies side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

from torch import Tensor

from torchrl_l2c2.experiment.analysis.diagnosis.film import film
from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis
from torchrl_l2c2.experiment.analysis.diagnosis.pictures import (
    draw_actions,
    draw_neighborhoods,
    draw_shares,
    draw_spectra,
    draw_steepness,
)
from torchrl_l2c2.experiment.analysis.diagnosis.words import (
    THRESHOLDS,
    comparison,
    findings,
    listed,
)
from torchrl_l2c2.experiment.analysis.document import data_uri, render
from torchrl_l2c2.experiment.analysis.reports.table import Table
from torchrl_l2c2.experiment.run.files import write_atomically

SHOWN_INPUTS = 5
# The measures in the order of their table, and their names.
MEASURES = {
    "return": "return",
    "length": "steps",
    "action_variation": "action variation (the paper)",
    "action_rate": "action rate",
    "action_fluctuation_ratio": "AFR",
    "action_jerk": "jerk",
    "roughness": "roughness",
    "sm_caps": "Sm (CAPS)",
    "sm_asap": "Sm (ASAP)",
    "previous_action_gain": "gain on the action before",
    "saturation": "at the bounds",
    "noise_sensitivity": "sensitivity to noise",
}


def write_page(path: str | Path, diagnoses: Diagnosis | Sequence[Diagnosis]) -> Path:
    """Writes one page with one or several diagnoses side by side; it needs no other file.

    Args:
        path (str or Path): The HTML file.
        diagnoses (Diagnosis or sequence of them): At least one, with different names.

    Returns:
        Path: The file.

    Raises:
        ValueError: there is no diagnosis.
        OSError: the file cannot be written.
    """
    diagnoses = [diagnoses] if isinstance(diagnoses, Diagnosis) else diagnoses
    if not diagnoses:
        raise ValueError("Expected at least one diagnosis, got none. Pass results of diagnose().")
    path = Path(path)
    write_atomically(path, page(diagnoses).encode())
    return path


def page(diagnoses: Sequence[Diagnosis]) -> str:
    """Returns the page as text."""
    drawings = {
        "actions": draw_actions,
        "spectra": draw_spectra,
        "steepness": draw_steepness,
        "neighborhoods": draw_neighborhoods,
        "shares": draw_shares,
    }
    played = [one for one in diagnoses if not one.is_recording]
    shares = [one for one in played if one.shares]
    # Recorded actions have the first two.
    of = {"steepness": played, "neighborhoods": played, "shares": shares}
    pictures = {}
    for kind, draw in drawings.items():
        shown = of.get(kind, diagnoses)
        drawn = zip(shown, draw(shown), strict=True)
        pictures[kind] = {one.name: data_uri(content) for one, content in drawn}
    films = None
    if find_spec("imageio_ffmpeg") is not None:
        filmed = [one for one in diagnoses if one.pictures]
        rates = dict.fromkeys(one.rate for one in filmed)
        together = ([one for one in filmed if one.rate == rate] for rate in rates)
        films = [data_uri(film(each), "video/mp4") for each in together]
    return render(
        "diagnosis.html",
        title="Why a policy shakes",
        diagnoses=diagnoses,
        number=_number,
        findings=findings,
        comparison=comparison(diagnoses),
        largest=max(one.measures["action_variation"] for one in diagnoses),
        pictures=pictures,
        films=films,
        played=played,
        without_pictures=[one.name for one in played if films is not None and not one.pictures],
        measures=_measures(diagnoses),
        steepest_states=[_steepest(one) for one in played],
        inputs=_inputs(played),
        unmoved=_unmoved(played),
        rules=_rules(),
    )


def _measures(diagnoses: Sequence[Diagnosis]) -> Table:
    rows = [
        [name, *(_number(one.measures.get(measure, math.nan)) for one in diagnoses)]
        for measure, name in MEASURES.items()
        if any(measure in one.measures for one in diagnoses)
    ]
    rows.append(["largest change in one step", *map(_largest_change, diagnoses)])
    note = (
        "Smaller is smoother, except for the return and the gain on the action before, where 1 is "
        "smooth. Definitions and units: torchrl_l2c2.metrics."
    )
    if not all(one.is_recording for one in diagnoses):
        of_policy = [
            ("-", "-", "-")
            if one.is_recording
            else (
                f"{_number(one.noise_action)} ({_noise(one.noise_scale)})",
                f"{one.noise_share:.1%}",
                _number(one.spread),
            )
            for one in diagnoses
        ]
        names = (
            "change by noise (standard deviation)",
            "... part of the squared change",
            "deviation of samples",
        )
        rows += [list(row) for row in zip(names, *of_policy, strict=True)]
        note += (
            " Means over the test episodes with mean actions. The last four rows: the first "
            "episode. Change by noise: root mean square change of the action by noise on "
            "observations with this standard deviation, and its square as a part of the mean "
            "squared change per step. Deviation of samples: in units of half the action's range."
        )
    return Table("Measures", ["", *(one.name for one in diagnoses)], rows, [note])


def _noise(scale: float | Tensor) -> str:
    return "of each input" if isinstance(scale, Tensor) else f"{scale:g}"


def _largest_change(one: Diagnosis) -> str:
    change = one.actions.diff(dim=0).abs()
    step, number = divmod(int(change.argmax()), change.shape[1])
    return f"{_number(change.max().item())} ({one.action_name(number)}, step {step + 1})"


def _steepest(one: Diagnosis) -> Table:
    value, rows = one.value_lipschitz, []
    for place, step in enumerate(one.worst(), 1):
        after = min(step + 1, len(one.actions) - 1)
        numbers = [one.policy_lipschitz[step].item()]
        numbers.append(math.nan if value is None else value[step].item())
        vectors = (one.actions[step], one.actions[after], one.observations[step])
        texts = [listed([f"{each:.3g}" for each in vector.tolist()]) for vector in vectors]
        rows.append([str(place), str(step), *map(_number, numbers), *(f"({t})" for t in texts)])
    columns = ["", "step", "policy", "value", "action", "next action", "observation"]
    return Table(f"The steepest states: {one.name}", columns, rows)


def _inputs(diagnoses: Sequence[Diagnosis]) -> list[Table]:
    follows = _ranked(
        "Inputs that the action follows",
        "How much less the action would change from step to step (root mean square) if one input "
        "kept its value of the step before; the inputs with the largest effect. If the action "
        "shakes, look here for a sensor with noise, and for the previous action.",
        diagnoses,
        lambda one: 1.0 - one.held,
    )
    noise = _ranked(
        "Inputs that pass on noise",
        "Shares of the inputs in the squared change of the action by noise, if only this "
        "input has noise.",
        diagnoses,
        lambda one: one.noise_inputs,
    )
    return [table for table in (follows, noise) if table.rows]


def _ranked(
    title: str,
    note: str,
    diagnoses: Sequence[Diagnosis],
    measure: Callable[[Diagnosis], Tensor],
) -> Table:
    """The inputs with the largest values of each policy."""
    columns = []
    for one in diagnoses:
        values = measure(one)
        known = values.isfinite().all()
        order = values.argsort(descending=True).tolist()[:SHOWN_INPUTS] if known else []
        cells = [f"{one.entries[i]}: {values[i].item():.0%}" for i in order]
        columns.append([*cells, *["-"] * (SHOWN_INPUTS - len(cells))])
    rows = [[str(place), *cells] for place, cells in enumerate(zip(*columns, strict=True), 1)]
    rows = [row for row in rows if set(row[1:]) != {"-"}]
    return Table(title, ["", *(one.name for one in diagnoses)], rows, [note])


def _unmoved(diagnoses: Sequence[Diagnosis]) -> Table:
    rows = []
    for one in diagnoses:
        never = [name for name, share in zip(one.entries, one.unmoved, strict=True) if share == 1.0]
        rows.append([one.name, f"{one.unmoved.mean():.1%}", listed(never) or "none"])
    note = (
        "All neighbors have the same value of such a coordinate, so a regularizer with the box of "
        "a transition does not smooth the policy along it."
    )
    columns = ["", "coordinates that do not move in a step", "coordinates that never move"]
    return Table("Observations that stand still", columns, rows, [note])


def _rules() -> Table:
    rows = [[name, f"{number:g}", meaning] for name, (number, meaning) in THRESHOLDS.items()]
    return Table("The rules of the findings", ["threshold", "", "meaning"], rows)


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
