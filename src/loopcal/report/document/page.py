# SPDX-License-Identifier: Apache-2.0
"""A document as one HTML file, which loads nothing.

Its content security policy allows only its own style sheet and the script of the 3-D view, both by
digest, and embedded images. A document without a scene has no script.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from loopcal.plain_text import escape
from loopcal.report.document.elements import Code, Document, Listing, Picture
from loopcal.report.scene.scene_data import load_script
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
    elements = (element for section in document.sections for element in section.elements)
    has_scene = any(isinstance(element, Picture) and element.scene for element in elements)
    script = load_script() if has_scene else ""
    allowed = f"script-src '{_digest(script)}'; " if script else ""
    policy = f"default-src 'none'; {allowed}style-src '{_digest(style)}'; img-src data:"
    return _load_template().render(
        document=document,
        style=style,
        script=script,
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        widest=WIDEST,
    )


def _digest(text: str) -> str:
    """Return the source of a content security policy that allows exactly this text."""
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"


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
