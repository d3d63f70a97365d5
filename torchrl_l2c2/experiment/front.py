"""The Pareto front of a search: settings that no other one beats in return and smoothness."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.finished import QUANTITIES, TESTS
from torchrl_l2c2.experiment.reports.comparison import SIGNS
from torchrl_l2c2.experiment.reports.figures import finish, styles, subplots
from torchrl_l2c2.experiment.reports.groups import Group
from torchrl_l2c2.experiment.reports.tables import Table, number_range, pooled

# What a front is of: the policy's mean is what is deployed, and many policies are steadier than the
# last one, where they were tested.
MEASURED = ("late_mean", "last_mean")


def front_test(groups: Sequence[Group]) -> str:
    """The test that a front of these groups is of: what most of them have, or else the first."""
    return max(MEASURED, key=lambda test: sum(_is_known(group, test) for group in groups))


def means(group: Group, test: str) -> tuple[float, ...]:
    """Return and action variation, means over seeds; fewer numbers where one is not known."""
    scores = [group.scores(test, quantity) for quantity in SIGNS]
    return tuple(float(each.mean()) for each in scores if len(each))


def _is_known(group: Group, test: str) -> bool:
    return len(means(group, test)) == len(SIGNS)


def pareto_front(groups: Sequence[Group], test: str) -> list[Group]:
    """Those with which no other one can compete in both, from the smoothest on.

    A group is left out if another one is at least as good in return and in action variation, and
    better in one of them.

    Args:
        groups (sequence of Group): of one task and algorithm.
        test (str): one of ``TESTS``.
    """
    known = [(group, means(group, test)) for group in groups if _is_known(group, test)]
    # The smoothest first, and of equally smooth ones that with the largest return.
    ordered = sorted((m[1], -m[0], i) for i, (_, m) in enumerate(known))
    front: list[int] = []
    best: tuple[float, float] | None = None
    for variation, loss, place in ordered:
        if best is None or loss < best[1] or (variation, loss) == best:
            front.append(place)
            best = (variation, loss)
    return [known[place][0] for place in front]


def front_table(groups: Sequence[Group], test: str) -> Table:
    """The front, numbered as in its picture; means over seeds, standard deviations in brackets."""
    first, front = groups[0].first, pareto_front(groups, test)
    rows = [
        [
            *(str(place), group.name, number_range(group.seeds)),
            *(pooled(group, test, quantity) for quantity in QUANTITIES),
        ]
        for place, group in enumerate(front, 1)
    ]
    measured = sum(_is_known(group, test) for group in groups)
    note = (
        f"{len(front)} of {measured} settings; every other one returns no more and is no "
        "smoother than one of these. The best of many has been lucky, too: run it on new seeds."
    )
    title = f"{first.task}, {first.algorithm}: Pareto front, {TESTS[test]}"
    return Table(title, ["", "settings", "seeds", *QUANTITIES.values()], rows, [note])


def draw_front(groups: Sequence[Group], test: str, path: str | Path) -> None:
    """Draws every setting as a dot, and the Pareto front with its numbers and a line.

    Along the line, whatever is gained in return is paid for in smoothness.

    Args:
        groups (sequence of Group): Groups of one task and algorithm.
        test (str): One of ``TESTS``.
        path (str or Path): The file, of the format of its ending, ``.png`` or ``.svg``.
    """
    picture, axes = subplots(1, 1, (5.4, 4.0))
    looks = styles(groups)
    front = pareto_front(groups, test)
    for group in groups:
        if place := means(group, test):
            color = looks[group.name]["color"]
            axes[0].plot(*place[::-1], "o", color=color, alpha=1.0 if group in front else 0.3)
    steps = [means(group, test)[::-1] for group in front]
    axes[0].step(*zip(*steps, strict=True), where="post", color="#444444", linewidth=1)
    for number, step in enumerate(steps, 1):
        offset = {"xytext": (4, -10), "textcoords": "offset points"}
        axes[0].annotate(str(number), step, fontsize=9, **offset)
    axes[0].set_xlabel("action variation")
    axes[0].set_ylabel("return")
    first = groups[0].first
    title = f"{first.task}, {first.algorithm}: {len(groups)} settings, {TESTS[test]}"
    finish(picture, axes, title, path)
