# SPDX-License-Identifier: Apache-2.0
"""The one style of all figures: colors, line widths, font sizes, labels with units.

The colors are those of Okabe and Ito, which color-blind readers can distinguish; the yellow is left
out, because it is pale on white. No figure uses color as the only difference between two series:
markers, lines or labels differ, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING, Any

from loopcal.plain_text import escape

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Of series in turn.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#7f7f7f")
MARKERS = "os^DvP<>"  # of series in turn
FRAME_COLORS = ("#b22222", "#228b22", "#1e3fae")  # of the axes x, y and z of a frame

POSE, ERROR = "#5b3a8e", "#c2185b"
"""Of measured poses and of their errors; no limb has these colors."""

DIVERGING, SEQUENTIAL = "RdBu_r", "viridis"
"""Color maps of numbers with a sign, and of numbers above zero."""

REFERENCE, PALE, DARK = "0.45", "0.75", "0.25"
"""Greys of reference lines, of what is in the background, and of outlines."""

LINE, THIN, GRID = 1.4, 0.9, 0.3
"""Widths of lines of data, of reference lines, and of the grid [pt]."""

DOT = 3.5  # size of the marker of a measured value [pt]

TITLE, LABEL, SMALL = 10, 9, 8
"""Sizes of the title of a figure, of axes, and of ticks and legends [pt]."""

MOST_LABELS, LONGEST = 45, 24
"""Number of labels of poses that fit below an axis, and characters of a label."""

CHARACTERS, HANDLE = 13.0, 7
"""Small characters of one inch, and those that the handle and the gaps of a legend take."""

MOST_COLUMNS = 8  # columns of a legend
FEW_TICKS = (1.0, 2.0, 5.0)  # numbers on a short logarithmic axis, times powers of ten
TICKS = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)  # numbers on a logarithmic axis, times powers of ten

WIDE, VERY_WIDE = 3.0, 100.0
"""Ratio of its ends from which a logarithmic axis has these numbers, and from which it has powers
of ten only; a shorter one has even steps.
"""


ZERO: dict[str, Any] = {"color": REFERENCE, "lw": THIN}
# Styles of a line at zero, and of a reference that data are compared with.
DASHED: dict[str, Any] = {**ZERO, "ls": "--"}


def start_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size [inch], which notebooks show without pyplot."""
    from loopcal.report.figures.notebook_figure import FigureLayout, NotebookFigure

    return NotebookFigure(figsize=(width, height), layout=FigureLayout())


def start_panels(
    width: float, height: float, rows: int, columns: int, **how: Any
) -> tuple[Figure, Any]:
    """Return a figure of this size [inch], and its panels (rows, columns); how : of `subplots`."""
    figure = start_figure(width, height)
    return figure, figure.subplots(rows, columns, squeeze=False, **how)


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
    """Write the title of a figure in lines that fit, show all names as written, and return it."""
    width = int(figure.get_size_inches()[0] * CHARACTERS * SMALL / TITLE)
    figure.suptitle("\n".join(fill(line, width) for line in title.splitlines()), fontsize=TITLE)
    return show_names(figure)


def add_legend(figure: Figure, most: int = MOST_COLUMNS) -> None:
    """Write a legend of everything drawn that has a label, each label once, below all axes, where
    no data are: as many columns as fit, at most `most`.
    """
    drawn: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            drawn.setdefault(label, handle)
    if drawn:
        columns = int(figure.get_size_inches()[0] * CHARACTERS / (max(map(len, drawn)) + HANDLE))
        figure.legend(
            drawn.values(),
            drawn.keys(),
            loc="outside lower center",
            ncols=min(max(columns, 1), most, len(drawn)),
            frameon=False,
            fontsize=SMALL,
        )


def add_colorbar(figure: Figure, drawn: Any, axes: Any, label: str, **how: Any) -> Any:
    """Draw and return the scale of the colors of a picture."""
    bar = figure.colorbar(drawn, ax=axes, **how)
    bar.set_label(label, fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL)
    return bar


def label_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Write the labels of rows, the first on top."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)


def label_poses(axes: Axes, labels: Sequence[str]) -> None:
    """Write labels of poses at x = 1, 2, ..; numbers where there are too many to read."""
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
        label_sparsely(axes.xaxis, 12)
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


def scale_logarithmically(axis: Any, numbers: Sequence[float] = TICKS, decades: int = 0) -> None:
    """Make an axis of matplotlib logarithmic, with plain numbers: these times powers of ten. On a
    long axis, and without `numbers`, there are at most so many `decades`, where these are given.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    low, high = axis.get_view_interval()
    is_short = high < VERY_WIDE * low
    if decades and not (is_short and numbers):
        axis.set_major_locator(LogLocator(numticks=decades))
    elif high > WIDE * low:
        axis.set_major_locator(LogLocator(subs=tuple(numbers) if is_short else (1.0,)))
    else:
        axis.set_major_locator(MaxNLocator(6))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def label_sparsely(axis: Any, most: int = 10, is_whole: bool = True, **how: Any) -> None:
    """Write at most so many numbers, or whole numbers, at an axis of matplotlib."""
    from matplotlib.ticker import MaxNLocator

    axis.set_major_locator(MaxNLocator(most, integer=is_whole, **how))


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
