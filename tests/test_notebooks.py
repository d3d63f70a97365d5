"""The notebooks are stored with their outputs, and run from top to bottom."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
import pandas as pd
import pytest
from jupyter_client import KernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

FOLDER = Path(__file__).parents[1] / "notebooks"
NAMES = ["idea.ipynb", "quickstart.ipynb", "results.ipynb", "shaking.ipynb"]
INSTALL = 'if find_spec("torchrl_l2c2") is None:\n    %pip install -q "{SOURCE}"'


@pytest.fixture(params=NAMES)
def notebook(request: pytest.FixtureRequest) -> nbformat.NotebookNode:
    """A notebook as it is stored."""
    return stored(request.param)


def stored(name: str) -> nbformat.NotebookNode:
    """The notebook of this name."""
    return nbformat.read(FOLDER / name, as_version=4)


def code(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """The cells of code, in order."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """The outputs of the cells, in order."""
    return [output for cell in code(notebook) for output in cell.outputs]


def printed(notebook: nbformat.NotebookNode) -> str:
    """The text that the cells have printed."""
    return "".join(output.get("text", "") for output in outputs(notebook))


def pictures(cell: nbformat.NotebookNode) -> int:
    """The number of pictures that a cell shows without a live kernel."""
    return sum("image/png" in output.get("data", {}) for output in cell.get("outputs", []))


@pytest.fixture(scope="module")
def kernel() -> Iterator[KernelManager]:
    """One kernel for all tests: to import PyTorch takes most of the time."""
    manager = KernelManager(kernel_name="python3")
    yield manager
    if manager.has_kernel:
        manager.shutdown_kernel(now=True)


def run(
    notebook: nbformat.NotebookNode,
    monkeypatch: pytest.MonkeyPatch,
    timeout: float,
    kernel: KernelManager | None = None,
) -> None:
    """Runs a notebook; an error of a cell is an error here.

    Args:
        notebook: The notebook, which gets the outputs.
        timeout: The largest time of a cell in seconds.
        kernel: The kernel; a new one by default.
    """
    # A backend chosen outside would keep the pictures out of the notebook.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    folder = {"metadata": {"path": str(FOLDER)}}
    shared = {} if kernel is None else {"km": kernel}
    client = NotebookClient(
        notebook, timeout=timeout, kernel_name="python3", resources=folder, **shared
    )
    # No notebook has the names of another.
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%reset -f"))
    client.execute()
    del notebook.cells[0]


def test_all_four_are_there() -> None:
    """A notebook that is missing in the list would not be tested."""
    assert sorted(path.name for path in FOLDER.glob("*.ipynb")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_stored_with_outputs(name: str) -> None:
    """Complete, from one run, without errors and warnings, and small."""
    notebook = stored(name)
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in code(notebook)]
    assert counts == list(range(1, len(counts) + 1))
    kinds = {output.output_type for output in outputs(notebook)}
    assert kinds <= {"stream", "display_data", "execute_result"}
    streams = {output.name for output in outputs(notebook) if output.output_type == "stream"}
    assert streams <= {"stdout"}
    assert sum(map(pictures, notebook.cells)) == sum(
        cell.source.count("subplots(") for cell in code(notebook)
    )
    assert (FOLDER / name).stat().st_size < 400_000


def test_the_first_cell_installs_only_what_is_missing(notebook: nbformat.NotebookNode) -> None:
    """For Colab; and no output shows that the package was there."""
    assert INSTALL in code(notebook)[0].source and not code(notebook)[0].outputs


def test_runs_shortened(
    notebook: nbformat.NotebookNode, monkeypatch: pytest.MonkeyPatch, kernel: KernelManager
) -> None:
    """With the parameters of the short form, and with as many pictures as stored."""
    before = [pictures(cell) for cell in code(notebook)]
    for cell in notebook.cells:
        # Sliders need a live front end.
        cell.source = cell.metadata.get("short", cell.source).replace("= 20, True", "= 20, False")
        cell.outputs = []
    run(notebook, monkeypatch, 120, kernel)
    assert [pictures(cell) for cell in code(notebook)] == before


def test_sliders_follow_a_picture(monkeypatch: pytest.MonkeyPatch, kernel: KernelManager) -> None:
    """Readers without a live kernel see the picture."""
    notebook = stored("idea.ipynb")
    cells = code(notebook)
    (place,) = (n for n, cell in enumerate(cells) if "interact(" in cell.source)
    assert pictures(cells[place - 1]) == 1
    notebook.cells = [cell.copy() for cell in cells[: place + 1] if "find_spec" not in cell.source]
    for cell in notebook.cells:
        cell.source = cell.metadata.get("short", cell.source)
    client = NotebookClient(notebook, timeout=120, kernel_name="python3", km=kernel)
    # Nobody looks at the widgets, and the client would wait for them after the last cell.
    client.comm_open_handlers = {}
    monkeypatch.delenv("MPLBACKEND", raising=False)
    client.execute()
    assert not any(output.output_type == "error" for output in outputs(notebook))


def test_the_two_numbers_show_less_shaking() -> None:
    """The stored quickstart ends with two numbers, one trace and three closing lines."""
    notebook = stored("quickstart.ipynb")
    found = re.findall(
        r"^(\w+) +action variation ([0-9.]+), return ([0-9.]+) of 100$", printed(notebook), re.M
    )
    assert [name for name, *_ in found] == ["baseline", "smooth"]
    assert pictures(code(notebook)[-1]) == 1
    (before, total), (after, other) = ([float(n) for n in numbers] for _, *numbers in found)
    assert after < 0.5 * before and other > 0.97 * total
    assert len(re.findall(r"^\* ", notebook.cells[-1].source, re.M)) == 3


def test_noise_is_the_cause_of_the_shaking() -> None:
    """The stored outputs show what the closing lines of the notebook say."""
    found = {
        name: [float(number) for number in numbers.split()]
        for name, numbers in re.findall(
            r"^(\w+) +action variation (.+)$", printed(stored("shaking.ipynb")), re.M
        )
    }
    assert list(found) == ["before", "after"]
    for variations in found.values():
        assert variations == sorted(variations) and variations[0] < 0.1 * variations[3]
    assert all(b > a for b, a in zip(*found.values(), strict=True))
    assert "It is sensitive to noise" in printed(stored("shaking.ipynb"))


def test_the_stored_table_has_the_means_of_the_records() -> None:
    """The notebook about results is stored with the numbers of its file."""
    runs = pd.read_csv(FOLDER.parent / "results" / "hopper.csv")
    tables = "".join(
        output.data["text/html"]
        for output in outputs(stored("results.ipynb"))
        if "text/html" in output.get("data", {})
    )
    for method in ("none", "l2c2_ramp", "cats"):
        own = runs[runs["method"] == method]
        assert f"<td>{own['last_mean_action_variation'].mean():.3f}</td>" in tables
        assert f"<td>{own['last_mean_return'].mean():.0f}</td>" in tables


@pytest.mark.slow
def test_runs_and_draws(notebook: nbformat.NotebookNode, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every cell as it stands, without an error, and with as many pictures as stored."""
    before = [pictures(cell) for cell in code(notebook)]
    run(notebook, monkeypatch, timeout=900)
    assert [pictures(cell) for cell in code(notebook)] == before


