"""Pictures of diagnoses, one for each policy, on the same axes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis
from torchrl_l2c2.experiment.analysis.reports.figures import drawn, subplots
from torchrl_l2c2.metrics import amplitude_spectrum

WIDTH = 4.6  # inches, of every picture
ZOOM = 60  # steps in the enlarged picture
MOST_ACTIONS = 4  # drawn actions, which change most
COLORS = ("#1f5fa8", "#c0562b", "#2a7f62", "#8a6d1d")
WORST = "#c2182b"
BINS = 40


def draw_actions(diagnoses: Sequence[Diagnosis]) -> list[bytes]:
    """Mean actions over an episode, and each enlarged where they change most, as SVG."""
    return [
        _draw(1 + len(busiest(one)), 2.5 + 1.1 * len(busiest(one)), _actions, one)
        for one in diagnoses
    ]


def draw_together(diagnoses: Sequence[Diagnosis]) -> bytes:
    """The first episodes' actions, a row for every policy on the same axes; SVG."""
    figure, axes = subplots(1, len(diagnoses), (2 * WIDTH, 0.5 + 1.6 * len(diagnoses)))
    for axis in axes[1:]:
        axis.sharex(axes[0])
        axis.sharey(axes[0])
    for axis, one in zip(axes, diagnoses, strict=True):
        for place, number in enumerate(busiest(one)):
            axis.plot(one.actions[:, number].numpy(), **_line(place, number, one))
        total = "" if one.is_recording else f"return {one.measures['return']:.4g}, "
        title = f"{one.name}: {total}action variation {one.measures['action_variation']:.2g}"
        axis.set_title(title, fontsize=10, parse_math=False)
        axis.set_ylabel("action")
        axis.grid(alpha=0.25)
        if one.actions.shape[1] > 1:  # Policies differ in which actions change most.
            beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
            axis.legend(frameon=False, fontsize=8, **beside)
    axes[-1].set_xlabel(_step(diagnoses))
    return drawn(figure)


def draw_spectra(diagnoses: Sequence[Diagnosis]) -> list[bytes]:
    """Amplitudes of the frequencies of the actions, as shares of their range."""
    spectra = [
        amplitude_spectrum(one.relative[:, busiest(one)], one.rate or 1.0) for one in diagnoses
    ]
    top = max(float(amplitudes[1:].max()) for _, amplitudes in spectra) or 1.0

    return [
        _draw(1, 2.4, _spectrum, one, *each, top)
        for one, each in zip(diagnoses, spectra, strict=True)
    ]


def draw_steepness(diagnoses: Sequence[Diagnosis]) -> list[bytes]:
    """Local Lipschitz constants along the episode and among its states; the steepest are marked."""
    policy = _limits(one.policy_lipschitz for one in diagnoses)
    value = _limits(one.value_lipschitz for one in diagnoses if one.value_lipschitz is not None)

    return [_draw(3, 6.8, _steepness, one, policy, value) for one in diagnoses]


def draw_neighborhoods(diagnoses: Sequence[Diagnosis]) -> list[bytes]:
    """Histograms of the distances of neighbors and of the gain at these distances."""
    return [_draw(2, 3.8, _neighborhood, one) for one in diagnoses]


def draw_shares(diagnoses: Sequence[Diagnosis]) -> list[bytes]:
    """Bars of the share of every term in the loss and in its gradient."""
    return [_draw(1, 0.9 + 0.32 * len(one.shares), _shares, one) for one in diagnoses]


def busiest(one: Diagnosis) -> list[int]:
    """The actions that change most, in their order."""
    change = one.relative.diff(dim=0).abs().mean(0)
    return sorted(change.topk(min(MOST_ACTIONS, len(change))).indices.tolist())


