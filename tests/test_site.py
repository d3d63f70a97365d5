"""The documentation's site is built without a warning, and without a network, also to read it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_l2c2

pytestmark = pytest.mark.slow  # as CONTRIBUTING says, when pages or docstrings were touched
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    nowhere = "http://127.0.0.1:9"  # What is fetched through it fails.
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "-q", "docs", str(folder)],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "http_proxy": nowhere,
            "https_proxy": nowhere,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder


def test_every_public_name_has_its_place(site: Path) -> None:
    """The reference can be linked to by name."""
    ids = set(re.findall(r'id="([^"]+)"', (site / "api.html").read_text()))
    assert {f"torchrl_l2c2.{name}" for name in torchrl_l2c2.__all__ if name[0] != "_"} <= ids


def test_equations_are_drawn(site: Path) -> None:
    """Every one is MathML, with none of TeX's commands left, and its font is there."""
    for page in site.glob("*.html"):
        equations = re.findall(r"<math.*?</math>", page.read_text(), re.S)
        assert len(equations) > 100 or page.name != "api.html"
        assert not any("\\" in equation for equation in equations), page.name
        assert not re.search(
            r"\$\\|:math:", re.sub(r"<pre>.*?</pre>", "", page.read_text(), flags=re.S)
        )
    assert (site / "_static" / "STIXTwoMath-Regular.ttf").exists()


def test_nothing_is_fetched_to_read_it(site: Path) -> None:
    """Scripts, styles, pictures and fonts come along; only links that are followed lead away."""
    for page in site.rglob("*.html"):
        tags = re.findall(r"<(?:script|img|iframe|source|link)\b[^>]*>", page.read_text())
        assert tags
        assert not [tag for tag in tags if re.search(r'(?:src|href)="(?:https?:)?//', tag)], page
    for style in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//", style.read_text()), style


def test_no_page_takes_the_place_of_one_of_sphinx(site: Path) -> None:
    """Two of one name are one file: the later one's."""
    for page in (ROOT / "docs").glob("*.md"):
        title = re.search(r"^# (.+)$", page.read_text(), re.M)
        if title is not None:
            heading = re.search(r"<h1>(.*?)<a", (site / f"{page.stem}.html").read_text(), re.S)
            assert heading is not None and title[1].strip("`")[:8] in heading[1], page.name
