# SPDX-License-Identifier: Apache-2.0
"""What a document consists of: sections with sentences, lists, tables, pictures and lines of code.

A sentence is a `str`; a table is the one that the terminal shows, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from loopcal.report.tables import Table


@dataclass(frozen=True)
class Picture:
    """A figure as SVG elements for HTML.

    Parameters
    ----------
    name : prefix of its identifiers. svg : see `inline_figure`. caption : shown below it.
    description : what it shows, for readers who do not see it.
    scene : JSON of a scene, which replaces the figure where a browser has WebGL; empty without.
    """

    name: str
    svg: str = field(repr=False)
    caption: str
    description: str
    scene: str = field(default="", repr=False)


@dataclass(frozen=True)
class Listing:
    """Labels with sentences, such as the severity and text of findings."""

    items: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Code:
    """Lines to copy, such as those of a controller's file, with a title."""

    title: str
    text: str


Element = str | Table | Picture | Listing | Code


@dataclass(frozen=True)
class Section:
    """A heading with its content.

    Parameters
    ----------
    name : identifier, to link to it. elements : the content in order; without any the section is
        left out.
    """

    name: str
    title: str
    elements: tuple[Element, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON; of pictures the caption and description."""
        return {
            "name": self.name,
            "title": self.title,
            "elements": [_describe(element) for element in self.elements],
        }


@dataclass(frozen=True)
class Document:
    """Sections below a title.

    Parameters
    ----------
    verdict : name of the verdict, such as `not_calibrated`, which decides the color of the head;
        empty without a verdict.
    summary : the one sentence below the title. made_by : program and version.
    """

    title: str
    verdict: str
    summary: str
    made_by: str
    sections: tuple[Section, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        return {
            "title": self.title,
            "verdict": self.verdict,
            "summary": self.summary,
            "made_by": self.made_by,
            "sections": [section.to_dict() for section in self.sections],
        }


def _describe(element: Element) -> dict[str, Any]:
    """Return an element for JSON, under the word that says what it is."""
    if isinstance(element, str):
        return {"sentence": element}
    if isinstance(element, Table):
        columns = [column.heading for column in element.columns]
        return {"table": element.caption, "columns": columns, "rows": element.rows}
    if isinstance(element, Picture):
        return {"picture": element.caption, "description": element.description}
    if isinstance(element, Listing):
        return {"list": [{"label": label, "text": text} for label, text in element.items]}
    return {"code": element.title, "text": element.text}
