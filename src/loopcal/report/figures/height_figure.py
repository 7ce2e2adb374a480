# SPDX-License-Identifier: Apache-2.0
"""Errors of measured heights over x and y, before and after calibration."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.apply import HeightErrors
from loopcal.findings.wording import count_decimals
from loopcal.report.figures.style import (
    DARK,
    DIVERGING,
    LABEL,
    SMALL,
    add_legend,
    finish_figure,
    label_axes,
    start_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_NUMBERS = 40
"""Points up to which each has its error as a number."""

MARKERS = {"fitted": "o", "held-out": "s"}
"""Of points that the fit used, and of those that it did not."""

AREA, MARGIN = 110.0, 0.16
"""Area of a marker [pt^2], and margin around the points as a share of their range."""


def draw_height_errors(heights: HeightErrors) -> Figure:
    """Draw the errors of heights over x and y, before and after, with one scale of colors.

    Circles are points of the fit, squares are held out.
    """
    factor = heights.unit.factor_to_si
    limit = float(np.abs(np.concatenate([heights.before, heights.after])).max()) / factor or 1.0
    figure = start_figure(10.0, 5.2)
    panels: Any = figure.subplots(1, 2)
    points = None
    for axes, name in zip(panels, ("before", "after"), strict=True):
        points = _draw_panel(axes, heights, name, limit)
    assert points is not None
    bar = figure.colorbar(points, ax=list(panels), aspect=24, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL)
    symbol = heights.unit.symbol
    bar.ax.set_ylabel(f"height error, predicted - measured [{symbol}]", fontsize=LABEL)
    add_legend(figure, _list_handles(heights))
    count = len(heights.poses)
    return finish_figure(figure, f"Height errors at {count} points")


def _draw_panel(axes: Axes, heights: HeightErrors, name: str, limit: float) -> Any:
    """Draw the errors before or after; return the points with their scale of colors."""
    factor, symbol = heights.unit.factor_to_si, heights.unit.symbol
    x, y = heights.points.T / factor
    errors = getattr(heights, name) / factor
    drawn = None
    for of_set, is_held_out in heights.list_sets():
        chosen = heights.is_held_out == is_held_out
        drawn = axes.scatter(
            x[chosen], y[chosen], c=errors[chosen], cmap=DIVERGING, vmin=-limit, vmax=limit,
            s=AREA, marker=MARKERS[of_set], ec=DARK, lw=0.7,
        )  # fmt: skip
    if len(errors) <= MOST_NUMBERS:
        decimals = count_decimals(limit)
        for place, value in zip(zip(x, y, strict=True), errors, strict=True):
            axes.annotate(
                f"{round(float(value), decimals) + 0.0:+.{decimals}f}", place, (0, 8),
                textcoords="offset points", ha="center", fontsize=SMALL,
            )  # fmt: skip
    rms = [
        f"{of_set} {heights.statistics(name, is_held_out).rms / factor:.3g}"
        for of_set, is_held_out in heights.list_sets()
    ]
    title = f"{name} calibration: rms {', '.join(rms)} {symbol}"
    label_axes(axes, f"x [{symbol}]", f"y [{symbol}]" if name == "before" else "", title)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(MARGIN)
    return drawn


def _list_handles(heights: HeightErrors) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    words = {"fitted": "used in the fit", "held-out": "held out"}
    return [
        Line2D([], [], ls="none", marker=MARKERS[n], mfc="none", mec=DARK, label=words[n])
        for n, _ in heights.list_sets()
    ]