def _actions(axes: Sequence[Any], one: Diagnosis) -> None:
    change = one.relative.diff(dim=0).abs().sum(1)
    sums = change.unfold(0, min(ZOOM, len(change)), 1).sum(1)
    start = int(sums.argmax())
    end = min(start + ZOOM, len(one.actions) - 1)
    # Without common bounds, a joint with a small span would be a flat line next to a large one.
    shown = one.actions if one.bounded else one.relative
    together, *each = axes
    for place, (axis, number) in enumerate(zip(each, busiest(one), strict=True)):
        line = _line(place, number, one)
        together.plot(shown[:, number].numpy(), **line)
        axis.plot(shown[:, number].numpy(), marker=".", **line)
        axis.set_xlim(start, end)
        if len(each) > 1:
            name = one.action_name(number)
            axis.set_title(name, loc="left", fontsize=8, color=line["color"], parse_math=False)
            axis.tick_params(labelbottom=axis is each[-1])
    for axis in axes:
        if one.bounded:
            for bound in {*one.low.tolist(), *one.high.tolist()}:
                axis.axhline(bound, color="black", linewidth=0.6, linestyle=":")
        axis.set_ylim(together.get_ylim())
    together.set_ylabel("action" if one.bounded else "of its span")
    if end - start < len(one.actions) - 1:
        together.axvspan(start, end, color=WORST, alpha=0.12, linewidth=0)
    what = "they change" if len(each) > 1 else "it changes"
    each[-1].set_xlabel(f"{_step([one])}, where {what} most")


def _spectrum(
    axes: Sequence[Any], one: Diagnosis, frequencies: Tensor, amplitudes: Tensor, top: float
) -> None:
    (axis,) = axes
    for place, number in enumerate(busiest(one)):
        heights = amplitudes[1:, place].clamp_min(1e-9).numpy()
        axis.plot(frequencies[1:].numpy(), heights, **_line(place, number, one))
    axis.set_yscale("log")
    axis.set_ylim(top * 1e-4, top * 1.5)
    axis.set_xlabel("cycles per step" if one.rate is None else "hertz")
    axis.set_ylabel("amplitude, of the range")
    if one.actions.shape[1] > 1:
        figure, above = axis.figure, {"loc": "outside upper right", "ncols": 2}
        figure.legend(frameon=False, fontsize=8, **above)
        figure.set_figheight(figure.get_figheight() + 0.5)


def _steepness(
    axes: Sequence[Any], one: Diagnosis, policy: tuple[float, float], value: tuple[float, float]
) -> None:
    over_time, of_value, plane = axes
    _along(over_time, one.policy_lipschitz, one, policy, "policy")
    if one.value_lipschitz is None:
        of_value.text(0.5, 0.5, "no value function", ha="center", transform=of_value.transAxes)
    else:
        _along(of_value, one.value_lipschitz, one, value, "value")
    of_value.set_xlabel(_step([one]))
    _plane(plane, one, policy)


def _along(
    axis: Any, constants: Tensor, one: Diagnosis, limits: tuple[float, float], name: str
) -> None:
    axis.plot(range(len(constants)), constants.numpy(), color=COLORS[0], linewidth=0.7)
    for place, step in enumerate(one.worst(), 1):
        _mark(axis, place, step, float(constants[step]))
    axis.set_yscale("log")
    axis.set_ylim(limits[0] / 2, limits[1] * 3)
    axis.set_ylabel(f"{name}, constant")


def _mark(axis: Any, place: int, x: float, y: float) -> None:
    axis.plot([x], [y], "o", mfc="none", color=WORST, markersize=6)
    near = {"xytext": (5, 4), "textcoords": "offset points"}
    axis.annotate(str(place), (x, y), color=WORST, fontsize=8, **near)


def _plane(axis: Any, one: Diagnosis, limits: tuple[float, float]) -> None:
    """The states of the episode in the plane of their first two principal directions."""
    from matplotlib.colors import LogNorm

    states = one.observations
    spread = states.std(0)
    states = (states - states.mean(0)) / torch.where(spread > 0.0, spread, 1.0)
    directions = torch.linalg.svd(states, full_matrices=False).Vh[:2]
    x, y = (states @ directions.T).T if len(directions) > 1 else (states[:, 0], states[:, 0])
    order = one.policy_lipschitz.nan_to_num().argsort()
    dots = axis.scatter(
        *(x[order].numpy(), y[order].numpy()),
        c=one.policy_lipschitz.nan_to_num(limits[0])[order].clamp_min(limits[0]).numpy(),
        norm=LogNorm(*limits),
        cmap="viridis",
        s=7,
        linewidths=0,
        rasterized=True,
    )
    for place, step in enumerate(one.worst(), 1):
        _mark(axis, place, float(x[step]), float(y[step]))
    axis.set_xlabel("states, first principal direction")
    axis.set_ylabel("second")
    bar = axis.figure.colorbar(
        dots,
        ax=axis,
        label="policy, constant",
        location="bottom",
        aspect=40,
        ticks=[limits[0], math.sqrt(limits[0] * limits[1]), limits[1]],
        format="%.2g",
    )
    bar.minorticks_off()


