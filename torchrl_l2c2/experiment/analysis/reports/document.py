"""A page that needs no other file and no network: its style and its pictures are inside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem;
  color: #222; background: #fff; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .25rem .6rem; border-bottom: 1px solid #ddd; }
th { vertical-align: bottom; border-bottom: 2px solid #888; }
td { white-space: nowrap; } img { max-width: 100%; } p { font-size: 13px; color: #555; }
"""


def whole_page(title: str, parts: Iterable[str], style: str = "") -> str:
    """Returns a page of these elements.

    Args:
        title (str): title of the browser window.
        parts (iterable of str): elements, as HTML.
        style (str): CSS rules in addition to ``STYLE``.
    """
    head = (
        f'<meta charset="utf-8"><title>{html.escape(title)}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}{style}</style>"
    )
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n'
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def picture(description: str, content: bytes) -> str:
    """An SVG picture as an element."""
    return f'<img alt="{html.escape(description)}" src="{inside(content, "image/svg+xml")}">'


def inside(content: bytes, kind: str) -> str:
    """What takes the place of a file's address.

    Examples:
        >>> inside(b"ab", "text/plain")
        'data:text/plain;base64,YWI='
    """
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
