"""Records below ``results/``, and pages with generated parts."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from torchrl_l2c2.experiment.analysis.reports.records import merge, read_records
from torchrl_l2c2.experiment.run.files import write_atomically

ROOT = Path(__file__).parents[1]


@functools.cache
def records(*names: str) -> pd.DataFrame:
    """The records of these files in ``results/``; the table is shared, so do not change it."""
    return merge(*(read_records(ROOT / "results" / f"{name}.csv") for name in names))


def fill(text: str, name: str, part: str) -> str:
    """A page's text with this part between its marks, the last of which keeps their indent.

    Raises:
        ValueError: The marks are not there, once each and in order.

    Examples:
        >>> print(fill("<!-- a: start -->\\nold\\n<!-- a: end -->", "a", "new"))
        <!-- a: start -->
        new
        <!-- a: end -->
    """
    start, end = f"<!-- {name}: start -->", f"<!-- {name}: end -->"
    pattern = re.compile(f"( *){start}\n.*?{end}", re.S)
    if (text.count(start), text.count(end), len(pattern.findall(text))) != (1, 1, 1):
        raise ValueError(f"Expected {start} and after it {end}, once each.")
    return pattern.sub(lambda found: f"{found[1]}{start}\n{part}\n{found[1]}{end}", text)


def write_parts(path: Path, parts: Mapping[str, str]) -> None:
    """Writes these parts into a page of the repository, and names it if they are new."""
    before = text = path.read_text()
    for name, part in parts.items():
        text = fill(text, name, part)
    if text != before:
        write_atomically(path, text.encode())
        print(f"written: {path.relative_to(ROOT)}")
