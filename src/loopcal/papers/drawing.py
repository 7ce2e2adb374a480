# SPDX-License-Identifier: Apache-2.0
"""Figures drawn by matplotlib from data; a label has the same color in all figures of a study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from loopcal.papers.reproduction import Figure

COLORS, MARKERS = 10, "osD^vPX"
LEVEL = "0.35"
"""Grey of a horizontal line that belongs to no series."""
UNNAMED = "0.82"
"""Grey of a series without a name in the legend."""
DASHES = ("--", ":", "-.")
LEGEND = 100
"""Characters that a row of the legend holds."""


def choose_styles(figures: Sequence[Figure]) -> dict[str, dict[str, Any]]:
    """Return color and marker of each named label; labels of one figure differ in color."""
    chosen: dict[str, int] = {}
    named = [[s.label for s in figure.series if s.is_named] for figure in figures]
    for label in dict.fromkeys(label for labels in named for label in labels):
        beside = {other for labels in named if label in labels for other in labels}
        taken = {chosen[other] for other in beside if other in chosen}
        chosen[label] = next((i for i in range(COLORS) if i not in taken), len(chosen) % COLORS)
    return {
        label: {"color": f"C{color}", "marker": MARKERS[i % len(MARKERS)]}
        for i, (label, color) in enumerate(chosen.items())
    }


def png(figure: Figure, style: Mapping[str, Mapping[str, Any]]) -> bytes:
    """Draw a figure; return the bytes of a PNG file.

    Parameters
    ----------
    figure : what to draw. style : of every named label, see `choose_styles`.
    """
    stream = BytesIO()
    draw(figure, style).savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def draw(figure: Figure, style: Mapping[str, Mapping[str, Any]]) -> Canvas:
    """Draw a figure with its legend below the axes; arguments as for `png`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas
    from matplotlib.ticker import MaxNLocator

    canvas = Canvas(figsize=(7.2, 4.6), dpi=150, layout="constrained")
    FigureCanvasAgg(canvas)
    axes = canvas.add_subplot()
    for series in sorted(figure.series, key=lambda series: series.is_named):
        if not series.is_named:
            axes.plot(series.x, series.y, color=UNNAMED, linewidth=1.0, label=series.label)
            continue
        axes.plot(
            series.x,
            series.y,
            label=series.label,
            markersize=5,
            linewidth=1.5 * figure.joined,
            fillstyle="full" if figure.joined else "none",  # points on points stay visible
            **style[series.label],
        )
    for i, (label, value) in enumerate(figure.levels.items()):
        related = next((style[s.label]["color"] for s in figure.series if s.label in label), LEVEL)
        dashes = DASHES[i % len(DASHES)]
        axes.axhline(value, color=related, linestyle=dashes, linewidth=1.4, label=label)
    if "x" in figure.log:
        axes.set_xscale("log")
    elif all(float(x).is_integer() for series in figure.series for x in series.x):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if "y" in figure.log:
        axes.set_yscale("log")
    axes.set(title=figure.title, xlabel=figure.x_label, ylabel=figure.y_label)
    axes.grid(visible=True, color="0.9", linewidth=0.8)
    longest = max(len(text) for text in axes.get_legend_handles_labels()[1])
    columns = max(1, min(6, LEGEND // (longest + 6)))  # a marker is as wide as some 6 characters
    canvas.legend(
        fontsize=8.5, loc="outside lower center", ncols=columns
    )  # below the axes, where no data are
    return canvas
