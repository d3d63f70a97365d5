"""The map of the paper, docs/paper.md: what it names is there, and nothing is left out."""

from __future__ import annotations

import ast
import pkgutil
import re
from ast import literal_eval
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from torchrl_l2c2.experiment import CAPSConfig, ExperimentConfig

TESTS = Path(__file__).parent
TEXT = (TESTS.parent / "docs" / "paper.md").read_text()
ROWS = [line for line in TEXT.splitlines() if line.startswith("| ") and "---" not in line]
NAMED = re.findall(r"`([^`]+)`", TEXT)
FUNCTIONS = sorted({name for name in NAMED if name.startswith(("torchrl_l2c2.", "studies."))})
HOLDING = sorted({name for name in NAMED if "::" in name})
GROUPS = ("task", "algorithm", "regularizer", "replay", "optimizer")
SETTING = re.compile(rf"`((?:{'|'.join(GROUPS)})\.\w+|test_episodes)(?:=([^` ]+))?`")


def rows_of(item: str) -> list[str]:
    """The rows that begin with an equation's, table's or figure's number."""
    return [row for row in ROWS if row.startswith(f"| {item} ")]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_computes_it_is_there(name: str) -> None:
    """Every function, class and method of the map can be imported by its path."""
    pkgutil.resolve_name(name)


@cache
def names_in(file: str) -> set[str]:
    """A file's tests as pytest names them."""
    names = set()
    for node in ast.parse((TESTS / file).read_text()).body:
        if isinstance(node, ast.ClassDef):
            names |= {f"{node.name}::{getattr(child, 'name', '')}" for child in node.body}
        elif isinstance(node, ast.FunctionDef):
            names.add(node.name)
    return names


@pytest.mark.parametrize("name", HOLDING)
def test_what_holds_it_is_there(name: str) -> None:
    """Every test of the map exists."""
    file, test = name.split("::", 1)
    assert test.split("::")[-1].startswith("test_") and test in names_in(file)


def default(row: str, setting: str) -> Any:
    """The default of a setting, of the regularizer that the row speaks of."""
    config = ExperimentConfig(**({"regularizer": CAPSConfig()} if "CAPS" in row else {}))
    for name in setting.split("."):
        config = getattr(config, name)
    return config


@pytest.mark.parametrize("row", [row for row in ROWS if SETTING.search(row)])
def test_settings_have_the_papers_values(row: str) -> None:
    """Every setting exists, and where the map gives the paper's value, that is its default."""
    for setting, value in SETTING.findall(row):
        found = default(row, setting)
        if value:
            expected = value if isinstance(found, str) else literal_eval(value)
            assert found == expected, setting


@pytest.mark.parametrize(
    "item",
    [
        *(f"({number})" for number in range(1, 18)),
        *(f"Table {number}" for number in ("I", "II", "III")),
        *(f"Fig. {number}" for number in range(1, 7)),
    ],
)
def test_nothing_is_left_out(item: str) -> None:
    """Each has one row, which says what computes it, or that nothing does."""
    (row,) = rows_of(item)
    assert any(part in row for part in (*FUNCTIONS, "no counterpart", "notebooks/"))
    assert "no counterpart" in row or any(test in row for test in HOLDING)
