# SPDX-License-Identifier: Apache-2.0
"""Figures of matplotlib as SVG elements inside of HTML, under a strict content security policy.

Such a policy blocks `style` attributes, in which matplotlib writes colors and line widths, so they
become attributes of their own. Identifiers get a prefix, because a page has several figures. All
elements but those that draw are left out.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from loopcal.plain_text import escape
from loopcal.report.document.elements import Picture
from loopcal.report.pictures import render_svg_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SHAPES = ("path", "rect", "circle", "line", "polyline", "polygon", "text", "tspan", "image")
DRAWING = frozenset((*SHAPES, "svg", "g", "defs", "use", "clipPath", "linearGradient", "stop"))
"""Elements that draw."""

FAMILY = "DejaVu Sans, Verdana, Arial, sans-serif"
"""Fonts of all texts; a browser takes the first that it has."""

_FONT = re.compile(r"([a-z0-9 ]*?)\s*([0-9.]+)px(?:\s.*)?")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_DIGITS = re.compile(r"-?\d+\.\d{3,}")


def make_picture(
    figure: Figure, name: str, caption: str, description: str, scene: str = ""
) -> Picture:
    """Return a figure as a picture; see `Picture` for the arguments."""
    svg = inline_figure(render_svg_text(figure), name)
    return Picture(name, svg, caption, description, scene)


def inline_figure(svg: bytes, name: str) -> str:
    """Return an SVG file of matplotlib as elements for HTML; a name that is not plain text is
    shown with escapes.

    Parameters
    ----------
    name : prefix of all identifiers.
    """
    root = ElementTree.fromstring(escape(svg.decode("utf-8"), "\n\r\t"))
    drawn = _copy(root, name, {})
    for attribute in ("version", "height"):
        drawn.attrib.pop(attribute, None)
    drawn.set("stroke-linejoin", "round")
    drawn.set("role", "img")
    drawn.set("aria-labelledby", f"{name}-description")
    drawn.set("focusable", "false")
    return ElementTree.tostring(drawn, encoding="unicode")


def _copy(
    element: ElementTree.Element, name: str, styles: dict[str, dict[str, str]]
) -> ElementTree.Element:
    """Return an element without namespaces, styles and what does not draw.

    Parameters
    ----------
    styles : the attributes of each style that occurred before; gets new ones.
    """
    copied = ElementTree.Element(element.tag.rpartition("}")[2])
    for key, value in element.attrib.items():
        attribute = key.rpartition("}")[2]
        if attribute == "style":
            if value not in styles:
                styles[value] = _split_style(value, name)
            copied.attrib |= styles[value]
        elif attribute == "id":
            copied.set("id", f"{name}-{value}")
        elif attribute == "href":
            copied.set("href", _address(value, name))
        elif attribute == "transform":
            copied.set(attribute, value)
        elif not attribute.startswith("on"):
            copied.set(attribute, _shorten(_refer(value, name)))
    copied.text, copied.tail = _word(element.text), _word(element.tail)
    for child in element:
        if isinstance(child.tag, str) and child.tag.rpartition("}")[2] in DRAWING:
            copied.append(_copy(child, name, styles))
    return copied


def _split_style(style: str, name: str) -> dict[str, str]:
    """Return the properties of a `style` attribute as attributes of their own."""
    attributes = {}
    for declaration in style.split(";"):
        prop, _, value = (part.strip() for part in declaration.partition(":"))
        if prop == "font":
            match = _FONT.match(value)
            assert match is not None, value
            attributes |= {"font-size": match[2], "font-family": FAMILY}
            if "bold" in match[1] or "700" in match[1]:
                attributes["font-weight"] = "bold"
        elif prop and value:
            attributes[prop] = _shorten(_refer(value, name))
    return attributes


def _refer(value: str, name: str) -> str:
    """Return a value with the prefix in its references to other elements."""
    return _REFERENCE.sub(rf"url(#{name}-\1)", value)


def _shorten(value: str) -> str:
    """Return a value with at most two decimals: a hundredth of a point cannot be seen."""
    return _DIGITS.sub(lambda m: f"{float(m[0]):.2f}", value)


def _address(address: str, name: str) -> str:
    """Return the address of an element or image of the file; any other is left out."""
    if address.startswith("#"):
        return f"#{name}-{address[1:]}"
    return address if address.startswith("data:image/png;base64,") else ""


def _word(text: str | None) -> str | None:
    """Return text without the line breaks between elements."""
    return None if text is None or not text.strip() else text
