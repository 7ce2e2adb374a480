# SPDX-License-Identifier: Apache-2.0
"""Residuals of a fit: by pose, by component, as a distribution, and against recorded quantities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.estimate import Identification
from loopcal.estimate.residuals import KindResiduals
from loopcal.mechanism import Mechanism
from loopcal.report.figures.residual_series import (
    ResidualSeries,
    describe_residual_frame,
    find_quantity_unit,
    list_poses,
    list_quantities,
    list_series,
)
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DOT,
    LINE,
    MARKERS,
    REFERENCE,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    label_poses,
    start_figure,
)
from loopcal.units import Dimension

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = "residual [sigma]"
"""Label of an axis of whitened residuals."""

BAND = 1.959963984540054
"""Residuals over sigma that 95 % do not exceed, if the stated noise is right."""

MANY = 2000
"""Points of a series from which they are embedded as a picture in SVG and PDF files."""

UPRIGHT = 8
"""Components up to which their numbers fit side by side."""

COLUMNS = 3
"""Panels of quantities beside each other."""


def draw_residuals(fit: Identification) -> Figure:
    """Draw the residuals of a fit, see `draw_residual_rows`."""
    return draw_residual_rows(fit.robot, fit.residuals, fit.nuisance.names)


def draw_residual_rows(
    robot: Mechanism, residuals: Sequence[KindResiduals], setup: Sequence[str] = ()
) -> Figure:
    """Draw residuals in units by pose, then over sigma by component, as histogram and normal plot,
    and against each actuator reading, time and temperature that was recorded.

    Residuals of actuator readings are in the first two only: the estimated poses take up a part of
    them, so that they are smaller than their sigma.

    Parameters
    ----------
    residuals : of a fit or of a run folder. setup : names of the fitted setup parameters.
    """
    series = [s for s in list_series(robot, residuals) if len(s.raw)]
    quantities = list_quantities(series)
    groups = _group_by_unit(series)
    rows = -(-len(quantities) // COLUMNS)
    figure = start_figure(11.0, 0.8 + 2.2 * len(groups) + 2.6 + 2.3 * rows)
    heights = [*[2.2] * len(groups), 2.6, *[2.3] * rows]
    grid = figure.add_gridspec(len(heights), 2 * COLUMNS, height_ratios=heights)
    styles = _choose_styles(series)
    for i, group in enumerate(groups):
        _draw_by_pose(figure.add_subplot(grid[i, :]), robot, list_poses(residuals), group, styles)
    n = len(groups)
    _draw_components(figure.add_subplot(grid[n, :2]), series, styles)
    measured = [s for s in series if not s.is_reading]
    whitened = np.concatenate([s.whitened for s in measured]) if measured else np.zeros(0)
    _draw_histogram(figure.add_subplot(grid[n, 2:4]), whitened)
    _draw_normal_plot(figure.add_subplot(grid[n, 4:]), whitened)
    for i, name in enumerate(quantities):
        row, column = divmod(i, COLUMNS)
        place = grid[n + 1 + row, 2 * column : 2 * column + 2]
        _draw_against(figure.add_subplot(place), robot, measured, styles, name)
    add_legend(figure, _list_handles(series, styles))
    n = len(list_poses(residuals))
    count = f"{sum(len(s.raw) for s in series)} residuals of {n} {'pose' if n == 1 else 'poses'}"
    return finish_figure(figure, f"{robot.name}: {count}; {describe_residual_frame(setup)}")


def _group_by_unit(series: list[ResidualSeries]) -> list[list[ResidualSeries]]:
    """Return the series of each kind and dimension, which share an axis."""
    groups: dict[tuple[str, Dimension], list[ResidualSeries]] = {}
    for s in series:
        groups.setdefault((s.kind, s.dimension), []).append(s)
    return list(groups.values())


def _choose_styles(series: list[ResidualSeries]) -> dict[str, dict[str, Any]]:
    """Return color and marker of each series; they differ in both up to eight series."""
    labels = dict.fromkeys(s.label for s in series)
    return {
        label: {
            "color": COLORS[i % len(COLORS)],
            "marker": MARKERS[i % len(MARKERS)],
            "ls": "none",
            "ms": DOT,
            "mfc": "none" if i >= len(COLORS) else COLORS[i % len(COLORS)],
            "mew": 0.7,
        }
        for i, label in enumerate(labels)
    }


def _draw_by_pose(
    axes: Axes,
    robot: Mechanism,
    poses: Sequence[str],
    group: list[ResidualSeries],
    styles: dict[str, dict[str, Any]],
) -> None:
    """Draw the residuals of one kind in units; components are side by side at their pose."""
    unit = robot.get_unit(group[0].dimension)
    steps = np.linspace(-0.25, 0.25, len(group) + 2)[1:-1] if len(poses) <= 60 else [0.0] * 99
    for s, step in zip(group, steps, strict=False):
        axes.plot(
            s.poses + step,
            s.raw / unit.factor_to_si,
            rasterized=len(s.raw) > MANY,
            **styles[s.label],
        )
    axes.axhline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    label_axes(axes, "", f"{group[0].kind} residual [{unit.symbol}]", "by pose")
    label_poses(axes, poses)


def _draw_components(
    axes: Axes, series: list[ResidualSeries], styles: dict[str, dict[str, Any]]
) -> None:
    """Draw the residuals over sigma by component, with the rms of each."""
    labels = list(styles)
    for i, label in enumerate(labels):
        values = np.concatenate([s.whitened for s in series if s.label == label])
        spread = np.linspace(-0.22, 0.22, len(values)) if len(values) > 1 else np.zeros(len(values))
        axes.plot(i + spread, values, rasterized=len(values) > MANY, **styles[label])
        size = float(np.sqrt((values**2).mean()))
        for sign in (-1.0, 1.0):
            axes.hlines(sign * size, i - 0.38, i + 0.38, color=DARK, lw=LINE)
        axes.annotate(
            f"{size:.2f}",
            (i, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, -2),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=SMALL - 1,
            rotation=90 if len(labels) > UPRIGHT else 0,
        )
    _add_band(axes)
    axes.margins(y=0.16 if len(labels) <= UPRIGHT else 0.35)
    is_long = max((len(label) for label in labels), default=0) * len(labels) > 32
    rotation, side = (0, "center") if not is_long else (35, "right")
    if len(labels) > UPRIGHT:
        rotation, side = 90, "center"
    axes.set_xticks(range(len(labels)), labels, rotation=rotation, ha=side)
    label_axes(axes, "", SIGMAS, "by component; bars: rms")


def _draw_histogram(axes: Axes, whitened: np.ndarray) -> None:
    """Draw a histogram of the residuals over sigma beside the density of the stated noise."""
    reach = max(4.0, float(np.abs(whitened).max(initial=0.0)))
    bins = int(np.clip(np.sqrt(len(whitened)) * 1.5, 8, 60))
    x = np.linspace(-reach, reach, 200)
    axes.hist(
        whitened,
        np.linspace(-reach, reach, bins + 1).tolist(),
        density=True,
        color=COLORS[5],
        ec="white",
    )
    axes.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=DARK, lw=LINE)
    label_axes(axes, SIGMAS, "density [1/sigma]", "histogram; line: stated noise")


def _draw_normal_plot(axes: Axes, whitened: np.ndarray) -> None:
    """Draw the sorted residuals over sigma against the quantiles of a normal distribution."""
    from loopcal.numerics.special_functions import ndtri

    values = np.sort(whitened)
    x = ndtri((np.arange(len(values)) + 0.5) / max(len(values), 1))
    axes.plot(x, values, "o", color=COLORS[0], ms=DOT - 0.5, rasterized=len(values) > MANY)
    if len(values):
        ends = np.array([x[0], x[-1]])
        axes.plot(ends, ends, color=DARK, lw=LINE)
    label_axes(axes, "normal quantile [sigma]", SIGMAS, "normal plot; line: stated noise")


def _draw_against(
    axes: Axes,
    robot: Mechanism,
    series: list[ResidualSeries],
    styles: dict[str, dict[str, Any]],
    name: str,
) -> None:
    """Draw the residuals over sigma against a recorded quantity."""
    from matplotlib.ticker import MaxNLocator

    factor, symbol = find_quantity_unit(robot, name)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    for s in series:
        if name in s.quantities:
            axes.plot(
                s.quantities[name] / factor,
                s.whitened,
                rasterized=len(s.raw) > MANY,
                **styles[s.label],
            )
    _add_band(axes)
    label_axes(axes, f"{name} [{symbol}]", SIGMAS)


def _add_band(axes: Axes) -> None:
    """Draw zero, and the limits of 95 % of the residuals if the stated noise is right."""
    axes.axhline(0.0, color=REFERENCE, lw=THIN, zorder=1)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * BAND, color=REFERENCE, lw=THIN, ls="--", zorder=1)


def _list_handles(series: list[ResidualSeries], styles: dict[str, dict[str, Any]]) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], label=label, **style) for label, style in styles.items()]
    if series:
        limits = "95 % limits of the stated noise"
        handles.append(Line2D([], [], color=REFERENCE, lw=THIN, ls="--", label=limits))
    return handles
