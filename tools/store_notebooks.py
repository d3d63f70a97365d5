"""Runs notebooks and stores their outputs: `python tools/store_notebooks.py results shaking`.

Stored are standard output and pictures, not warnings, times, or outputs that need a live kernel.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"


def store(name: str) -> None:
    """Runs a notebook and stores it with its outputs.

    Args:
        name (str): Name of the notebook, without ``.ipynb``.
    """
    path = FOLDER / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    metadata = notebook.metadata.copy()
    NotebookClient(
        notebook,
        timeout=900,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
        record_timing=False,
        coalesce_streams=True,
    ).execute()
    notebook.metadata = metadata
    for cell in notebook.cells:
        if cell.cell_type != "code":
            continue
        shown = [each for each in cell.outputs if each.get("name") != "stderr"]
        cell.outputs = [] if cell.metadata.get("live") else shown
    nbformat.write(notebook, path)


if __name__ == "__main__":
    os.environ.pop("MPLBACKEND", None)  # Another backend would keep pictures out of the notebook.
    for each in sys.argv[1:]:
        store(each)
        print(f"stored: {each}", flush=True)
