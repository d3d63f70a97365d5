"""Findings about a policy in words: rules and thresholds on the measurements."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis
from torchrl_l2c2.metrics import previous_action_gain, roughness, saturation

STILL = 0.005
FLIPS = -0.5
BANG_BANG = 0.5
EITHER_BOUND = 0.05
ROUGH = 0.2
SMOOTH = 0.02
NOISY = 0.5
WIDE = 0.4
STEEP = 10.0
FAINT = 0.001
CONCENTRATED = 0.3

THRESHOLDS = {
    "STILL": (
        STILL,
        "standard deviation of an action within the episode, of its range, up to which it "
        "stands still",
    ),
    "FLIPS": (
        FLIPS,
        "gain on the action before up to which it flips from step to step; -1 is every step",
    ),
    "BANG_BANG": (
        BANG_BANG,
        "share of an action's steps at its bounds from which it is bang-bang, or pinned",
    ),
    "EITHER_BOUND": (
        EITHER_BOUND,
        "share of them at each of the two bounds from which it is the former",
    ),
    "ROUGH": (
        ROUGH,
        "roughness from which an action moves like noise: white noise has .25, the most is .5",
    ),
    "SMOOTH": (
        SMOOTH,
        "mean change from step to step, of the range, up to which a policy is smooth",
    ),
    "NOISY": (
        NOISY,
        "share of the mean squared change that noise on observations makes alone, from which "
        "that is the reason",
    ),
    "WIDE": (
        WIDE,
        "standard deviation of samples, of half the range, from which a policy is wide; draws "
        "from the whole range have .58",
    ),
    "STEEP": (
        STEEP,
        "largest local Lipschitz constant over the median from which there is a steep spot",
    ),
    "FAINT": (
        FAINT,
        "ratio of gradients, else share of the loss, below which a regularizer's terms are "
        "too small",
    ),
    "CONCENTRATED": (
        CONCENTRATED,
        "share of something within a tenth of the episode from which it is said where",
    ),
}
"""Value and meaning of every threshold."""


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
    if all(_still(diagnosis)):
        told = [_stillness(diagnosis)]
    else:
        told = list(_actions(diagnosis))
        told = [*told, *_steepest(diagnosis)] if told else [_plain(diagnosis)]
        told += _reasons(diagnosis)
    return [*told, *_training(diagnosis)]


def summary(diagnosis: Diagnosis) -> str:
    """The return, the action variation and the findings of a policy, in lines."""
    total, variation = (diagnosis.measures[name] for name in ("return", "action_variation"))
    head = f"{diagnosis.name}: return {total:.4g}, action variation {variation:.3g}"
    return "\n".join([head, *(f"  - {found.text}" for found in findings(diagnosis))])


def comparison(diagnoses: Sequence[Diagnosis]) -> list[str]:
    """Compares each policy with the first one, in a sentence.

    Args:
        diagnoses (sequence of Diagnosis): At least one; policies of other tasks are not compared.
    """
    first, *others = diagnoses
    return [
        _beside(first, other)
        if other.task == first.task
        else f"{other.name} is of another task than {first.name} ({other.task}, {first.task})."
        for other in others
    ]


def _beside(first: Diagnosis, other: Diagnosis) -> str:
    (before, old), (now, new) = (
        (one.measures["action_variation"], one.measures["return"]) for one in (first, other)
    )
    ratio = now / before if before > 0.0 else math.inf if now > 0.0 else 1.0
    if ratio > 2.0:
        change = f"{ratio:.2g} times as much from step to step as"
    else:
        more = "less" if ratio < 1.0 else "more"
        change = f"{abs(ratio - 1):.0%} {more} from step to step than"
    return (
        f"{other.name} changes its action {change} {first.name} ({now:.3g}, {before:.3g}), and its "
        f"return is {'higher' if new > old else 'lower' if new < old else 'the same'} "
        f"({new:.4g}, {old:.4g})."
    )


def _still(diagnosis: Diagnosis) -> list[bool]:
    deviation = diagnosis.relative.std(0)
    return [value <= STILL for value in deviation.tolist()]


def _stillness(diagnosis: Diagnosis) -> Finding:
    at = ", ".join(f"{value:.3g}" for value in diagnosis.actions.mean(0).tolist())
    return Finding(
        "still",
        f"It stands still: every action stays within {STILL:.1%} of its range around ({at}). That "
        "is smooth, but it answers to nothing that it observes.",
    )


def _actions(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Findings about each action dimension that moves."""
    relative, still = diagnosis.relative, _still(diagnosis)
    for number in range(relative.shape[1]):
        if still[number]:
            continue
        action, name = relative[:, number : number + 1], f"action[{number}]"
        if diagnosis.bounded and (found := _at_bounds(name, action)):
            yield found
        gain = previous_action_gain(action).item()
        if gain <= FLIPS:
            yield _flips(name, action, gain, diagnosis.rate)
        elif (rough := roughness(action).item()) >= ROUGH and _change(action) > SMOOTH:
            yield Finding(
                "rough",
                f"{name} moves like noise: its roughness is {rough:.2f} of the control rate, where "
                f"white noise has .25; it changes by {_change(action):.1%} of its range at a step, "
                f"{_where(action.diff(dim=0).abs())}.",
            )


