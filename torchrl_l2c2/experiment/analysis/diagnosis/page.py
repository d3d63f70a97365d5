"""One page that shows why policies shake, side by side."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

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
from torchrl_l2c2.experiment.analysis.reports.document import inside, picture, whole_page
from torchrl_l2c2.experiment.analysis.reports.measures import MEASURE_NAMES
from torchrl_l2c2.experiment.analysis.reports.tables import Table
from torchrl_l2c2.experiment.run.files import write_atomically

STYLE = """
.side { display: grid; gap: 1rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 17rem), 1fr)); }
.side > * { min-width: 0; margin: 0; } .side img { width: 100%; max-width: 30rem; }
.side h3, figcaption { font-size: .95rem; font-weight: 600; margin: 0 0 .3rem;
  overflow-wrap: anywhere; }
.card { border: 1px solid #ddd; border-radius: 6px; padding: .8rem 1rem; }
.card p { color: #222; margin: .5rem 0 0; padding-left: .7rem; border-left: 3px solid #bbb; }
.card p.fault { border-color: #c2182b; } .card p.smooth { border-color: #2a7f62; }
.glance { display: flex; gap: 1.5rem; font-size: 13px; color: #555; margin-bottom: .6rem; }
.glance b { display: block; font-size: 1.35rem; color: #222; }
.glance div:last-child { flex: 1; }
.bar { display: block; height: .45rem; background: #eee; margin-top: .25rem; }
.bar i { display: block; height: 100%; background: #1f5fa8; }
video { max-width: 100%; } p { max-width: 60rem; }
th { max-width: 11rem; overflow-wrap: break-word; }
body > .wide:last-child td { white-space: normal; }
@media (max-width: 40rem) {
  th, td { padding: .25rem .35rem; } td:first-child { white-space: normal; }
}
"""
FIRST = {"return": "return", "length": "steps", "action_variation": "action variation (the paper)"}


def write_page(path: str | Path, diagnoses: Diagnosis | Sequence[Diagnosis]) -> Path:
    """Writes one page with one or several diagnoses side by side; it needs no other file.

    Args:
        path (str or Path): The HTML file.
        diagnoses (Diagnosis or sequence of them): At least one, with different names.

    Returns:
        Path: The file.

    Raises:
        ValueError: there is no diagnosis.
        OSError: it could not be written.
    """
    diagnoses = [diagnoses] if isinstance(diagnoses, Diagnosis) else diagnoses
    if not diagnoses:
        raise ValueError("a page needs at least one diagnosis.")
    path = Path(path)
    write_atomically(path, page(diagnoses).encode())
    return path


def page(diagnoses: Sequence[Diagnosis]) -> str:
    """The page as text."""

    def section(title: str, text: str, draw: Callable[[Sequence[Diagnosis]], list[bytes]]) -> str:
        return _section(title, text, diagnoses, draw(diagnoses))

    most = max(one.measures["action_variation"] for one in diagnoses)
    scale = most if len(diagnoses) > 1 else None
    parts = [
        "<h1>Why a policy shakes</h1>",
        f"<p>{_EPISODE}</p>",
        _side([_card(one, scale) for one in diagnoses]),
        *(f"<p>{html.escape(text)}</p>" for text in comparison(diagnoses)),
        section("Actions over time", _ACTIONS, draw_actions),
        *_videos(diagnoses),
        _measures(diagnoses).html(),
        section("Spectra of the actions", _SPECTRA, draw_spectra),
        section("Where policy and value are steep", _STEEP, draw_steepness),
        *(_worst(one).html() for one in diagnoses),
        section("Neighbors", _NEIGHBORS, draw_neighborhoods),
        _unmoved(diagnoses).html(),
        *_terms(diagnoses),
        _rules().html(),
    ]
    return whole_page("Why a policy shakes", parts, STYLE)


_EPISODE = (
    "Words and pictures are of the first test episode of each policy with its mean actions; "
    "numbers are means over all. Action variation, the paper's measure, is how much the action "
    "changes from step to step. Red: to mend; green: smooth."
)
_ACTIONS = (
    "Mean actions of one test episode, and the shaded part of it close by: where they change most. "
    "Dotted: the bounds."
)
_SPECTRA = (
    "Amplitudes of the frequencies that these actions are made of, without the constant part. What "
    "is on the right is shaking; the right edge is half the control rate."
)
_STEEP = (
    "Local Lipschitz constants of the mean action and of the value along the episode: the largest "
    "change over its neighbors, per largest change of a coordinate. The worst states of the policy "
    "are numbered. At the bottom the same states in the plane that holds most of them."
)
_NEIGHBORS = (
    "How far from their states the neighbors are that these were measured with, and the gain that "
    "L2C2 applies at this distance, between its bounds."
)
_TERMS = (
    "How much of the loss each of its terms is: its part of the sum of their sizes, late in "
    "training; and the norm of the gradient of a regularizer's term over that of the loss's own "
    "terms, at one training episode of the last policy."
)


def _card(one: Diagnosis, most: float | None) -> str:
    """Its numbers, with a bar for its share of the largest action variation, and its words."""
    variation = one.measures["action_variation"]
    bar = f"<span class=bar><i style='width:{variation / most:.1%}'></i></span>" if most else ""
    glance = (
        f"<div class=glance><div><b>{_number(one.measures['return'])}</b>return</div>"
        f"<div><b>{_number(variation)}</b>action variation{bar}</div></div>"
    )
    told = "".join(
        f"<p class='{'fault' if each.fault else each.kind}'>{html.escape(each.text)}</p>"
        for each in findings(one)
    )
    return f"<div class=card><h3>{html.escape(one.name)}</h3>{glance}{told}</div>"


def _measures(diagnoses: Sequence[Diagnosis]) -> Table:
    names = {**FIRST, **MEASURE_NAMES}
    known = [name for name in names if any(name in one.measures for one in diagnoses)]
    rows = [
        [names[name], *(_number(one.measures.get(name, math.nan)) for one in diagnoses)]
        for name in known
    ]
    noise = "change by noise (of so much)"
    of_change = "... part of the squared change"
    rows += [
        [noise, *(f"{_number(one.noise_action)} ({one.noise_scale:g})" for one in diagnoses)],
        [of_change, *(f"{one.noise_share:.1%}" for one in diagnoses)],
        ["deviation of samples", *(_number(d.spread) for d in diagnoses)],
    ]
    note = (
        "Means over the test episodes with mean actions. The last three rows are of the first of "
        "them: the root mean square change of the action by noise on observations, with the "
        "noise's standard deviation; the part of the mean squared change from step to step that "
        "such noise makes alone; the standard deviation of sampled actions, of half the range. "
        "Smaller is smoother, but for the return, and for the gain on the action before, where 1 "
        "is smooth. Definitions and units: torchrl_l2c2.metrics."
    )
    return Table("Return and smoothness", ["", *(one.name for one in diagnoses)], rows, [note])


def _worst(one: Diagnosis) -> Table:
    value = one.value_lipschitz
    rows = []
    for place, step in enumerate(one.worst(), 1):
        after = min(step + 1, len(one.actions) - 1)
        rows.append(
            [
                *(str(place), str(step), _number(one.policy_lipschitz[step].item())),
                "-" if value is None else _number(value[step].item()),
                _vector(one.actions[step].tolist()),
                _vector(one.actions[after].tolist()),
                _vector(one.observations[step].tolist()),
            ]
        )
    columns = ["", "step", "policy", "value", "action", "next action", "observation"]
    return Table(f"The steepest states: {one.name}", columns, rows)


def _unmoved(diagnoses: Sequence[Diagnosis]) -> Table:
    rows = []
    for one in diagnoses:
        never = [name for name, share in zip(one.entries, one.unmoved, strict=True) if share == 1.0]
        rows.append([one.name, f"{one.unmoved.mean():.1%}", listed(never) or "none"])
    note = (
        "Such coordinates have no neighbors but their own value: nothing that is drawn from the "
        "box of a transition smooths a policy along them."
    )
    columns = ["", "coordinates that do not move in a step", "that never move"]
    return Table("Observations that stand still", columns, rows, [note])


def _terms(diagnoses: Sequence[Diagnosis]) -> list[str]:
    known = [one for one in diagnoses if one.shares]
    return [_section("Terms of the loss", _TERMS, known, draw_shares(known))] if known else []


def _videos(diagnoses: Sequence[Diagnosis]) -> list[str]:
    title = "<h2>Test episodes</h2><p>The beginning of the first one, with its actions.</p>"
    if find_spec("imageio_ffmpeg") is None:
        return [f"{title}<p>No video: imageio-ffmpeg is missing, the extra video brings it.</p>"]
    parts = []
    for rate in dict.fromkeys(one.rate for one in diagnoses if one.pictures):
        shown = [one for one in diagnoses if one.pictures and one.rate == rate]
        source = inside(film(shown), "video/mp4")
        parts.append(
            f'<p><video controls autoplay muted loop playsinline src="{source}"></video></p>'
        )
    without = [one.name for one in diagnoses if not one.pictures]
    if without:
        parts.append(f"<p>Without pictures: {html.escape(', '.join(without))}.</p>")
    return [title, *parts]


def _rules() -> Table:
    rows = [[name, f"{number:g}", meaning] for name, (number, meaning) in THRESHOLDS.items()]
    return Table("The rules of the words", ["threshold", "", "what it is"], rows)


def _section(title: str, text: str, diagnoses: Sequence[Diagnosis], drawn: Sequence[bytes]) -> str:
    figures = [
        f"<figure><figcaption>{html.escape(one.name)}</figcaption>"
        f"{picture(f'{title}: {one.name}', content)}</figure>"
        for one, content in zip(diagnoses, drawn, strict=True)
    ]
    return f"<h2>{html.escape(title)}</h2><p>{html.escape(text)}</p>{_side(figures)}"


def _side(elements: Sequence[str]) -> str:
    return f"<div class=side>{''.join(elements)}</div>"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _vector(values: Sequence[float]) -> str:
    return f"({listed([f'{value:.3g}' for value in values])})"
