"""Tables, statistics and pictures of finished runs, beside the paper's numbers.

``python -m torchrl_l2c2.experiment.reports outputs/swingup`` reads every run below a folder, prints
their tables and writes a report; ``--help`` says what else it does.
"""

from torchrl_l2c2.experiment.reports.figures import draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.paper import PAPER, Published
from torchrl_l2c2.experiment.reports.records import (
    QUANTITIES,
    TESTS,
    Record,
    read_records,
    write_records,
)
from torchrl_l2c2.experiment.reports.report import write_report
from torchrl_l2c2.experiment.reports.results import compare_with_paper, sweep_summary, write_results
from torchrl_l2c2.experiment.reports.runs import (
    FinishedRun,
    Found,
    find_runs,
    finished_run,
    read_runs,
)
from torchrl_l2c2.experiment.reports.tables import Table

__all__ = [
    "PAPER",
    "QUANTITIES",
    "TESTS",
    "FinishedRun",
    "Found",
    "Group",
    "Published",
    "Record",
    "Table",
    "compare_with_paper",
    "draw_learning_curves",
    "draw_plane",
    "find_runs",
    "finished_run",
    "group_records",
    "read_records",
    "read_runs",
    "sweep_summary",
    "write_records",
    "write_report",
    "write_results",
]
