"""Settings of the test suite."""

import os
from importlib.util import find_spec

from pytest import DoctestItem, Item

# Before torch is imported: threads of several processes on the same cores wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Its doctests import the extra rsl-rl.
collect_ignore = [] if find_spec("rsl_rl") else ["torchrl_l2c2/rsl_rl"]


def pytest_itemcollected(item: Item) -> None:
    """Runs the examples of components as a reader would, without the names of their module."""
    experiment = item.name.startswith("torchrl_l2c2.experiment.")
    if isinstance(item, DoctestItem) and item.name.startswith("torchrl_l2c2.") and not experiment:
        item.dtest.globs = {}
