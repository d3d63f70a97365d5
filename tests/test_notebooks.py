"""The notebooks run from top to bottom, and show something."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(path.name for path in FOLDER.glob("*.ipynb"))


@pytest.fixture(params=NOTEBOOKS)
def notebook(request: pytest.FixtureRequest) -> nbformat.NotebookNode:
    """A notebook as it is stored."""
    return nbformat.read(FOLDER / request.param, as_version=4)


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """What the cells have put out, in order."""
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def test_the_quickstart_is_among_them() -> None:
    """Without it the tests below would have nothing to run."""
    assert "quickstart.ipynb" in NOTEBOOKS


def test_stored_without_outputs(notebook: nbformat.NotebookNode) -> None:
    """Outputs in the repository would change at every run."""
    nbformat.validate(notebook)
    assert outputs(notebook) == []
    assert all(cell.execution_count is None for cell in notebook.cells if cell.cell_type == "code")


def test_runs_and_draws(notebook: nbformat.NotebookNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every cell runs in a fresh kernel without an error, and a picture comes out."""
    # A backend chosen outside would keep the pictures out of the notebook.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    client = NotebookClient(
        notebook,
        timeout=300,
        kernel_name="python3",
        resources={"metadata": {"path": str(FOLDER)}},
    )
    client.execute()
    assert any("image/png" in output.get("data", {}) for output in outputs(notebook))
