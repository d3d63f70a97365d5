"""The part of a page that is made from records: tables and a picture between two marks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.files import make_folder_of, write_atomically
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
from torchrl_l2c2.experiment.saved import BUDGETS
from torchrl_l2c2.experiment.tasks import TASKS

START, END = "<!-- results: start -->", "<!-- results: end -->"
PICTURE = Path("docs") / "results.svg"


def paper_text(records: Sequence[Record]) -> str | None:
    """The paper's table with its picture, :data:`PICTURE`, and what it has beside it.

    Where a task has runs of its default length and settings, others are not told: they compare
    lengths and readings of the paper. Regularizers' settings may be others.

    Returns:
        str or None: nothing without a record of the paper's tasks with its algorithm.
    """
    groups = shown_groups(records)
    table = paper_table(groups)
    if table is None:
        return None
    picture = f"![Return against action variation of every method]({PICTURE.as_posix()})"
    faster = faster_targets_table([r for r in records if is_as_usual(r, TAU)])
    beside = (deployed_table(groups), statistics_table("late_sampled", groups), faster)
    more = [each.markdown() for each in beside if each]
    return "\n\n".join([picture, table.markdown(), *settings_notes(groups), *more])


def field_text(records: Sequence[Record], picture: str) -> str | None:
    """The field's table with a picture of that name, and the methods beside one another.

    Returns:
        str or None: nothing without a record of a task that has a published row.
    """
    table = field_table(records)
    if table is None:
        return None
    drawn = f"![Return against Sm of every method, beside what was published]({picture})"
    tables = [table, *filter(None, [choice_table(records)]), *pairwise_tables(records)]
    return "\n\n".join([drawn, *(each.markdown() for each in tables)])


def fill(text: str, results: str) -> str:
    """A page's text with these results between its marks.

    Raises:
        ValueError: the marks are not there, once each and in order.
    """
    pattern = re.compile(f"{re.escape(START)}.*?{re.escape(END)}", re.S)
    if (text.count(START), text.count(END), len(pattern.findall(text))) != (1, 1, 1):
        raise ValueError(f"the text must have {START} and behind it {END}, once each.")
    made = f"{START}\n{results}\n{END}"
    return pattern.sub(lambda _: made, text)


def fill_page(path: str | Path, records: Sequence[Record], first: Sequence[Table] = ()) -> None:
    """Makes a page's results anew, and their picture.

    The paper's table where there are records of its tasks, with its picture in the ``docs`` folder
    beside the page; else the field's, with a picture of the page's own name beside it.

    Args:
        path (str or Path): of the page.
        records (sequence of Record): what it is of.
        first (sequence of Table): what stands before them.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as :func:`fill`, or the records give neither table; nothing is written then.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {str(path)!r} with {START} and {END} to fill.")
    picture = path.with_suffix(".svg")
    of_paper, of_field = paper_text(records), field_text(records, picture.name)
    results = of_paper or of_field
    if results is None:
        tasks = ", ".join(dict.fromkeys(task for task, _ in PAPER))
        raise ValueError(
            f"none of {len(records)} records is of the paper's {tasks} with ppo_rpe, or of a task "
            "of the field's table, of which a page's results are: name a file that has some, by "
            "--from or --csv."
        )
    results = "\n\n".join([*(table.markdown() for table in first), results])
    text = fill(path.read_text(), results)
    if of_paper:
        picture = path.parent / PICTURE
        make_folder_of(picture)
        draw_plane(shown_groups(records), "late_sampled", picture)
    else:
        draw_plane(field_groups(records), "last_mean", picture, "sm_asap")
    write_atomically(path, text.encode())


def shown_groups(records: Sequence[Record]) -> list[Group]:
    """What the table and the picture are of."""
    records = [r for r in records if is_of_paper(r.task, r.algorithm)]
    as_usual = {r.task for r in records if is_as_usual(r)}
    return group_records(r for r in records if is_as_usual(r) or r.task not in as_usual)


def is_as_usual(record: Record, *but: str) -> bool:
    """Whether it has its task's default length and settings, but for some that are named."""
    task = TASKS.get(record.task)
    others = {k for k in record.other_settings if not k.startswith("regularizer.")}
    others -= {*BUDGETS, *but}
    return task is not None and record.length == f"{task.episodes} episodes" and not others
