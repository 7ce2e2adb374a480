# SPDX-License-Identifier: Apache-2.0
"""The iteration of a fit: sum of squares and changes of the parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.estimate import Identification
from loopcal.report.figures.style import (
    COLORS,
    DOT,
    LINE,
    PALE,
    REFERENCE,
    SMALL,
    THIN,
    VERY_WIDE,
    finish_figure,
    label_axes,
    label_logarithmic,
    start_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST = 1e-16
"""Change in tolerances below which a number is rounding and drawn at this value."""


def draw_convergence(fit: Identification) -> Figure:
    """Draw the sum of squares and the distance of each parameter from its last value by step."""
    figure = start_figure(9.0, 3.9)
    panels: Any = figure.subplots(1, 2)
    _draw_cost(panels[0], fit)
    _draw_distances(panels[1], fit)
    words = fit.status.name.lower().replace("_", " ")
    return finish_figure(figure, f"{fit.robot.name}: {words} after {fit.history.iterations} steps")


def _draw_cost(axes: Axes, fit: Identification) -> None:
    """Draw the sum of squares of the residuals over sigma, and what noise alone would leave."""
    cost = np.asarray(fit.history.cost)
    axes.plot(np.arange(len(cost)), cost, "o-", color=COLORS[0], ms=DOT + 0.5, lw=LINE)
    degrees = fit.residual_test.degrees
    if np.isfinite(degrees) and degrees > 0.0 and not fit.residual_test.weighted:
        axes.axhline(degrees, color=REFERENCE, lw=THIN, ls="--", label="expected from the noise")
        axes.legend(frameon=False, fontsize=SMALL)
    if (cost > 0.0).all():
        axes.set_yscale("log")
        _thin_decades(axes)
    _set_steps(axes, len(cost))
    label_axes(axes, "step [1]", "sum of (residual/sigma)² [1]", "sum of squares")


def _draw_distances(axes: Axes, fit: Identification) -> None:
    """Draw how far each parameter is from its last value, in tolerances."""
    history = np.asarray(fit.history.estimate)
    distance = np.abs(history - history[-1])[:-1] / fit.tolerance
    steps = np.arange(len(distance))
    if distance.size:
        floored = np.maximum(distance, SMALLEST)
        axes.plot(steps, floored, color=PALE, lw=THIN)
        axes.plot(
            steps, floored.max(axis=1), "o-", color=COLORS[1], ms=DOT, lw=LINE, label="largest"
        )
        axes.plot([], [], color=PALE, lw=THIN, label="each parameter")
        axes.set_yscale("log")
        _thin_decades(axes)
        axes.legend(frameon=False, fontsize=SMALL)
    _set_steps(axes, len(history))
    label_axes(axes, "step [1]", "distance from the last value [tolerance]", "parameters")


def _set_steps(axes: Axes, count: int) -> None:
    """Number the steps from 0."""
    from matplotlib.ticker import MaxNLocator

    axes.set_xlim(-0.3, max(count - 1, 1) + 0.3)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _thin_decades(axes: Axes) -> None:
    """Write a few powers of ten as numbers; more numbers on a short axis."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    low, high = axes.yaxis.get_view_interval()
    if high < VERY_WIDE * low:
        label_logarithmic(axes.yaxis)
        return
    axes.yaxis.set_major_locator(LogLocator(numticks=8))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
