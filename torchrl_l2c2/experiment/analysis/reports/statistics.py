"""Statistics of few runs: pure functions of (runs x tasks) matrices of scores.

As proposed by Agarwal et al., *Deep Reinforcement Learning at the Edge of the Statistical
Precipice*, NeurIPS 2021, arXiv:2108.13264. Their package ``rliable`` (1.2.0) cannot be imported
with pandas 3, so its definitions are repeated here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Scores = NDArray[np.float64]
Interval = tuple[float, float]

RESAMPLES_AT_ONCE = 50


def mean(scores: Scores) -> Scores:
    """Mean over runs and tasks: ``[..., runs, tasks]`` to ``[...]``."""
    return np.asarray(scores.mean((-2, -1)))


def interquartile_mean(scores: Scores) -> Scores:
    """Mean of the middle half of all scores: outliers count less than in a mean.

    Of ``n`` scores the ``floor(n / 4)`` smallest and largest are left out; fewer than four are
    all kept.

    Args:
        scores (array): ``[..., runs, tasks]``; scores of several tasks need one scale.

    Returns:
        Array of shape ``[...]``.

    Examples:
        >>> interquartile_mean(np.array([[0.0], [1.0], [2.0], [3.0], [100.0]])).item()
        2.0
    """
    ordered = np.sort(scores.reshape(*scores.shape[:-2], -1), -1)
    count = ordered.shape[-1]
    cut = count // 4
    return np.asarray(ordered[..., cut : count - cut].mean(-1))


def probability_of_improvement(scores: Scores, baseline: Scores) -> Scores:
    """Computes the probability that a run scores higher than a run of the baseline, ties halved.

    It is the mean over tasks of the Mann-Whitney statistic divided by the number of pairs: 0.5 if
    neither is better, 1 if every run beats every run of the baseline. Tasks may have different
    scales.

    Args:
        scores (array): ``[..., runs, tasks]``; larger is better, so negate measures that should be
            small. Tasks with fewer runs than others have NaN.
        baseline (array): ``[..., other runs, tasks]``, in the same form.

    Returns:
        Array of shape ``[...]``.

    Examples:
        >>> probability_of_improvement(np.array([[1.0], [3.0]]), np.array([[1.0], [2.0]])).item()
        0.625
    """
    ours, theirs = scores[..., :, None, :], baseline[..., None, :, :]
    # Both comparisons are false for NaN.
    better = ((ours > theirs) + 0.5 * (ours == theirs)).sum((-3, -2))
    pairs = (~np.isnan(scores)).sum(-2) * (~np.isnan(baseline)).sum(-2)
    most = pairs.max(-1, keepdims=True)
    # Exact up to one division if all tasks have the same number of pairs.
    return np.asarray((better * (most / pairs)).sum(-1) / (most[..., 0] * pairs.shape[-1]))


def bootstrap_interval(
    statistic: Callable[..., Scores],
    *scores: Scores,
    generator: np.random.Generator,
    confidence: float = 0.95,
    resamples: int = 2000,
) -> Interval:
    """Computes a stratified bootstrap confidence interval: runs are resampled within each task.

    Args:
        statistic (Callable): Function from matrices ``[..., runs, tasks]`` to ``[...]``.
        *scores (array): Matrix ``[runs, tasks]`` for each argument of the statistic. A task with
            fewer runs than others has NaN in its last rows.

    Keyword Args:
        generator (numpy.random.Generator): Generator of the resamples.
        confidence (float): Confidence level in (0, 1). Larger values give wider intervals.
        resamples (int): Number of resamples, at least 1. Larger values give steadier intervals.

    Returns:
        The lower and upper ends: percentiles of the statistic over the resamples.

    Raises:
        ValueError: If ``confidence`` or ``resamples`` is out of its range.

    Examples:
        >>> bootstrap_interval(mean, np.ones((3, 1)), generator=np.random.default_rng(0))
        (1.0, 1.0)
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}.")
    if resamples < 1:
        raise ValueError(f"resamples must be at least 1, got {resamples}.")
    drawn = []
    for matrix in scores:
        runs = (~np.isnan(matrix)).sum(0)
        rows = generator.integers(runs, size=(resamples, *matrix.shape))
        absent = np.arange(len(matrix))[:, None] >= runs
        drawn.append(np.where(absent, np.nan, np.take_along_axis(matrix[None], rows, 1)))
    tail = (1.0 - confidence) / 2.0
    # The statistic needs memory for every pair of runs: a few resamples at a time.
    cuts = range(RESAMPLES_AT_ONCE, resamples, RESAMPLES_AT_ONCE)
    parts = zip(*(np.split(matrices, cuts) for matrices in drawn), strict=True)
    found = np.concatenate([statistic(*part) for part in parts])
    lower, upper = np.quantile(found, [tail, 1.0 - tail])
    return float(lower), float(upper)


def curve_band(
    curves: Scores,
    *,
    generator: np.random.Generator,
    confidence: float = 0.95,
    resamples: int = 1000,
) -> tuple[Scores, Scores]:
    """Pointwise bootstrap interval of the mean of curves, which are drawn whole.

    Args:
        curves (array): ``[runs, points]``.

    Keyword Args:
        generator (numpy.random.Generator): draws the runs.
        confidence (float): share of the resamples between the ends. Larger: wider.
        resamples (int): how many. More: smoother ends.

    Returns:
        The lower and the upper curve, ``[points]`` each.
    """
    runs = len(curves)
    # How often each run is in each resample; so nothing of size [resamples, runs, points] is made.
    counts = generator.multinomial(runs, np.full(runs, 1.0 / runs), size=resamples)
    tail = (1.0 - confidence) / 2.0
    lower, upper = np.quantile(counts @ curves / runs, [tail, 1.0 - tail], axis=0)
    return lower, upper
