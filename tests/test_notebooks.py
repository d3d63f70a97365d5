"""The notebooks run from top to bottom, and show something."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_client import KernelManager
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


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One for all, as most of what each would do is to import PyTorch."""
    manager = KernelManager(kernel_name="python3")
    yield manager
    if manager.has_kernel:
        manager.shutdown_kernel(now=True)


def run(
    notebook: nbformat.NotebookNode,
    monkeypatch: pytest.MonkeyPatch,
    timeout: float,
    kernel: KernelManager | None = None,
    sliders: bool = True,
) -> None:
    """So many seconds a cell at most; an error of a cell is one here.

    Without a kernel in a new one.
    """
    # A backend chosen outside would keep the pictures out of the notebook.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    folder = {"metadata": {"path": str(FOLDER)}}
    shared = {} if kernel is None else {"km": kernel}
    client = NotebookClient(
        notebook, timeout=timeout, kernel_name="python3", resources=folder, **shared
    )
    if sliders:
        # Nobody looks at the widgets, and answering them now and then leaves the client waiting for
        # a kernel that has long finished.
        client.comm_open_handlers = {}
    # No notebook has the names of another.
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    client.execute()
    del notebook.cells[0]


def pictures(cell: nbformat.NotebookNode) -> int:
    """How many a cell shows without a live kernel."""
    return sum("image/png" in output.get("data", {}) for output in cell.get("outputs", []))


def test_all_four_are_there() -> None:
    """Without them the tests below would have nothing to run."""
    assert NOTEBOOKS == ["experiment.ipynb", "idea.ipynb", "quickstart.ipynb", "results.ipynb"]


def test_the_first_is_stored_with_its_outputs(notebook: nbformat.NotebookNode) -> None:
    """Complete and from one run, without warnings; of the others they would change at every run."""
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    if notebook.cells[0].source.startswith("# Quickstart"):
        assert counts == list(range(1, len(counts) + 1))
        assert sum(map(pictures, notebook.cells)) >= 3
        assert {output.get("name", "stdout") for output in outputs(notebook)} == {"stdout"}
        assert (FOLDER / "quickstart.ipynb").stat().st_size < 1_000_000
    else:
        assert outputs(notebook) == [] and set(counts) == {None}


def test_the_two_numbers_show_less_shaking() -> None:
    """The stored quickstart ends with them, and with the actions as a picture."""
    notebook = nbformat.read(FOLDER / "quickstart.ipynb", as_version=4)
    last = [cell for cell in notebook.cells if cell.cell_type == "code"][-1]
    text = "".join(output.get("text", "") for output in last.outputs)
    found = re.findall(r"^(\w+) +action variation ([0-9.]+), return ([0-9.]+) of 100$", text, re.M)
    assert [name for name, *_ in found] == ["baseline", "smooth"] and pictures(last) == 1
    (before, total), (after, other) = ([float(n) for n in numbers] for _, *numbers in found)
    assert after < 0.5 * before and other > 0.97 * total


def test_a_notebook_runs_headless(monkeypatch: pytest.MonkeyPatch, kernel: KernelManager) -> None:
    """With nbclient as it is, which hangs on sliders that nobody moves: they are off."""
    notebook = nbformat.read(FOLDER / "idea.ipynb", as_version=4)
    for cell in notebook.cells:
        if "short" in cell.metadata:
            cell.source = cell.metadata["short"] + "\nSLIDERS = False"
    run(notebook, monkeypatch, 120, kernel, sliders=False)
    assert sum(map(pictures, notebook.cells)) >= 3


def test_what_has_sliders_is_a_picture_first(
    notebook: nbformat.NotebookNode, monkeypatch: pytest.MonkeyPatch, kernel: KernelManager
) -> None:
    """In the short form: of cells that say so, the source in their metadata."""
    for cell in notebook.cells:
        cell.source = cell.metadata.get("short", cell.source)
    run(notebook, monkeypatch, 120, kernel)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    with_sliders = [n for n, cell in enumerate(code) if "interact(" in cell.source]
    assert with_sliders and all(pictures(code[n - 1]) for n in with_sliders)


def test_the_pages_of_results_are_shown_with_their_pictures(
    monkeypatch: pytest.MonkeyPatch, kernel: KernelManager
) -> None:
    """As many as the pages name; the other cells are left out."""
    notebook = nbformat.read(FOLDER / "results.ipynb", as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    notebook.cells = [code[0], code[-1]]
    run(notebook, monkeypatch, 120, kernel)
    pages = "".join(page.read_text() for page in (FOLDER.parent / "results").glob("*.md"))
    shown = ["image/svg+xml" in output.get("data", {}) for output in outputs(notebook)]
    assert sum(shown) == pages.count("![") > 0


@pytest.mark.slow
def test_runs_and_draws(notebook: nbformat.NotebookNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every cell as it stands, without an error, and pictures come out."""
    run(notebook, monkeypatch, timeout=900, sliders=False)
    assert sum(map(pictures, notebook.cells)) >= 3


def test_the_page_of_the_idea_is_that_of_its_notebook() -> None:
    """Its text, and a picture behind every cell that draws one; what is live is left out."""
    docs = FOLDER.parent / "docs"
    made: dict[str, Any] = runpy.run_path(str(docs / "make_idea.py"))
    notebook = nbformat.read(FOLDER / "idea.ipynb", as_version=4)
    drawing = {cell.id: 1 for cell in notebook.cells if "subplots(" in cell.source}
    written = (docs / "idea.md").read_text()
    assert written == made["page"](notebook, drawing) and "live kernel" not in written
    assert all((docs / f"idea_{number + 1}.png").exists() for number in range(len(drawing)))
