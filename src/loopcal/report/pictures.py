# SPDX-License-Identifier: Apache-2.0
"""Pictures as files, with identical bytes for identical content."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from loopcal.errors import FileError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".svg", ".pdf")
DPI = 150
"""Resolution of a PNG picture."""

PLACES = 4
"""Decimals of the position of axes, as a share of the figure."""

SALT = "loopcal"
"""Identifiers in an SVG are random without a salt."""

METADATA: dict[str, dict[str, None]] = {
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}
"""The time of writing, which is left out, by format."""


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

    Parameters
    ----------
    write : writes bytes to a file, such as `loopcal.io.core.text_file.write_bytes`.

    Raises
    ------
    FileError : the ending of the name is not one of `FORMATS`.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise FileError(
            f"a picture cannot be written as {path.suffix or 'no format'!r}. Use a name that ends "
            "in "
            f"{', '.join(FORMATS)}",
            path,
        )
    write(path, render_figure(figure, ending))
