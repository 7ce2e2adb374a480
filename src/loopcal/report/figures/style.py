# SPDX-License-Identifier: Apache-2.0
"""The one style of all figures: colors, line widths, font sizes, labels with units.

The colors are those of Okabe and Ito, which color-blind readers can distinguish; the yellow is left
out, because it is pale on white. No figure uses color as the only difference between two series:
markers, lines or labels differ, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from loopcal.plain_text import escape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#7f7f7f")
"""Of series in turn."""

MARKERS = "os^DvP<>"
"""Of series in turn."""

FRAME_COLORS = ("#b22222", "#228b22", "#1e3fae")
"""Of the axes x, y and z of a frame."""

POSE, ERROR = "#5b3a8e", "#c2185b"
"""Of measured poses and of their errors; no limb has these colors."""

DIVERGING, SEQUENTIAL = "RdBu_r", "viridis"
"""Color maps of numbers with a sign, and of numbers above zero."""

REFERENCE, PALE, DARK = "0.45", "0.75", "0.25"
"""Greys of reference lines, of what is in the background, and of outlines."""

LINE, THIN, GRID = 1.4, 0.9, 0.3
"""Widths of lines of data, of reference lines, and of the grid [pt]."""

DOT = 3.5
"""Size of the marker of a measured value [pt]."""

TITLE, LABEL, SMALL = 10, 9, 8
"""Sizes of the title of a figure, of axes, and of ticks and legends [pt]."""

MOST_LABELS, LONGEST = 45, 24
"""Number of labels of poses that fit below an axis, and characters of a label."""

CHARACTERS, HANDLE = 13.0, 7
"""Small characters of one inch, and those that the handle and the gaps of a legend take."""

MOST_COLUMNS = 8
"""Columns of a legend."""

FEW_TICKS = (1.0, 2.0, 5.0)
"""Numbers on a short logarithmic axis, times powers of ten."""

TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
"""Numbers on a logarithmic axis, times powers of ten."""

WIDE, VERY_WIDE = 3.0, 100.0
"""Ratio of its ends from which a logarithmic axis has these numbers, and from which it has powers
of ten only; a shorter one has even steps.
"""


def start_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size [inch], which notebooks show without pyplot."""
    from loopcal.report.figures.notebook_figure import make_figure

    return make_figure(width, height)


def label_axes(axes: Axes, x: str, y: str, title: str = "", grid: bool = True) -> None:
    """Write the labels of axes and their title, and draw a grid behind the data."""
    axes.set_xlabel(x, fontsize=LABEL)
    axes.set_ylabel(y, fontsize=LABEL)
    if title:
        axes.set_title(title, fontsize=LABEL, y=1.0)  # else matplotlib looks for free space
    axes.tick_params(labelsize=SMALL)
    axes.set_axisbelow(True)
    if grid:
        axes.grid(visible=True, lw=GRID)


def finish_figure(figure: Figure, title: str) -> Figure:
    """Write the title of a figure, and show all names as they are written; return it."""
    figure.suptitle(title, fontsize=TITLE)
    return show_names(figure)


def add_legend(figure: Figure, handles: list[Any], most: int = MOST_COLUMNS) -> None:
    """Write a legend below all axes, where no data are: as many columns as fit, at most `most`."""
    if handles:
        longest = max(len(str(handle.get_label())) for handle in handles) + HANDLE
        columns = int(figure.get_size_inches()[0] * CHARACTERS / longest)
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=min(max(columns, 1), most, len(handles)),
            frameon=False,
            fontsize=SMALL,
        )


def label_poses(axes: Axes, labels: Sequence[str]) -> None:
    """Write labels of poses at x = 1, 2, ..; numbers where there are too many to read."""
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(0.3, len(labels) + 0.7)
    if len(labels) <= MOST_LABELS:
        is_long = max(map(len, labels), default=0) > 3
        axes.set_xticks(
            range(1, len(labels) + 1),
            [shorten(label) for label in labels],
            rotation=45 if is_long else 0,
            ha="right" if is_long else "center",
        )
        axes.set_xlabel("pose", fontsize=LABEL)
    else:
        axes.xaxis.set_major_locator(MaxNLocator(12, integer=True))
        axes.set_xlabel("number of the pose, in order of measurement [1]", fontsize=LABEL)


def shorten(name: str, length: int = LONGEST) -> str:
    """Return a name of at most so many characters; three dots stand for its middle. Characters that
    are not plain text are shown as escapes.
    """
    name = escape(name)
    if len(name) <= length:
        return name
    half = (length - 1) // 2
    return f"{name[:half]}…{name[-half:]}"


def label_logarithmic(axis: Any, numbers: Sequence[float] = TICKS) -> None:
    """Write plain numbers at a logarithmic axis of matplotlib: these times powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    low, high = axis.get_view_interval()
    subs = tuple(numbers) if high < VERY_WIDE * low else (1.0,)
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
