"""The part of a page that is made from records: tables and a picture between two marks."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from torchrl_l2c2.experiment.files import write_atomically
from torchrl_l2c2.experiment.reports.choice import choice_table
from torchrl_l2c2.experiment.reports.comparison import statistics_table
from torchrl_l2c2.experiment.reports.faster_targets import faster_targets_table
from torchrl_l2c2.experiment.reports.field import field_groups, field_table
from torchrl_l2c2.experiment.reports.figures import draw_plane
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.pairwise import pairwise_tables
from torchrl_l2c2.experiment.reports.paper import PAPER, TAU, is_of_paper
from torchrl_l2c2.experiment.reports.paper_table import deployed_table, paper_table
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import Table, settings_notes
from torchrl_l2c2.experiment.tasks import TASKS

START, END = "<!-- results: start -->", "<!-- results: end -->"
# In the place of START: the first table alone, without picture and details.
START_TABLE = "<!-- results: start of the table alone -->"


@dataclass(frozen=True)
class Results:
    """What a page has of records.

    Attributes:
        table (str): the first table.
        details (tuple of str): what stands beside it.
        shown (str): what the picture shows.
        draw (callable): draws the picture into a file.
    """

    table: str
    details: tuple[str, ...]
    shown: str
    draw: Callable[[Path], None]

    def text(self, picture: str) -> str:
        """All of it, with a picture of that name."""
        return "\n\n".join([f"![{self.shown}]({picture})", self.table, *self.details])


def paper_results(records: Sequence[Record]) -> Results | None:
    """The paper's table with its picture, and what it has beside it.

    Where a task has runs of its default length and settings, others are not told: they compare
    lengths and readings of the paper. Regularizers' settings may be others.

    Returns:
        Results or None: nothing without a record of the paper's tasks with its algorithm.
    """
    groups = shown_groups(records)
    table = paper_table(groups)
    if table is None:
        return None
    faster = faster_targets_table([r for r in records if is_as_usual(r, TAU)])
    beside = (deployed_table(groups), statistics_table("late_sampled", groups), faster)
    details = (*settings_notes(groups), *(each.markdown() for each in beside if each))
    return Results(
        table.markdown(),
        details,
        "Return against action variation of every method",
        partial(draw_plane, groups, "late_sampled"),
    )


def field_results(records: Sequence[Record]) -> Results | None:
    """The field's table with its picture, and the methods beside one another.

    Returns:
        Results or None: nothing without a record of a task that has a published row.
    """
    table = field_table(records)
    if table is None:
        return None
    beside = [*filter(None, [choice_table(records)]), *pairwise_tables(records)]
    return Results(
        table.markdown(),
        tuple(each.markdown() for each in beside),
        "Return against Sm of every method, beside what was published",
        partial(draw_plane, field_groups(records), "last_mean", measure="sm_asap"),
    )


def fill(text: str, results: str, start: str = START) -> str:
    """A page's text with these results between its marks.

    Raises:
        ValueError: the marks are not there, once each and in order.
    """
    pattern = re.compile(f"{re.escape(start)}.*?{re.escape(END)}", re.S)
    if (text.count(start), text.count(END), len(pattern.findall(text))) != (1, 1, 1):
        raise ValueError(f"the text must have {start} and behind it {END}, once each.")
    made = f"{start}\n{results}\n{END}"
    return pattern.sub(lambda _: made, text)


def fill_pages(
    paths: Sequence[str | Path], records: Sequence[Record], first: Sequence[Table] = ()
) -> None:
    """Makes pages' results anew, and their pictures, of each page's own name beside it.

    The paper's results where there are records of its tasks, else the field's; between
    :data:`START_TABLE` and :data:`END` the first table alone.

    Args:
        paths (sequence of str or Path): of the pages.
        records (sequence of Record): what they are of.
        first (sequence of Table): what stands before the results that are not the table alone.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as :func:`fill`, or the records give neither table; nothing is written then.
    """
    pages = {path: _read_page(path) for path in map(Path, paths)}
    results = paper_results(records) or field_results(records)
    if results is None:
        tasks = ", ".join(dict.fromkeys(task for task, _ in PAPER))
        raise ValueError(
            f"none of {len(records)} records is of the paper's {tasks} with ppo_rpe, or of a task "
            "of the field's table, of which a page's results are: name a file that has some, by "
            "--from or --csv."
        )
    brief = {
        path: fill(text, results.table, START_TABLE)
        for path, text in pages.items()
        if START_TABLE in text
    }
    before = [table.markdown() for table in first]
    whole = {
        path: fill(text, "\n\n".join([*before, results.text(path.with_suffix(".svg").name)]))
        for path, text in pages.items()
        if path not in brief
    }
    for path in whole:
        results.draw(path.with_suffix(".svg"))
    for path, text in (brief | whole).items():
        write_atomically(path, text.encode())


def _read_page(path: Path) -> str:
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {str(path)!r} with {START} and {END} to fill.")
    return path.read_text()


def shown_groups(records: Sequence[Record]) -> list[Group]:
    """What the table and the picture are of."""
    records = [r for r in records if is_of_paper(r.task, r.algorithm)]
    as_usual = {r.task for r in records if is_as_usual(r)}
    return group_records(r for r in records if is_as_usual(r) or r.task not in as_usual)


def is_as_usual(record: Record, *but: str) -> bool:
    """Whether it has its task's default length and settings, but for some that are named."""
    task = TASKS.get(record.task)
    others = {k for k in record.settings_of_any_length if not k.startswith("regularizer.")}
    others -= {*but}
    return task is not None and record.length == f"{task.episodes} episodes" and not others
