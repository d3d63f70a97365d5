"""Makes ``docs/idea.md`` from ``notebooks/idea.ipynb``: ``python docs/make_idea.py``.

The page has the notebook's text and the pictures that its code draws (extra ``notebooks``). Cells
that are marked ``live`` need a kernel and are left out.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import nbformat

DOCS = Path(__file__).parent
NOTEBOOK = DOCS.parent / "notebooks" / "idea.ipynb"
NOTE = "*The code of every picture, and sliders, are in `notebooks/idea.ipynb`.*"


def cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """The notebook's cells that the page shows, in order."""
    return [cell for cell in notebook.cells if not cell.metadata.get("live")]


def page(notebook: nbformat.NotebookNode, pictures: dict[str, int]) -> str:
    """The page's text.

    Args:
        notebook (NotebookNode): The notebook; a cell's ``alt`` describes its pictures.
        pictures (dict): Number of pictures that each cell draws, by the cell's id.
    """
    parts, number = [], 0
    for cell in cells(notebook):
        if cell.cell_type == "markdown":
            parts.append(cell.source.replace("](../docs/", "]("))
        for _ in range(pictures.get(cell.id, 0)):
            number += 1
            parts.append(f"![{cell.metadata['alt']}](idea_{number}.png)")
    title, *rest = parts
    heading, _, introduction = title.partition("\n\n")
    return "\n\n".join([heading, NOTE, introduction, *rest]) + "\n"


def main() -> None:
    """Runs the notebook's code, and writes the page and its pictures."""
    plt.show = lambda *_, **__: None
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    names: dict[str, Any] = {}
    pictures: dict[str, int] = {}
    for cell in cells(notebook):
        if cell.cell_type != "code":
            continue
        exec(compile(cell.source, f"{NOTEBOOK.name}, {cell.id}", "exec"), names)
        drawn = [plt.figure(number) for number in plt.get_fignums()]
        for figure in drawn:
            number = sum(pictures.values()) + 1
            # Without the version of the program, the same runs give the same bytes.
            figure.savefig(DOCS / f"idea_{number}.png", dpi=80, metadata={"Software": None})
            pictures[cell.id] = pictures.get(cell.id, 0) + 1
        plt.close("all")
    (DOCS / "idea.md").write_text(page(notebook, pictures))
    print(f"docs/idea.md and {sum(pictures.values())} pictures", file=sys.stderr)


if __name__ == "__main__":
    main()