def test_the_page_of_the_idea_is_its_notebook() -> None:
    """Its text, and a described picture after every cell that draws one."""
    docs = FOLDER.parent / "docs"
    made: dict[str, Any] = runpy.run_path(str(docs / "make_idea.py"))
    notebook = stored("idea.ipynb")
    drawing = {cell.id: 1 for cell in code(notebook) if "subplots(" in cell.source}
    written = (docs / "idea.md").read_text()
    assert written == made["page"](notebook, drawing) and "SLIDERS" not in written
    assert all((docs / f"idea_{number + 1}.png").exists() for number in range(len(drawing)))


@pytest.mark.parametrize(
    ("chosen", "told"),
    [
        ("task == 'pendulum'", "several tasks or settings"),
        ("algorithm == 'sac'", "No runs of"),
    ],
)
def test_only_runs_that_compare_are_pooled(
    chosen: str, told: str, monkeypatch: pytest.MonkeyPatch, kernel: KernelManager
) -> None:
    """Another file may have several tasks, algorithms and settings of a method."""
    notebook = stored("results.ipynb")
    for cell in code(notebook):
        cell.source = cell.source.replace("results/hopper.csv", "results/field.csv")
        cell.source = cell.source.replace("task == 'hopper_v5' and algorithm == 'ppo'", chosen)
    with pytest.raises(CellExecutionError, match=told):
        run(notebook, monkeypatch, timeout=60, kernel=kernel)
