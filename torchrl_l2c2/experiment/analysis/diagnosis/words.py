"""Findings about a policy in sentences: rules and thresholds on the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l2c2.experiment.analysis.diagnosis.measured import FEWEST_STEPS, Diagnosis
from torchrl_l2c2.metrics import action_variation, previous_action_gain, roughness, saturation

# Value and meaning; the signals that they were calibrated on are in tests/test_diagnosis.py.
THRESHOLDS = {
    "STILL": (0.005, "largest standard deviation of an action that stands still, of its range"),
    "FLIPS": (-0.5, "largest gain on the previous action of an action that flips; -1: every step"),
    "BANG_BANG": (0.5, "smallest share of steps at the bounds of a bang-bang or pinned action"),
    "EITHER_BOUND": (0.05, "smallest share of steps at each bound of a bang-bang action"),
    "ROUGH": (0.2, "smallest roughness of an action that moves like noise; white noise has 0.25"),
    "CHATTERS": (0.012, "smallest median size of the fast part of an action that chatters"),
    "FAST": (0.25, "lowest frequency of the fast part, of the control rate"),
    "FAST_HERTZ": (8.0, "lowest frequency of the fast part in hertz, if this is lower"),
    "SMOOTH": (0.02, "largest mean change per step of a smooth policy, of the action's range"),
    "NOISY": (
        0.5,
        "smallest squared change by noise on observations, as a share of the whole squared change",
    ),
    "MOSTLY": (0.5, "smallest share of one input in the effect of noise, to be named"),
    "WIDE": (0.4, "smallest standard deviation of wide samples, of half the range; uniform: 0.58"),
    "FOLLOWS": (
        0.5,
        "largest change with a held input, relative to the change as it is, of an action that "
        "follows this input",
    ),
    "STEEP": (10.0, "smallest ratio of the largest to the median local Lipschitz constant"),
    "SMALL": (0.001, "share of the gradient, or else of the loss, below which a term is small"),
    "UNLIKE": (
        2.0,
        "smallest ratio between the action variations of the first episode and the mean",
    ),
    "CONCENTRATED": (0.3, "smallest share of a change in a tenth of the episode that is located"),
}


def threshold(name: str) -> float:
    """The value of a threshold."""
    return THRESHOLDS[name][0]


PARTS = 20  # of an episode in which an action may chatter
PERIODS = 4  # of the slowest of the fast frequencies, at least, in an episode or a part of it
ALTERNATES = 0.45  # lowest frequency of an action that flips at every step, of the control rate
FULL = 2  # findings of one kind that each have a sentence
LISTED_INPUTS = 8  # whose values are listed, in their order; of more, only some
SELECTED_INPUTS = 4  # listed of more inputs: the action follows these most
MOST_NAMES = 12  # of further actions with the same finding
SLOW = 0.1  # lowest frequency of a tone, of the control rate
TONE = 0.03  # half of the width of a tone, of the control rate
SHORT = 10  # steps; over the length, it is added to the half of the power that a tone must have
BESIDE = 0.3  # of the fast part: a slower movement that is smaller is none
TAIL = 1.4  # times the peak's height: a higher spectrum just below it is of a slower movement


@dataclass(frozen=True)
class Finding:
    """A finding about a policy.

    Attributes:
        kind: name of the rule, such as ``"flips"``.
        text: one or two sentences, with the numbers and the place in the episode.
        fault: whether it is a problem.
    """

    kind: str
    text: str
    fault: bool = True


def findings(diagnosis: Diagnosis) -> list[Finding]:
    """Lists the findings, the most important first; never empty.

    Args:
        diagnosis (Diagnosis): Result of :func:`~.measured.diagnose`.
    """
    if (steps := len(diagnosis.actions)) < FEWEST_STEPS:
        text = (
            f"The first episode has {steps} steps, and fewer than {FEWEST_STEPS} do not show how "
            "an action shakes. Choose a longer one, with another seed or a larger max_steps."
        )
        return [Finding("short", text), *_training(diagnosis)]
    unlike = list(_unlike(diagnosis))
    if (diagnosis.relative.std(0) <= threshold("STILL")).all():
        at = ", ".join(f"{value:.3g}" for value in diagnosis.actions.mean(0).tolist())
        text = (
            f"It stands still: every action stays within {threshold('STILL'):.1%} of its range "
            f"around ({at}). This is smooth, but the policy does not react to its observations."
        )
        return [*unlike, Finding("still", text), *_training(diagnosis)]
    found = list(_grouped(_actions(diagnosis)))
    found = [*found, *_steepest(diagnosis)] if found else [_movement(diagnosis)]
    more = (*_reasons(diagnosis), *_training(diagnosis), *_other_units(diagnosis))
    return [*unlike, *found, *more]


def summary(diagnosis: Diagnosis) -> str:
    """The return, the action variation and the findings of a policy, in lines."""
    total = "" if diagnosis.is_recording else f"return {diagnosis.measures['return']:.4g}, "
    variation = diagnosis.measures["action_variation"]
    head = f"{diagnosis.name}: {total}action variation {variation:.3g}"
    return "\n".join([head, *(f"  - {found.text}" for found in findings(diagnosis))])


def comparison(diagnoses: Sequence[Diagnosis]) -> list[str]:
    """Compares each policy with the first one, in a sentence.

    Args:
        diagnoses (sequence of Diagnosis): At least one; policies of other tasks are not compared.
    """
    first, *others = diagnoses
    return [
        _compared(first, other)
        if other.task == first.task or first.is_recording or other.is_recording
        else f"{other.name} is of another task than {first.name} ({other.task}, {first.task})."
        for other in others
    ]


def _compared(first: Diagnosis, other: Diagnosis) -> str:
    if (first.is_recording or other.is_recording) and (reason := _why_incomparable(first, other)):
        return f"{other.name} and {first.name} do not compare: {reason}."
    before, now = (one.measures["action_variation"] for one in (first, other))
    ratio = now / before if before > 0.0 else math.inf if now > 0.0 else 1.0
    if ratio > 2.0:
        change = f"{ratio:.2g} times as much from step to step as"
    else:
        more = "less" if ratio < 1.0 else "more"
        change = f"{abs(ratio - 1):.0%} {more} from step to step than"
    text = f"{other.name} changes its action {change} {first.name} ({now:.3g}, {before:.3g})"
    if first.is_recording or other.is_recording:
        return f"{text}."
    old, new = (one.measures["return"] for one in (first, other))
    return (
        f"{text}, and its return is "
        f"{'higher' if new > old else 'lower' if new < old else 'the same'} ({new:.4g}, {old:.4g})."
    )


def _why_incomparable(first: Diagnosis, other: Diagnosis) -> str:
    """Why changes per step of two recordings, or of a recording and a run, do not compare."""
    ours, theirs = other.actions.shape[1], first.actions.shape[1]
    if ours != theirs:
        return f"they have {ours} and {theirs} actions"
    if first.action_names and other.action_names and first.action_names != other.action_names:
        return "their actions have other names"
    rate, before = other.rate or math.nan, first.rate or math.nan
    if abs(rate - before) > 0.05 * before:
        return f"their steps have {rate:.3g} and {before:.3g} Hz"
    return ""


def _unlike(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Finding about a first episode that is unlike the others, unless all of them are smooth."""
    first, mean = action_variation(diagnosis.actions).item(), diagnosis.measures["action_variation"]
    larger = max(first, mean)
    # The mean change of the larger one, in proportion; unknown if the first episode is still.
    change = _change(diagnosis.relative) * larger / first if first > 0.0 else math.inf
    unlike = min(first, mean) * threshold("UNLIKE") <= larger > 0.0
    if unlike and change > threshold("SMOOTH"):
        text = (
            f"The episodes differ: the first one, which all further findings describe, has an "
            f"action variation of {first:.3g}, and the mean of the episodes is {mean:.3g}. Choose "
            "another first episode with another seed."
        )
        yield Finding("unlike", text, fault=False)