def _at_bounds(name: str, action: Tensor) -> Finding | None:
    share = saturation(action, 0.0, 1.0).item()
    if share < BANG_BANG:
        return None
    ends = [(action <= 0.01).float().mean().item(), (action >= 0.99).float().mean().item()]
    if min(ends) < EITHER_BOUND:
        which = "lower" if ends[0] > ends[1] else "upper"
        return Finding(
            "pinned",
            f"{name} is pinned at its {which} bound in {share:.0%} of the steps: the policy asks "
            "for more than there is.",
        )
    jumps = action.diff(dim=0).abs() > 0.5
    every = f", one in {len(action) / max(1, int(jumps.sum())):.0f} steps" if jumps.any() else ""
    return Finding(
        "bang-bang",
        f"{name} is bang-bang: it is at its bounds in {share:.0%} of the steps and jumps over more "
        f"than half of its range {int(jumps.sum())} times{every}, {_where(jumps.float())}.",
    )


def _flips(name: str, action: Tensor, gain: float, rate: float | None) -> Finding:
    change = action.diff(dim=0)
    back = (change[1:] * change[:-1] < 0).float()
    speed = "half the control rate" if rate is None else f"{rate / 2:.3g} Hz, half the control rate"
    return Finding(
        "flips",
        f"{name} flips from step to step, which is shaking at {speed}: its gain on the action "
        f"before is {gain:.2f} and it turns back at {back.mean():.0%} of the steps, by "
        f"{_change(action):.1%} of its range on average; {_where(back * change[1:].abs())}.",
    )


def _steepest(diagnosis: Diagnosis) -> Iterator[Finding]:
    """The observation at which the policy is steepest."""
    for step in diagnosis.worst(1):
        values = diagnosis.observations[step].tolist()
        seen = [f"{e} = {v:.2g}" for e, v in zip(diagnosis.entries, values, strict=True)]
        constants = diagnosis.policy_lipschitz
        yield Finding(
            "steepest",
            f"It is steepest at step {step}, where it observes {listed(seen)}: its local Lipschitz "
            f"constant is {constants[step]:.3g} there and {constants.nanmedian():.3g} in the "
            "median.",
            fault=False,
        )


def _reasons(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Causes of the movement."""
    shaking = _change(diagnosis.relative) > SMOOTH
    if diagnosis.noise_share >= NOISY and shaking:
        yield Finding(
            "noise",
            f"It is sensitive to noise on what it observes: noise of {diagnosis.noise_scale:.2g} "
            f"moves the action by {diagnosis.noise_action:.2g}, which alone makes "
            f"{min(1.0, diagnosis.noise_share):.0%} of the squared change from step to step.",
        )
    constants = diagnosis.policy_lipschitz
    median, steps = constants.nanmedian().item(), diagnosis.worst(1)
    if shaking and steps and median > 0.0:
        ratio = constants[steps[0]].item() / median
        if ratio >= STEEP:
            yield Finding(
                "steep",
                f"The policy has steep spots: at step {steps[0]} its local Lipschitz constant is "
                f"{constants[steps[0]]:.3g}, {ratio:.0f} times its median of {median:.3g}.",
            )
    if diagnosis.spread >= WIDE:
        yield Finding(
            "wide",
            f"Its samples are wide: their standard deviation is {diagnosis.spread:.2f} of half the "
            "range, where draws from all of it have .58, and more if they crowd at its ends. "
            "However smooth the mean, what acts in training is not, and distances of policies "
            "that are relative to the width are small.",
        )


def _training(diagnosis: Diagnosis) -> Iterator[Finding]:
    """Findings about the regularizer's terms, by their gradients if these are known."""
    for measured, what in (
        ("gradient", "of the gradient of the loss's own terms"),
        ("size", "of the loss, late in training"),
    ):
        added = {
            n: getattr(share, measured) for n, share in diagnosis.shares.items() if share.added
        }
        known = {name: value for name, value in added.items() if not math.isnan(value)}
        faint = {name: value for name, value in known.items() if value < FAINT}
        if faint:
            each = ", ".join(f"{name} {100 * value:.2g}%" for name, value in faint.items())
            every = len(faint) == len(known)
            yield Finding(
                "faint",
                f"{'All' if every else 'Some'} of the regularizer's terms are small: {each} "
                f"{what}. They change little; raise their gains.",
                fault=every,
            )
        if known:
            return


def _plain(diagnosis: Diagnosis) -> Finding:
    change = _change(diagnosis.relative)
    gain = diagnosis.measures["previous_action_gain"]
    numbers = (
        f"the action changes by {change:.1%} of its range at a step, and its gain on the action "
        f"before is {gain:.2f}"
    )
    if change <= SMOOTH:
        return Finding("smooth", f"It is smooth: {numbers}.", fault=False)
    moving = diagnosis.relative.diff(dim=0).abs().mean(1, keepdim=True)
    return Finding(
        "moves",
        f"It moves much, but neither flips, nor jumps between its bounds, nor looks like noise: "
        f"{numbers}; the change is {_where(moving)}.",
        fault=False,
    )


def _change(relative: Tensor) -> float:
    return relative.diff(dim=0).abs().mean().item()


def _where(amount: Tensor) -> str:
    """The tenth of an episode that has most of an amount ``[T, 1]``."""
    length = -(-len(amount) // 10)
    tenths = [part.sum().item() for part in amount.split(length)]
    most = max(range(len(tenths)), key=tenths.__getitem__)
    share = tenths[most] / total if (total := sum(tenths)) else 0.0
    if share < CONCENTRATED or not math.isfinite(share):
        return "throughout the episode"
    start = most * length
    return f"{share:.0%} of it in steps {start} to {min(start + length, len(amount)) - 1}"


def listed(texts: Sequence[str], most: int = 8) -> str:
    """The first of them, with commas.

    Examples:
        >>> listed(["a", "b", "c"], most=2)
        'a, b, ...'
    """
    return ", ".join([*texts[:most], *(["..."] if len(texts) > most else [])])
