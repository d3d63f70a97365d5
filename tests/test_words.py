"""README, docs, docstrings and messages use the words of the field, not words of this project."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MODULES = sorted((ROOT / "torchrl_l2c2").rglob("*.py"))
# Pattern, and what to write instead, with the reason.
WORDS = {
    r"vanilla(?! \(no regularizer\))": "'the baseline': one name for it",
    r"the zoo\b|the zoo's": "'RL Zoo': the name that readers can look up",
    r"beside(?!s)": "'next to', 'in addition to' or 'compared with': say which",
    r"likewise": "'also', or the sentence again: readers search for what it refers to",
    r"(go|goes|went) on(?! the)": "'continues' or 'resumes': the word of the settings and messages",
    r"to the bit": "'bit for bit': the expression that exists",
    r"by a hair": "'narrowly': an idiom that translations lose",
    r"in (the )?place of": "'instead of': shorter, and used everywhere else",
    r"for the most part": "'mostly': shorter",
    r"all the same": "'still': it also means 'all equal'",
    r"in the mean(?!time)": "'on average': 'in the mean' looks like a cut word",
    r"(is|are|was|were) told": "'is logged', 'is reported' or 'warns': say where readers find it",
    r"P (does not )?separates?|not separated": "'within seed noise', with the number of seeds",
    r"(cannot be|not) distinguish(ed|able)": "'within seed noise', with the number of seeds",
    r"(the paper|L2C2|CAPS|CATS)'s(?=\s*[.,;:)|])": "a noun has to follow, such as 'settings'",
    r"of what (is|was|it)\b": "a noun: 'what' clauses in a row are hard to read",
}


def prose(page: Path) -> Iterator[tuple[int, str]]:
    """A page's lines outside of code and tables, without names in backticks."""
    text = re.sub(
        r"^```.*?^```",
        lambda block: "\n" * block[0].count("\n"),
        page.read_text(),
        flags=re.M | re.S,
    )
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("|"):
            yield number, re.sub(r"`[^`]*`", "", line)


def texts(module: Path) -> Iterator[tuple[int, str]]:
    """A module's docstrings and messages; a string of one word is a name."""
    for node in ast.walk(ast.parse(module.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield (
                node.lineno,
                re.sub(r"``[^`]*``|^ *(>>>|\.\.\.|\[').*$", "", node.value, flags=re.M),
            )


@pytest.mark.parametrize("path", [*PAGES, *MODULES], ids=lambda path: str(path.relative_to(ROOT)))
def test_words_of_the_field(path: Path) -> None:
    """Every hit has its line, the words, and what to write instead."""
    found = [
        f"line {number + text.count(chr(10), 0, hit.start())}: {hit[0]!r}: {instead}"
        for number, text in (prose(path) if path.suffix == ".md" else texts(path))
        for pattern, instead in WORDS.items()
        for hit in re.finditer(rf"\b(?:{pattern})", text, re.IGNORECASE)
    ]
    assert not found, "\n".join(found)


def test_code_and_tables_are_left_out(tmp_path: Path) -> None:
    """Names in code may be anything; a message and a sentence count."""
    page, module = tmp_path / "page.md", tmp_path / "module.py"
    page.write_text("a `vanilla` run\n\n| vanilla |\n\n```\nvanilla\n```\nof vanilla\n")
    assert [line for line in prose(page) if "vanilla" in line[1]] == [(8, "of vanilla")]
    module.write_text('label = "vanilla"\nraise ValueError(f"{label} of vanilla")\n')
    assert [text for _, text in texts(module)] == [" of vanilla"]