def _other_units(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Finding about actions that count as still because another one has a far larger span."""
    width = diagnosis.high - diagnosis.low
    small = ((width > 0.0) & (width < diagnosis.range)).nonzero()[:, 0].tolist()
    if small and not diagnosis.bounded:
        names = listed([diagnosis.action_name(number) for number in small], MOST_NAMES)
        text = (
            f"Less than a thousandth of the largest span counts as still, as with {names}: if the "
            "units differ, give bounds."
        )
        yield Finding("units", text, fault=False)


def _grouped(found: Iterable[tuple[str, Finding]]) -> Iterator[Finding]:
    """Findings about actions; of a kind with more than ``FULL`` the first, which names the others.

    Args:
        found: name of an action, and a finding about it.
    """
    kinds: dict[str, list[tuple[str, Finding]]] = {}
    for name, finding in found:
        kinds.setdefault(finding.kind, []).append((name, finding))
    for kind, each in kinds.items():
        if len(each) <= FULL:
            yield from (finding for _, finding in each)
            continue
        others = listed([name for name, _ in each[1:]], MOST_NAMES)
        text = f"{each[0][1].text} The same holds for {len(each) - 1} other actions: {others}."
        yield Finding(kind, text)


def _actions(diagnosis: Diagnosis) -> Iterator[tuple[str, Finding]]:
    """Findings about each action that moves or is at a bound, largest changes first, and names."""
    relative = diagnosis.relative
    changes = relative.diff(dim=0).abs().mean(0)
    for number in changes.argsort(descending=True).tolist():
        action = relative[:, number : number + 1]
        name, change = diagnosis.action_name(number), changes[number].item()
        at_bounds = saturation(action, 0.0, 1.0).item() if diagnosis.bounded else 0.0
        if at_bounds >= threshold("BANG_BANG"):
            yield name, _at_bounds(name, action, at_bounds)
        if action.std() <= threshold("STILL"):
            continue
        gain, rough = previous_action_gain(action).item(), roughness(action).item()
        if gain <= threshold("FLIPS"):
            yield name, _flips(name, action, gain, diagnosis.rate)
        elif rough >= threshold("ROUGH") and change > threshold("SMOOTH"):
            if (tone := _tone(action.squeeze(1))) is not None:
                moves = f"oscillates, which is shaking at {_speed(tone, diagnosis.rate)}"
            else:
                moves = (
                    f"moves like noise: its roughness is {rough:.2f} of the control rate (white "
                    "noise has 0.25)"
                )
            text = (
                f"{name} {moves}; it changes by {change:.1%} of its range per step, "
                f"{_where(action.diff(dim=0).abs())}."
            )
            yield name, Finding("rough", text)
        elif at_bounds < threshold("BANG_BANG"):
            chatter = _chatters(name, action.squeeze(1), diagnosis.rate)
            yield from ((name, finding) for finding in chatter)


def _chatters(name: str, action: Tensor, rate: float | None) -> Iterator[Finding]:
    """Finding about fast movement around a slower one, in the whole episode or in a part of it."""
    above = threshold("FAST")
    if rate is not None:
        above = min(above, threshold("FAST_HERTZ") / rate)
    above = max(above, PERIODS / len(action))
    spectrum = torch.fft.rfft(action - action.mean())
    spectrum[: math.ceil(above * len(action))] = 0.0
    fast = torch.fft.irfft(spectrum, len(action))
    length = max(-(-len(action) // PARTS), math.ceil(PERIODS / above))
    last = max(0, len(action) - length)
    starts = [*range(0, last, length), last]
    places = [slice(0, len(action)), *(slice(start, start + length) for start in starts)]
    sizes = [fast[place].abs().median().item() for place in places]
    # The whole episode goes before its parts.
    most = 0 if sizes[0] >= threshold("CHATTERS") else max(range(len(sizes)), key=sizes.__getitem__)
    found = action[places[most]]
    peak = _peak(found, above)
    if sizes[most] < threshold("CHATTERS") or peak is None:
        return
    speed = f"{peak:.2g} of the control rate" if rate is None else f"{peak * rate:.3g} Hz"
    place = places[most]
    size, slow = fast[place].square().mean().sqrt(), (action - fast)[place].std(correction=0)
    does = "chatters around a slower movement" if slow > BESIDE * size else "oscillates"
    text = (
        f"{name} {does}, which is shaking at about {speed}: its fast part moves by {size:.1%} of "
        "its range (root mean square), "
        + (f"in steps {place.start} to {place.stop - 1}." if most else "throughout the episode.")
    )
    yield Finding("chatters", text)


def _peak(action: Tensor, above: float) -> float | None:
    """The strongest of the fast frequencies, in cycles per step.

    ``None`` if it belongs to the tail of a slower movement's spectrum, such as a jump's.
    """
    window = torch.hann_window(len(action), dtype=action.dtype)
    heights = torch.fft.rfft((action - action.mean()) * window).abs()
    first = math.ceil(above * len(action))
    if first >= len(heights):  # The episode is too short for fast frequencies.
        return None
    peak = first + int(heights[first:].argmax())
    slower = heights[peak // 3 : peak - 2]
    if len(slower) and slower.max() > TAIL * heights[peak]:
        return None
    return peak / len(action)


def _at_bounds(name: str, action: Tensor, share: float) -> Finding:
    lower, upper = (action <= 0.01).float().mean(), (action >= 0.99).float().mean()
    if min(lower, upper) < threshold("EITHER_BOUND"):
        which = "lower" if lower > upper else "upper"
        text = (
            f"{name} is pinned at its {which} bound in {share:.0%} of the steps: the policy needs "
            "wider bounds."
        )
        return Finding("pinned", text)
    jumps = action.diff(dim=0).abs() > 0.5
    if not jumps.any():
        text = f"{name} is pinned at its bounds in {share:.0%} of the steps: wider bounds may help."
        return Finding("pinned", text)
    every = round(len(action) / int(jumps.sum()))
    often = "nearly every step" if every == 1 else f"one in {every} steps"
    text = (
        f"{name} is bang-bang: it is at its bounds in {share:.0%} of the steps and jumps over more "
        f"than half of its range {int(jumps.sum())} times, {often}, {_where(jumps.float())}."
    )
    return Finding("bang-bang", text)


def _flips(name: str, action: Tensor, gain: float, rate: float | None) -> Finding:
    change = action.diff(dim=0)
    back = (change[1:] * change[:-1] < 0).float()
    speed, does = 0.5, "flips from step to step"
    # A gain near -0.5 may also be an oscillation of three steps.
    if (tone := _tone(action.squeeze(1))) is not None and tone < ALTERNATES:
        speed, does = tone, "turns back nearly every step"
    text = (
        f"{name} {does}, which is shaking at {_speed(speed, rate)}: its gain on the previous "
        f"action is {gain:.2f}, and it turns back in {back.mean():.0%} of the steps, by "
        f"{_change(action):.1%} of its range on average; {_where(back * change[1:].abs())}."
    )
    return Finding("flips", text)


def _speed(share: float, rate: float | None) -> str:
    """A frequency in cycles per step, in words.

    Examples:
        >>> _speed(0.5, 20.0), _speed(0.31, None)
        ('10 Hz, half the control rate', '0.31 of the control rate')
    """
    of_rate = "half the control rate" if share == 0.5 else f"{share:.2g} of the control rate"
    return of_rate if rate is None else f"{share * rate:.3g} Hz, {of_rate}"


def _tone(action: Tensor) -> float | None:
    """The frequency around which the fast movement has most of its power, in cycles per step.

    ``None`` if there is none. Slower movement does not count: a joint that walks may shake, too.
    The shorter a recording of noise, the more of its power lies by chance around one frequency.
    """
    window = torch.hann_window(len(action), dtype=action.dtype)
    power = torch.fft.rfft((action - action.mean()) * window).abs().square()
    power[: math.ceil(SLOW * len(action))] = 0.0
    bins = torch.arange(len(power))
    near = max(2, round(TONE * len(action)))
    below = torch.cat((power.new_zeros(1), power.cumsum(0)))
    sums = below[(bins + near + 1).clamp_max(len(power))] - below[(bins - near).clamp_min(0)]
    most = int(sums.argmax())
    if sums[most] <= (0.5 + SHORT / len(action)) * below[-1]:
        return None
    around = slice(max(0, most - near), most + near + 1)
    return float((bins[around] * power[around]).sum() / power[around].sum()) / len(action)


def _steepest(diagnosis: Diagnosis) -> Iterator[Finding]:
    """The observation at which the policy is steepest."""
    for step in diagnosis.worst(1):
        values = diagnosis.observations[step].tolist()
        order, most = list(range(len(values))), LISTED_INPUTS
        if len(order) > most and len(diagnosis.held):
            order = diagnosis.held.nan_to_num(1.0).argsort(stable=True).tolist()
            most = SELECTED_INPUTS
        seen = [f"{diagnosis.entries[i]} = {values[i]:.2g}" for i in order]
        constants = diagnosis.policy_lipschitz
        text = (
            f"It is steepest at step {step}, where it observes {listed(seen, most)}: its local "
            f"Lipschitz constant is {constants[step]:.3g} there and {constants.nanmedian():.3g} in "
            "the median."
        )
        yield Finding("steepest", text, fault=False)


def _reasons(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Causes of the movement."""
    shaking = diagnosis.relative.diff(dim=0).abs().mean(0).max() > threshold("SMOOTH")
    if shaking and len(diagnosis.held):
        most = int(diagnosis.held.nan_to_num(1.0).argmin())
        if (change := diagnosis.held[most].item()) <= threshold("FOLLOWS"):
            text = (
                f"Its changes follow one input, {diagnosis.entries[most]}: if this input kept its "
                f"value of the step before, the action would change {1 - change:.0%} less (root "
                "mean square)."
            )
            yield Finding("input", text, fault=False)
    if shaking and diagnosis.noise_share >= threshold("NOISY"):
        scale = diagnosis.noise_scale
        noise = "the given noise" if isinstance(scale, Tensor) else f"noise of {scale:.2g}"
        text = (
            f"It is sensitive to noise on its observations: {noise} moves the action by "
            f"{diagnosis.noise_action:.2g}; squared, this is "
            f"{min(1.0, diagnosis.noise_share):.0%} of the squared change from step to step."
        )
        if len(shares := diagnosis.noise_inputs) > 1 and shares.max() >= threshold("MOSTLY"):
            most = int(shares.argmax())
            text += f" Noise on {diagnosis.entries[most]} has {shares[most]:.0%} of the effect."
        yield Finding("noise", text)
    constants = diagnosis.policy_lipschitz
    median = constants.nanmedian().item()
    for step in diagnosis.worst(1) if shaking and median > 0.0 else []:
        if (ratio := constants[step].item() / median) >= threshold("STEEP"):
            text = (
                f"The policy has steep spots: at step {step} its local Lipschitz constant is "
                f"{constants[step]:.3g}, {ratio:.0f} times its median of {median:.3g}."
            )
            yield Finding("steep", text)
    # Without bounds, the range is only the span of the played actions.
    if diagnosis.bounded and diagnosis.spread >= threshold("WIDE"):
        text = (
            f"Its samples are wide: their standard deviation is {diagnosis.spread:.2f} of half the "
            "range; uniform samples have 0.58. Training explores with large steps even if the mean "
            "is smooth, and distances of policies that are relative to the width are small."
        )
        yield Finding("wide", text)


def _training(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Finding about the regularizer's terms, by their gradients if these are known."""
    for measured, of in (
        ("gradient", "of the gradient of the loss's own terms"),
        ("size", "of the loss, late in training"),
    ):
        shares = {
            name: getattr(share, measured)
            for name, share in diagnosis.shares.items()
            if share.added and not math.isnan(getattr(share, measured))
        }
        small = {name: share for name, share in shares.items() if share < threshold("SMALL")}
        if small:
            every = len(small) == len(shares)
            each = ", ".join(f"{name} {100 * share:.2g}%" for name, share in small.items())
            advice = (
                "They change little; raise their gains."
                if any(small.values())
                else "They change nothing; raise max_step if it leaves out every transition, or "
                "else their gains."
            )
            text = (
                f"{'All' if every else 'Some'} of the regularizer's terms are small: {each} {of}. "
                f"{advice}"
            )
            yield Finding("small", text, fault=every)
        if shares:
            return


def _movement(diagnosis: Diagnosis) -> Finding:
    """Finding about a policy whose actions have no fault."""
    changes = diagnosis.relative.diff(dim=0).abs()
    most = int(changes.mean(0).argmax())
    change = changes[:, most].mean().item()
    gain = previous_action_gain(diagnosis.relative[:, most : most + 1]).item()
    place = "" if diagnosis.is_recording else "in the first episode "
    several = changes.shape[1] > 1
    moves = f"{diagnosis.action_name(most)} changes most," if several else "the action changes"
    size = f"{change:.1%}" if change >= 0.0005 else "less than 0.1%"
    numbers = f"{place}{moves} by {size} of its range per step"
    if change <= threshold("SMOOTH"):
        return Finding("smooth", f"It is smooth: {numbers}.", fault=False)
    numbers += f", and its gain on the previous action is {gain:.2f}"
    where = _where(changes[:, most : most + 1])
    faults = ["flip", "chatter", *(["jump between its bounds"] if diagnosis.bounded else [])]
    text = (
        f"It moves much, but it does not {', '.join(faults)} or move like noise: {numbers}; the "
        f"change is {where}."
    )
    return Finding("moves", text, fault=False)


def _change(relative: Tensor) -> float:
    return relative.diff(dim=0).abs().mean().item()


def _where(amount: Tensor) -> str:
    """The tenth of an episode with the largest part of an amount ``[T, 1]``."""
    length = -(-len(amount) // 10)
    tenths = [part.sum().item() for part in amount.split(length)]
    most = max(range(len(tenths)), key=tenths.__getitem__)
    share = tenths[most] / total if (total := sum(tenths)) else 0.0
    if share < threshold("CONCENTRATED") or not math.isfinite(share):
        return "throughout the episode"
    start = most * length
    return f"{share:.0%} of it in steps {start} to {min(start + length, len(amount)) - 1}"


def listed(texts: Sequence[str], most: int = 8) -> str:
    """The first texts, with commas.

    Examples:
        >>> listed(["a", "b", "c"], most=2)
        'a, b, ...'
    """
    return ", ".join([*texts[:most], *(["..."] if len(texts) > most else [])])