def _neighborhood(axes: Sequence[Any], one: Diagnosis) -> None:
    near = one.neighborhood
    distance, gain = one.distance[one.distance.isfinite()], one.gain
    axes[0].hist(distance.numpy(), bins=BINS, range=(0.0, near.radius), color=COLORS[0])
    axes[0].set_xlabel("distance max |u|")
    low, high = near.lambda_min, near.lambda_max
    edges = torch.logspace(math.log10(low), math.log10(high), BINS + 1, dtype=torch.float64)
    applied = gain[gain > 0.0].double()  # Beyond max_step there is none.
    axes[1].hist(applied.clamp(edges[0], edges[-1]).numpy(), bins=edges.numpy(), color=COLORS[2])
    axes[1].set_xscale("log")
    for bound in (low, high):
        axes[1].axvline(bound, color="black", linewidth=0.8, linestyle=":")
    axes[1].axvline(gain.mean(), color=WORST, linewidth=1.2)
    axes[1].set_xlabel(f"applied gain between its bounds (dotted); mean {gain.mean():.3g} (red)")
    for axis in axes:
        axis.set_yticks([])


def _shares(axes: Sequence[Any], one: Diagnosis) -> None:
    (axis,), names = axes, list(one.shares)[::-1]
    kinds = (("size", "of the loss's size", COLORS[0]), ("gradient", "gradient", COLORS[1]))
    for kind, label, color in kinds:
        values = [getattr(one.shares[name], kind) for name in names]
        if all(map(math.isnan, values)):
            continue
        height = 0.4 if kind == "size" else -0.4
        axis.barh(names, values, height, align="edge", label=label, color=color)
        for place, value in enumerate(values):
            if not math.isnan(value):
                text = f" {_percent(value)}"
                axis.annotate(text, (value, place + height / 2), va="center", fontsize=8)
    axis.margins(x=0.2)
    axis.set_xlabel("share")
    axis.legend(frameon=False, fontsize=8, loc="best")


def _percent(value: float) -> str:
    """A share with two digits, without an exponent where it is large.

    Examples:
        >>> [_percent(value) for value in (0.0012, 0.123, 0.999, 1.53)]
        ['0.12%', '12%', '100%', '153%']
    """
    return f"{100 * value:.2g}%" if value < 0.995 else f"{100 * value:.0f}%"


def _draw(down: int, height: float, fill: Callable[..., None], *of: Any) -> bytes:
    figure, axes = subplots(1, down, (WIDTH, height))
    for axis in axes:
        axis.grid(alpha=0.25)
    fill(axes, *of)
    return drawn(figure)


def _limits(constants: Iterable[Tensor]) -> tuple[float, float]:
    """The smallest and the largest constant of all policies, without the lower hundredth."""
    known = [each[each.isfinite() & (each > 0.0)] for each in constants]
    together = torch.cat([*known, torch.empty(0)])
    if not len(together):
        return 1.0, 10.0
    low, high = together.quantile(0.01).item(), together.max().item()
    return low, max(high, low * 1.01)


def _line(place: int, number: int, one: Diagnosis) -> dict[str, Any]:
    # Without TeX; matplotlib hides labels that begin with an underscore.
    label = one.action_name(number).replace("$", r"\$")
    label = f"\u200b{label}" if label.startswith("_") else label
    return {"color": COLORS[place], "linewidth": 0.9, "markersize": 3, "label": label}


def _step(diagnoses: Sequence[Diagnosis]) -> str:
    """The label of an axis of steps, with the length of a step if all have the same."""
    rates = {one.rate for one in diagnoses}
    (rate,) = rates if len(rates) == 1 else (None,)
    return "step" if rate is None else f"step of {1 / rate:.3g} s"
