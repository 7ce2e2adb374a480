# SPDX-License-Identifier: Apache-2.0
"""Pictures as files: names as they are written, and identical bytes for identical content."""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.parsers import expat

from loopcal.errors import FileError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
DPI = 150
"""Resolution of a PNG picture."""

SALT = "loopcal"
"""Identifiers in an SVG are random without a salt."""

_PDF_END = re.compile(rb"startxref\s+(\d+)\s+%%EOF\s*\Z")
"""End of a PDF file, with the place of its table of objects."""

METADATA: dict[str, dict[str, None]] = {
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""The time of writing, which is left out, by format."""

TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Numbers on a logarithmic axis, times powers of ten."""

WIDE, VERY_WIDE = 3.0, 100.0
"""Ratio of its ends from which a logarithmic axis has these numbers, and from which it has powers
of ten only; a shorter one has even steps.
"""


def label_logarithmic(axis: Any) -> None:
    """Write plain numbers at a logarithmic axis of matplotlib."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    low, high = axis.get_view_interval()
    subs = TICKS if high < VERY_WIDE * low else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs) if high > WIDE * low else MaxNLocator(6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def show_names(figure: Figure) -> Figure:
    r"""Show all texts of a figure as they are written; return it.

    matplotlib reads what stands between two `$` as mathematics: `$\frac{` in the name of a robot
    would make it fail.
    """
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)
    return figure


def check_picture(path: Path) -> None:
    """Read a picture that was written; raise an exception where it is not complete.

    PNG is decoded, SVG is parsed, and of PDF the first line and the place of its table of objects
    are read.
    """
    if path.suffix.lower() == ".png":
        from matplotlib.image import imread

        imread(path)
        return
    content = path.read_bytes()
    if path.suffix.lower() == ".svg":
        expat.ParserCreate().Parse(content, True)
        return
    end = _PDF_END.search(content)
    if not content.startswith(b"%PDF-") or end is None or content[int(end[1]) :][:4] != b"xref":
        raise FileError("this picture is not a complete PDF file", path)


def render_figure(figure: Figure, ending: str) -> bytes:
    """Return a figure as a file with this ending, one of `FORMATS`."""
    from matplotlib import rc_context

    stream = BytesIO()
    with rc_context({"svg.hashsalt": SALT}):
        figure.savefig(stream, format=ending[1:], dpi=DPI, metadata=METADATA[ending])
    return stream.getvalue()
