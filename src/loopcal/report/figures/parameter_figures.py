# SPDX-License-Identifier: Apache-2.0
"""Parameters of a fit: shifts with their intervals, uncertainties, and correlations."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.mechanism import Mechanism
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DIVERGING,
    DOT,
    FEW_TICKS,
    LABEL,
    PALE,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_logarithmic,
    shorten,
    start_figure,
)
from loopcal.report.numbers import format_uncertainty, format_with_uncertainty
from loopcal.typing import FloatArray, IntArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_ROWS = 50
"""Parameters of one column of panels."""

MOST_NAMES = 110
"""Parameters up to which a picture of correlations names each one."""

RATIO = "1"
"""Symbol of a ratio, which stands at no number."""

SHIFT, WIDTH = COLORS[0], COLORS[1]
"""Colors of shifts and of uncertainties."""


class FittedParameters(Protocol):
    """What these figures use of a fit, an `Identification` or a stored one."""

    @property
    def robot(self) -> Mechanism:
        """Its robot, with the estimates."""
        ...

    @property
    def free_parameters(self) -> FreeParameters:
        """The free parameters with nominal values and tolerances."""
        ...

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates."""
        ...

    @property
    def covariance(self) -> FloatArray:
        """(p, p) covariance of the estimates."""
        ...

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) standard deviations."""
        ...

    @property
    def converged(self) -> bool:
        """Whether the iteration converged."""
        ...

    def interval(self) -> FloatArray:
        """Return half-widths (p,) of the 95 % intervals."""
        ...


def draw_parameters(fit: FittedParameters) -> Figure:
    """Draw the shift of each parameter in tolerances with its 95 % interval, its uncertainty in
    tolerances, and both as numbers in the unit of the robot's file.

    Of a fit that did not converge only the last values are drawn, without intervals.
    """
    from matplotlib.lines import Line2D

    p = len(fit.free_parameters.names)
    columns = max(-(-p // MOST_ROWS), 1)
    chunks = np.array_split(np.arange(p), columns)
    figure = start_figure(8.2 * columns, 1.6 + 0.19 * max(len(chunk) for chunk in chunks))
    axes_grid: Any = figure.subplots(1, 2 * columns, squeeze=False, width_ratios=[3, 2] * columns)
    for i, chunk in enumerate(chunks):
        _draw_shifts(axes_grid[0, 2 * i], fit, chunk)
        _draw_uncertainties(axes_grid[0, 2 * i + 1], fit, chunk)
    handles = [
        Line2D([], [], color=SHIFT, marker="o", ms=DOT, lw=1.2, label="shift, 95 % interval"),
        Line2D([], [], color=WIDTH, marker="s", ms=DOT, ls="none", label="uncertainty (95 %)"),
        Line2D([], [], color=SHIFT, marker="x", ms=DOT + 1, ls="none", label="without an interval"),
        Line2D([], [], color=PALE, lw=6, alpha=0.5, label="one tolerance"),
    ]
    add_legend(figure, handles)
    status = "" if fit.converged else "; not converged: last values, no estimates"
    n_assumed = int(fit.free_parameters.assumed.sum())
    assumed = f"; {n_assumed} tolerances are assumed" if n_assumed else ""
    return finish_figure(figure, f"{fit.robot.name}: {_count(p)}{assumed}{status}")


def _count(parameters: int) -> str:
    """Return a number of parameters in words."""
    return "1 parameter" if parameters == 1 else f"{parameters} parameters"


def _half_widths(fit: FittedParameters) -> FloatArray:
    """Return half-widths (p,) of the 95 % intervals in tolerances; NaN or infinite without."""
    if not fit.converged:
        return np.full(len(fit.free_parameters.names), np.nan)
    return fit.interval() / fit.free_parameters.tolerance


def _draw_shifts(axes: Axes, fit: FittedParameters, chunk: IntArray) -> None:
    """Draw estimate minus nominal value in tolerances, with the 95 % interval."""
    shift = ((fit.estimate - fit.free_parameters.nominal) / fit.free_parameters.tolerance)[chunk]
    half, y = _half_widths(fit)[chunk], np.arange(len(chunk))
    known = np.isfinite(half)
    axes.axvspan(-1.0, 1.0, color=PALE, alpha=0.35, lw=0.0, zorder=0)
    axes.axvline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    axes.errorbar(
        shift[known],
        y[known],
        xerr=half[known],
        fmt="o",
        color=SHIFT,
        ms=DOT,
        elinewidth=1.2,
        capsize=1.5,
    )
    axes.plot(shift[~known], y[~known], "x", color=SHIFT, ms=DOT + 1)
    _set_rows(axes, [shorten(fit.free_parameters.names[i]) for i in chunk])
    label_axes(axes, "estimate - nominal [tolerance]", "", "shift")


def _draw_uncertainties(axes: Axes, fit: FittedParameters, chunk: IntArray) -> None:
    """Draw the half-width of the 95 % interval in tolerances; the numbers are at the right."""
    half, y = _half_widths(fit)[chunk], np.arange(len(chunk))
    drawn = np.isfinite(half) & (half > 0.0)
    axes.axvline(1.0, color=REFERENCE, lw=THIN, ls="--", zorder=1)
    axes.plot(half[drawn], y[drawn], "s", color=WIDTH, ms=DOT)
    if drawn.any():
        axes.set_xlim(0.6 * min(half[drawn].min(), 1.0), 1.7 * max(half[drawn].max(), 1.0))
        axes.set_xscale("log")
        label_logarithmic(axes.xaxis, FEW_TICKS)
    else:
        axes.set_xticks([])
    factor, symbols = fit.free_parameters.display()
    symbols = ["" if symbol == RATIO else f" {symbol}" for symbol in symbols]
    widths = half * fit.free_parameters.tolerance[chunk] / factor[chunk]
    estimate = (fit.estimate / factor).tolist()
    numbers = [
        f"{format_with_uncertainty(estimate[i], width)} ± {format_uncertainty(width)}{symbols[i]}"
        for i, width in zip(chunk, widths.tolist(), strict=True)
    ]
    if not fit.converged:
        numbers = [f"{estimate[i]:.3g}{symbols[i]}" for i in chunk]
    axes.yaxis.tick_right()
    _set_rows(axes, numbers)
    label = "half-width [tolerance]" if drawn.any() else ""
    title = "uncertainty (95 %)" if drawn.any() else "without an interval"
    label_axes(axes, label, "", title)


def _set_rows(axes: Axes, labels: list[str]) -> None:
    """Write one label for each row, the first on top."""
    axes.set_yticks(range(len(labels)), labels)
    axes.set_ylim(len(labels) - 0.4, -0.6)


def draw_correlation(fit: FittedParameters) -> Figure:
    """Draw the correlations of all parameters as a matrix of colors.

    Parameters without a finite uncertainty have a grey row.
    """
    p = len(fit.free_parameters.names)
    size = float(np.clip(0.155 * p, 3.4, 13.0))
    figure = start_figure(size + 2.6, size + 1.6)
    axes = figure.add_subplot()
    axes.set_facecolor(PALE)
    image = axes.imshow(compute_correlation(fit), cmap=DIVERGING, vmin=-1.0, vmax=1.0)
    step = -(-p // MOST_NAMES)
    places = list(range(0, p, step))
    font = float(np.clip(size * 72.0 / max(len(places), 1) * 0.72, 4.0, SMALL))
    names = [shorten(fit.free_parameters.names[i]) for i in places]
    axes.set_xticks(places, names, rotation=90, fontsize=font)
    axes.set_yticks(places, names, fontsize=font)
    owners = [name.split(".")[0] for name in fit.free_parameters.names]
    edges = [i - 0.5 for i in range(1, p) if owners[i] != owners[i - 1]]
    if len(edges) < p - 1:
        for edge in edges:
            axes.axhline(edge, color=DARK, lw=0.5)
            axes.axvline(edge, color=DARK, lw=0.5)
    bar = figure.colorbar(image, ax=axes, shrink=0.7, aspect=25)
    bar.set_label("correlation [1]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL)
    return finish_figure(figure, f"{fit.robot.name}: {_describe_correlation(fit, step)}")


def compute_correlation(fit: FittedParameters) -> FloatArray:
    """Return the correlations (p, p) [1]; NaN where a parameter has no finite uncertainty."""
    sd = fit.standard_deviations
    usable = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(usable, sd, np.nan)
    return np.where(np.outer(usable, usable), fit.covariance, np.nan) / np.outer(scale, scale)


def _describe_correlation(fit: FittedParameters, step: int) -> str:
    """Return the strongest correlation in words, and what grey means where there is any."""
    correlation = compute_correlation(fit)
    off = np.abs(np.nan_to_num(correlation - np.diag(np.diag(correlation))))
    words = f"correlation of {_count(len(fit.free_parameters.names))}"
    if off.size and off.max() > 0.0:
        i, j = np.unravel_index(int(off.argmax()), off.shape)
        value = f"{correlation[i, j]:+.2f}"
        names = fit.free_parameters.names
        words += f"\nstrongest {value}: {shorten(names[j])} and {shorten(names[i])}"
    if np.isnan(np.diag(correlation)).any():
        words += "\ngrey: without a finite uncertainty"
    if step > 1:
        words += f"\nevery {step}. name is written"
    return words
