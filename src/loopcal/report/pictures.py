# SPDX-License-Identifier: Apache-2.0
"""Pictures as files and inside of HTML, with identical bytes for identical content."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from loopcal.errors import FileError
from loopcal.plain_text import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
DPI = 150  # resolution of a PNG picture
POINTS = 72  # units of an inch in an SVG picture
PLACES = 4  # decimals of the position of axes, as a share of the figure
SALT = "loopcal"  # identifiers in an SVG are random without a salt
# The time of writing, which is left out, by format.
METADATA: dict[str, dict[str, None]] = {
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


@contextmanager
def _fixed_layout(figure: Figure) -> Iterator[None]:
    """Arrange the axes of a figure, and keep them in place at rounded positions.

    The solver of the layout adds numbers in another order each time. The digits of an SVG file
    show that.
    """
    engine = figure.get_layout_engine()
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    is_arranged = [(axes, axes.get_in_layout()) for axes in figure.axes]
    _round_positions(figure)
    try:
        yield
    finally:
        for axes, is_in_layout in is_arranged:
            axes.set_in_layout(is_in_layout)
        figure.set_layout_engine(engine)


def _round_positions(figure: Figure) -> None:
    """Round the positions of all axes."""
    for axes in figure.axes:
        x, y, width, height = (round(v, PLACES) for v in axes.get_position(original=True).bounds)
        axes.set_position((x, y, width, height))


def render_figure(figure: Figure, ending: str) -> bytes:
    """Return a figure as a file with this ending, one of `FORMATS`."""
    from matplotlib import rc_context

    stream = BytesIO()
    with rc_context({"svg.hashsalt": SALT}), _fixed_layout(figure):
        figure.savefig(stream, format=ending[1:], dpi=DPI, metadata=METADATA[ending])
    return stream.getvalue()


def save_figure(path: Path, figure: Figure, *, write: Callable[[Path, bytes], object]) -> None:
    """Write a figure to a file.

    write : writes bytes to a file, such as `loopcal.io.core.text_file.write_bytes`.

    FileError : the ending of the name is not one of `FORMATS`.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(
            f"loopcal cannot write a picture as {path.suffix or 'no format'!r}. Use a name that "
            "ends in "
            f"{', '.join(FORMATS)}",
            path,
        )
    write(path, render_figure(figure, ending))


# Figures of matplotlib as SVG elements inside of HTML, under a strict content security policy.

SHAPES = ("path", "rect", "circle", "line", "polyline", "polygon", "text", "tspan", "image")
# Elements that draw.
DRAWING = frozenset((*SHAPES, "svg", "g", "defs", "use", "clipPath", "linearGradient", "stop"))
# Fonts of all texts; a browser takes the first that it has.
FAMILY = "DejaVu Sans, Verdana, Arial, sans-serif"
_FONT = re.compile(r"([a-z0-9 ]*?)\s*([0-9.]+)px(?:\s.*)?")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_DIGITS = re.compile(r"-?\d+\.\d{3,}")


def inline_figure(figure: Figure, name: str) -> str:
    """Return a figure as SVG elements for HTML; names that are not plain text are escaped.

    name : prefix of all identifiers.
    """
    svg = _render_svg(figure).decode("utf-8")
    root = ElementTree.fromstring(escape(svg, "\n\r\t"))
    drawn = _copy(root, name, {})
    for attribute in ("version", "height"):
        drawn.attrib.pop(attribute, None)
    drawn.set("stroke-linejoin", "round")
    drawn.set("role", "img")
    drawn.set("aria-labelledby", f"{name}-description")
    drawn.set("focusable", "false")
    return ElementTree.tostring(drawn, encoding="unicode")


def _render_svg(figure: Figure) -> bytes:
    """Return a figure as SVG whose texts stay text, in a font of the reader.

    The layout is computed once, in the units of the picture, so that texts are measured once:
    saving would compute it twice, and draw twice.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    figure.set_dpi(POINTS)
    if (layout := figure.get_layout_engine()) is not None:
        layout.execute(figure)
        figure.set_layout_engine("none")
        _round_positions(figure)
    stream = BytesIO()
    with rc_context({"svg.hashsalt": SALT, "svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(stream, metadata=METADATA[".svg"])
    return stream.getvalue()


def _copy(
    element: ElementTree.Element, name: str, styles: dict[str, dict[str, str]]
) -> ElementTree.Element:
    """Return an element without namespaces, styles and what does not draw.

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
