"""The documentation's site: ``python -m sphinx -W docs build/site``.

Nothing is fetched, neither to build the site nor to read it: equations become MathML, which
browsers draw themselves with a font that comes along, and other projects are not linked.
"""

from __future__ import annotations

import inspect
import re
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from docutils import nodes
from math_core import LatexError, LatexToMathML
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util import logging
from sphinx.util.inspect import stringify_signature

from torchrl_l2c2 import __version__

ROOT = Path(__file__).parents[1]

project = "torchrl_l2c2"
author = "The torchrl_l2c2 authors"
copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
napoleon_use_ivar = True
python_use_unqualified_type_names = True

# A reference to this package that leads nowhere is an error; other packages and type variables
# have no entry here.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!torchrl_l2c2).*|.*\.Made")]

html_theme = "furo"
html_title = f"torchrl_l2c2 {__version__}"
html_static_path = ["site.css", str(files("ziamath") / "fonts" / "STIXTwoMath-Regular.ttf")]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"

logger = logging.getLogger(__name__)
to_mathml = LatexToMathML(fancy_error=False)


def mathml(node: nodes.Element, equation: str, *, display: bool) -> str:
    try:
        return to_mathml.convert_with_local_state(equation, displaystyle=display)
    except LatexError as error:
        logger.warning("cannot draw %r: %s", equation, error, location=node)
        return ""


def draw_inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(mathml(node, node.astext(), display=False))
    raise nodes.SkipNode


def draw_block(writer: Any, node: nodes.math_block) -> None:
    equation = node.astext()
    if "\\\\" in equation:
        equation = rf"\begin{{aligned}}{equation}\end{{aligned}}"
    writer.body.append(f'<div class="math">{mathml(node, equation, display=True)}</div>')
    raise nodes.SkipNode


def show_constructor(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    """A class's own arguments, also where a ``__new__`` that takes anything comes before."""
    if what == "class" and obj.__module__.startswith("torchrl_l2c2") and "__init__" in vars(obj):
        arguments = inspect.signature(obj.__init__)
        without_self = list(arguments.parameters.values())[1:]
        shown = arguments.replace(parameters=without_self, return_annotation=arguments.empty)
        return stringify_signature(shown, unqualified_typehints=True), returns
    return None


class LinksToParts(SphinxPostTransform):
    """Leads a link to a record to the page of the site that includes this record."""

    default_priority = 8  # Before MyST looks for the file among the pages.

    def run(self, **kwargs: Any) -> None:
        for link in self.document.findall(pending_xref):
            target, _, anchor = link["reftarget"].partition("#")
            name = Path(target).name.removesuffix(".md")
            if link["reftype"] == "myst" and target not in self.env.found_docs and name in parts():
                page, first_heading = parts()[name]
                anchor = anchor or link.get("reftargetid") or slug(first_heading)
                link.attributes |= {"refdomain": "doc", "reftarget": page, "reftargetid": anchor}


@cache
def parts() -> dict[str, tuple[str, str]]:
    """The including page and the first heading of every record in ``results/`` and ``studies/``."""
    return {
        Path(included).stem: (page.stem, (ROOT / included).read_text().splitlines()[0])
        for page in (ROOT / "docs").glob("*.md")
        for included in re.findall(
            r"{include} \.\./((?:results|studies)/\S+\.md)", page.read_text()
        )
    }


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and MyST name it."""
    return re.sub(r"[^\w\- ]", "", heading.lstrip("# ").lower()).replace(" ", "-")


def setup(app: Sphinx) -> None:
    app.add_post_transform(LinksToParts)
    app.add_html_math_renderer("mathml", (draw_inline, None), (draw_block, None))
    app.connect("autodoc-process-signature", show_constructor)
