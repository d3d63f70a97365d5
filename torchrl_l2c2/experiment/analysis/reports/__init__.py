"""Tables, statistics and pictures of finished runs.

``python -m torchrl_l2c2 report outputs/swingup`` reads every run below a folder, prints
a table of them and writes a report; ``--help`` lists its options.
"""

from torchrl_l2c2.experiment.analysis.reports.figures import draw_learning_curves, draw_plane
from torchrl_l2c2.experiment.analysis.reports.groups import Group, group_records
from torchrl_l2c2.experiment.analysis.reports.records import (
    Found,
    find_runs,
    read_records,
    read_runs,
    records_of,
    write_records,
)
from torchrl_l2c2.experiment.analysis.reports.report import (
    result_lines,
    sweep_summary,
    write_report,
)
from torchrl_l2c2.experiment.analysis.reports.table import Table, comparison_table
from torchrl_l2c2.experiment.run.finished import (
    QUANTITIES,
    TESTS,
    FinishedRun,
    Record,
    finished_run,
)

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
    "records_of",
    "result_lines",
    "sweep_summary",
    "write_records",
    "write_report",
]
