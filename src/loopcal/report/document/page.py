# SPDX-License-Identifier: Apache-2.0
"""A document as one HTML file, which loads nothing and runs no program.

Its content security policy allows only its own style sheet, by digest, and embedded images.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.plain_text import escape
from loopcal.report.document.elements import Code, Document, Listing, Picture
from loopcal.report.tables import Table

if TYPE_CHECKING:
    from jinja2 import Template

TEMPLATE, STYLE = "report.html.j2", "report.css"
FOLDER = Path(__file__).parent

WIDEST = 6
"""Columns from which a table is set in a smaller font."""


def render_html(document: Document) -> str:
    """Return a document as HTML; a name that is not plain text is shown with escapes."""
    style = (FOLDER / STYLE).read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; base-uri 'none'"
    return _load_template().render(
        document=document, style=style, policy=f"{policy}; form-action 'none'", widest=WIDEST
    )


@cache
def _load_template() -> Template:
    """Return the template, with its tests for elements; text is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def show(value: Any) -> Any:
        is_text = isinstance(value, str) and not isinstance(value, Markup)
        return escape(value, "\n") if is_text else value

    environment = Environment(
        loader=FileSystemLoader(FOLDER),
        autoescape=True,
        finalize=show,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name, kind in (
        ("table", Table),
        ("picture", Picture),
        ("listing", Listing),
        ("code", Code),
    ):
        environment.tests[name] = lambda value, kind=kind: isinstance(value, kind)
    return environment.get_template(TEMPLATE)
