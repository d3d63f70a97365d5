"""HTML pages from the templates: each is one file that needs no network."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any


def render(template: str, **values: Any) -> str:
    """Fills a template of ``templates/``.

    Args:
        template (str): The file's name.
        **values: Values of the template's variables.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent / "templates")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    return environment.get_template(template).render(**values) + "\n"


def data_uri(content: bytes, kind: str = "image/svg+xml") -> str:
    """Returns the content of a file as an address.

    Examples:
        >>> data_uri(b"ab", "text/plain")
        'data:text/plain;base64,YWI='
    """
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
