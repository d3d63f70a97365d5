"""Tables, statistics and pictures of finished runs.

``python -m torchrl_l2c2.experiment.reports outputs/swingup`` reads every run below a folder, prints
a table of them and writes a report; ``--help`` lists its options.
"""

from torchrl_l2c2.experiment.finished import (
    QUANTITIES,
    TESTS,
    FinishedRun,
    Record,
    finished_run,
)
from torchrl_l2c2.experiment.reports.comparison import comparison_table
from torchrl_l2c2.experiment.reports.figures import draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.reports.groups import Group, group_records
from torchrl_l2c2.experiment.reports.records import read_records, write_records
from torchrl_l2c2.experiment.reports.report import write_report
from torchrl_l2c2.experiment.reports.results import result_lines, sweep_summary, write_results
from torchrl_l2c2.experiment.reports.runs import Found, find_runs, read_runs
from torchrl_l2c2.experiment.reports.tables import Table

__all__ = [
    "QUANTITIES",
    "TESTS",
    "FinishedRun",
    "Found",
    "Group",
    "Record",
    "Table",
    "comparison_table",
    "draw_learning_curves",
    "draw_plane",
    "find_runs",
    "finished_run",
    "group_records",
    "read_records",
    "read_runs",
    "result_lines",
    "sweep_summary",
    "write_records",
    "write_report",
    "write_results",
]
