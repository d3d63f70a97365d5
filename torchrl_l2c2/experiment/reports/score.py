"""How near a reading of the paper comes to its table, as docs/protocol.md defines it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from torchrl_l2c2.experiment.reports.groups import Group
from torchrl_l2c2.experiment.reports.records import QUANTITIES

COMPARED = ("none", "caps")  # L2C2 is not looked at until a reading is taken.
CAP = 5.0


@dataclass(frozen=True)
class Reading:
    """One choice of what the paper leaves open, on one task: its runs of vanilla and of CAPS."""

    vanilla: Group
    caps: Group

    def cells(self, test: str) -> dict[tuple[str, str], float]:
        """By method and quantity, how many of the paper's standard deviations lie between.

        Args:
            test (str): one of ``records.TESTS``.

        Returns:
            dict: ``|mean over seeds - the paper's mean| / the paper's standard deviation``, at
            most 5; NaN where the runs do not have the test.
        """
        cells = {}
        for group in (self.vanilla, self.caps):
            for quantity in QUANTITIES:
                published = group.first.paper
                assert published is not None
                center, deviation = published.cell(quantity)
                values = group.scores(test, quantity)
                distance = abs(values.mean() - center) / deviation if len(values) else math.nan
                # A NaN first stays one.
                cells[group.first.method, quantity] = float(min(distance, CAP))
        return cells

    def score(self, test: str) -> float:
        """Mean of the four cells, from 0 to 5; smaller is nearer to the paper."""
        return statistics.fmean(self.cells(test).values())

    @property
    def updates(self) -> float:
        """Mean over its runs: of two readings that are as near, the one with fewer is taken."""
        return statistics.fmean(r.updates for r in (*self.vanilla.records, *self.caps.records))


def readings(groups: Sequence[Group]) -> list[Reading]:
    """Pairs vanilla and CAPS of the paper's tasks where their other settings are the same."""
    found: dict[tuple[Any, ...], dict[str, list[Group]]] = {}
    for group in groups:
        if group.first.method in COMPARED and group.first.paper is not None:
            alike = found.setdefault(group.reading, {method: [] for method in COMPARED})
            alike[group.first.method].append(group)
    # Several of one, of other defaults, are readings of their own.
    return [
        Reading(*pair)
        for alike in found.values()
        for pair in product(*(alike[method] for method in COMPARED))
    ]
