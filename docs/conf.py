"""The documentation's site: ``python -m sphinx -W docs build/site``.

Nothing is fetched, neither to build the site nor to read it: equations become MathML, which
browsers draw themselves, and references to other projects are not linked.
"""

from __future__ import annotations

from typing import Any

from docutils import nodes
from math_core import LatexToMathML
from sphinx.application import Sphinx

from torchrl_l2c2 import __version__

project = "torchrl_l2c2"
author = "The torchrl_l2c2 authors"
copyright = author
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
napoleon_use_ivar = True
python_use_unqualified_type_names = True

# A reference to this package that leads nowhere is an error; others have no page here.
nitpicky = True
nitpick_ignore_regex = [("py:.*", r"(?!torchrl_l2c2).*")]

html_theme = "furo"
html_title = f"torchrl_l2c2 {__version__}"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_copy_source = False
html_math_renderer = "mathml"

to_mathml = LatexToMathML()


def draw_inline(writer: Any, node: nodes.math) -> None:
    mathml = to_mathml.convert_with_local_state(node.astext(), displaystyle=False)
    writer.body.append(mathml)
    raise nodes.SkipNode


def draw_block(writer: Any, node: nodes.math_block) -> None:
    equation = node.astext()
    if "\\\\" in equation:
        equation = rf"\begin{{aligned}}{equation}\end{{aligned}}"
    mathml = to_mathml.convert_with_local_state(equation, displaystyle=True)
    writer.body.append(f'<div class="math">{mathml}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    app.add_html_math_renderer("mathml", (draw_inline, None), (draw_block, None))
