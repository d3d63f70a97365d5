"""Why a policy shakes: measured, in words, and as one page.

``python -m torchrl_l2c2 diagnose RUN [RUN...]`` writes the page of runs, or of CSV files with
recorded actions; :func:`diagnose` takes any TorchRL actor with an environment, and
:func:`diagnose_actions` any actions.
"""

from torchrl_l2c2.experiment.analysis.diagnosis.measured import Diagnosis, TermShare, diagnose
from torchrl_l2c2.experiment.analysis.diagnosis.names import run_folders, run_names
from torchrl_l2c2.experiment.analysis.diagnosis.page import write_page
from torchrl_l2c2.experiment.analysis.diagnosis.pictures import draw_together
from torchrl_l2c2.experiment.analysis.diagnosis.recording import (
    diagnose_actions,
    diagnose_recording,
)
from torchrl_l2c2.experiment.analysis.diagnosis.run import diagnose_run, value_function
from torchrl_l2c2.experiment.analysis.diagnosis.words import (
    THRESHOLDS,
    Finding,
    comparison,
    findings,
    summary,
)

__all__ = [
    "THRESHOLDS",
    "Diagnosis",
    "Finding",
    "TermShare",
    "comparison",
    "diagnose",
    "diagnose_actions",
    "diagnose_recording",
    "diagnose_run",
    "draw_together",
    "findings",
    "run_folders",
    "run_names",
    "summary",
    "value_function",
    "write_page",
]
