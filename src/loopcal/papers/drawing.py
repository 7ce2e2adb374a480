# SPDX-License-Identifier: Apache-2.0
"""Figures drawn by matplotlib from data; a label has the same color in all figures of a paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopcal.papers.reproduction import Figure

MARKERS = "osD^vPX"
LEVEL = "0.35"
"""Grey of a horizontal line."""
LEGEND = 100
"""Characters that a row of the legend holds."""


def styles(figures: Sequence[Figure]) -> dict[str, dict[str, Any]]:
    """Return colour and marker of each label."""
    labels = dict.fromkeys(series.label for figure in figures for series in figure.series)
    return {
        label: {"color": f"C{i % 10}", "marker": MARKERS[i % len(MARKERS)]}
        for i, label in enumerate(labels)
    }


def png(figure: Figure, style: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw a figure; return the bytes of a PNG file.

    Parameters
    ----------
    figure : what to draw. style : of every label, see `styles`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas
    from matplotlib.ticker import MaxNLocator

    canvas = Canvas(figsize=(7.2, 4.6), dpi=150, layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    for series in figure.series:
        axes.plot(
            series.x,
            series.y,
            label=series.label,
            markersize=5,
            linewidth=1.5 * figure.joined,
            **style[series.label],
        )
    for label, value in figure.levels.items():
        axes.axhline(value, color=LEVEL, linestyle="--", linewidth=1.2)
        place = {"xycoords": ("axes fraction", "data"), "ha": "left", "va": "bottom"}
        axes.annotate(label, (0.008, value), fontsize=8.5, color=LEVEL, **place)
    if "x" in figure.log:
        axes.set_xscale("log")
    elif all(float(x).is_integer() for series in figure.series for x in series.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if "y" in figure.log:
        axes.set_yscale("log")
    axes.set(title=figure.title, xlabel=figure.x_label, ylabel=figure.y_label)
    axes.grid(visible=True, color="0.9", linewidth=0.8)
    longest = max(len(series.label) for series in figure.series)
    columns = max(1, min(6, LEGEND // (longest + 6)))  # a marker is as wide as some 6 characters
    canvas.legend(
        fontsize=8.5, loc="outside lower center", ncols=columns
    )  # below the axes, where no data are
    stream = BytesIO()
    canvas.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
