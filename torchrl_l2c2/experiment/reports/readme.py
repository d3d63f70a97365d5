"""The part of a README that is made from records: the paper's table and its picture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from torchrl_l2c2.experiment.files import make_folder_of, write_atomically
from torchrl_l2c2.experiment.reports.differences import BUDGETS
from torchrl_l2c2.experiment.reports.faster_targets import faster_targets_table
from torchrl_l2c2.experiment.reports.figures import draw_plane
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.paper import PAPER, TAU, is_of_paper
from torchrl_l2c2.experiment.reports.paper_table import deployed_table, paper_table
from torchrl_l2c2.experiment.reports.records import Record
from torchrl_l2c2.experiment.reports.tables import settings_notes
from torchrl_l2c2.experiment.tasks import TASKS

START, END = "<!-- results: start -->", "<!-- results: end -->"
PICTURE = Path("docs") / "results.svg"


def results_text(records: Sequence[Record]) -> str:
    """What stands between the marks: a picture, the paper's table, and what it has beside it.

    Where a task has runs of its default length and settings, others are not told: they compare
    lengths and readings of the paper. Regularizers' settings may be others.

    Raises:
        ValueError: no record is of the paper's tasks with its algorithm.
    """
    groups = shown_groups(records)
    table = paper_table(groups)
    if table is None:
        tasks = ", ".join(dict.fromkeys(task for task, _ in PAPER))
        raise ValueError(
            f"none of {len(records)} records is of the paper's {tasks} with ppo_rpe, of which a "
            "README's results are: name a file that has some, by --from or --csv."
        )
    picture = f"![Return against action variation of every method]({PICTURE.as_posix()})"
    faster = faster_targets_table([r for r in records if is_as_usual(r, TAU)])
    more = [each.markdown() for each in (deployed_table(groups), faster) if each]
    return "\n\n".join([picture, table.markdown(), *settings_notes(groups), *more])


def fill(text: str, records: Sequence[Record]) -> str:
    """A README's text with its results made anew.

    Raises:
        ValueError: the marks are not there, once each and in order, or there are no results.
    """
    pattern = re.compile(f"{re.escape(START)}.*?{re.escape(END)}", re.S)
    if (text.count(START), text.count(END), len(pattern.findall(text))) != (1, 1, 1):
        raise ValueError(f"the text must have {START} and behind it {END}, once each.")
    made = f"{START}\n{results_text(records)}\n{END}"
    return pattern.sub(lambda _: made, text)


def fill_readme(path: str | Path, records: Sequence[Record]) -> None:
    """Makes a README's results anew, and the picture in the ``docs`` folder beside it.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: as :func:`fill`; nothing is written then.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {str(path)!r} with {START} and {END} to fill.")
    text = fill(path.read_text(), records)
    make_folder_of(path.parent / PICTURE)
    draw_plane(shown_groups(records), "late_sampled", path.parent / PICTURE)
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
