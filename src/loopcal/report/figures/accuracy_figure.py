# SPDX-License-Identifier: Apache-2.0
"""Uncertainty of poses over the workspace, in slices, beside the measured poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from loopcal.apply import AccuracyMap
from loopcal.mechanism import POSITION, read_coordinates
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    LABEL,
    REFERENCE,
    SEQUENTIAL,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    start_figure,
)
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SLICES = 3
"""Slices of the workspace."""

NEGLIGIBLE = 1e-9
"""Uncertainty [rad] below which an orientation cannot change and is not drawn."""


class Layout(NamedTuple):
    """Coordinates along both axes and that of the slices, as columns; None without."""

    x: int
    y: int | None
    sliced: int | None


class Slice(NamedTuple):
    """Poses of the map and measured poses in one slice."""

    title: str
    chosen: BoolArray
    measured: BoolArray


def draw_accuracy_map(accuracy: AccuracyMap) -> Figure:
    """Draw the rms uncertainty of position and orientation in slices of the workspace.

    A ring marks a pose that is less certain than every measured pose (extrapolated); a cross is a
    measured pose, a grey square a pose whose uncertainty the data do not bound.
    """
    measured = read_coordinates(accuracy.measured.T, accuracy.names)
    layout = _choose_layout(accuracy.names)
    slices = _cut(accuracy, measured, layout)
    quantities = [("position", DISPLAY_UNITS[Dimension.LENGTH])]
    if np.nanmax(accuracy.uncertainty.orientation, initial=0.0) > NEGLIGIBLE:
        quantities.append(("orientation", DISPLAY_UNITS[Dimension.ANGLE]))
    figure = start_figure(1.8 + 3.5 * len(slices), 1.5 + 3.1 * len(quantities))
    axes_grid: Any = figure.subplots(len(quantities), len(slices), squeeze=False)
    for panels, (name, unit) in zip(axes_grid, quantities, strict=True):
        values = getattr(accuracy.uncertainty, name) / unit.factor_to_si
        if layout.y is None:
            _draw_line(panels[0], accuracy, measured, layout.x, name, unit)
            continue
        _draw_row(figure, panels, accuracy, measured, layout, slices, values)
        figure.axes[-1].set_ylabel(f"{name} uncertainty (rms) [{unit.symbol}]", fontsize=LABEL)
    add_legend(figure, _list_handles(accuracy))
    n = len(accuracy.coordinates)
    outside = (
        f"{int(accuracy.extrapolated.sum())} of {n} {'pose' if n == 1 else 'poses'} extrapolated"
    )
    return finish_figure(figure, f"{outside}\n{accuracy.uncertainty.frame}")


def _choose_layout(names: tuple[str, ...]) -> Layout:
    """Return two positions along the axes and the third as slices, or else angles."""
    lengths = [i for i, name in enumerate(names) if name in POSITION]
    angles = [i for i, name in enumerate(names) if name not in POSITION]
    if len(names) == 1:
        return Layout(0, None, None)
    order = [*lengths, *angles] if len(lengths) > 1 else [*angles, *lengths]
    return Layout(order[0], order[1], order[2] if len(order) > 2 else None)


def _cut(accuracy: AccuracyMap, measured: FloatArray, layout: Layout) -> list[Slice]:
    """Return slices with as many poses each; the measured poses are in that of their place."""
    n, m = len(accuracy.coordinates), len(measured)
    if layout.sliced is None or n < 2 * SLICES:
        return [Slice("", np.ones(n, dtype=bool), np.ones(m, dtype=bool))]
    along = accuracy.coordinates[:, layout.sliced]
    edges = np.quantile(along, np.linspace(0.0, 1.0, SLICES + 1))
    name, unit = accuracy.names[layout.sliced], _unit_of(accuracy.names[layout.sliced])
    number = np.clip(np.searchsorted(edges, along, "right") - 1, 0, SLICES - 1)
    of_measured = np.searchsorted(edges[1:-1], measured[:, layout.sliced], "right")
    if not np.ptp(along) > 0.0:
        return [Slice("", np.ones(n, dtype=bool), np.ones(m, dtype=bool))]
    ends = edges / unit.factor_to_si
    return [
        Slice(
            f"{name} from {ends[i]:.4g} to {ends[i + 1]:.4g} {unit.symbol}",
            number == i,
            of_measured == i,
        )
        for i in range(SLICES)
    ]


def _draw_row(
    figure: Figure,
    panels: Any,
    accuracy: AccuracyMap,
    measured: FloatArray,
    layout: Layout,
    slices: list[Slice],
    values: FloatArray,
) -> None:
    """Draw one quantity in all slices, with one scale of colors."""
    assert layout.y is not None
    finite = values[np.isfinite(values)]
    limits = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    names, i, j = accuracy.names, layout.x, layout.y
    scale = [_unit_of(names[k]).factor_to_si for k in (i, j)]
    x, y = (accuracy.coordinates[:, k] / f for k, f in zip((i, j), scale, strict=True))
    points = None
    for axes, part in zip(panels, slices, strict=True):
        bounded = part.chosen & np.isfinite(values)
        unbounded = part.chosen & ~np.isfinite(values)
        beyond = bounded & accuracy.extrapolated
        points = axes.scatter(
            x[bounded], y[bounded], c=values[bounded], cmap=SEQUENTIAL, s=20.0,
            vmin=limits[0], vmax=limits[1],
        )  # fmt: skip
        axes.scatter(x[beyond], y[beyond], s=52.0, fc="none", ec=COLORS[1], lw=0.6)
        axes.plot(x[unbounded], y[unbounded], "s", color=REFERENCE, ms=4.0)
        place = measured[part.measured]
        axes.plot(place[:, i] / scale[0], place[:, j] / scale[1], "x", color=DARK, ms=4.5)
        if names[i] in POSITION and names[j] in POSITION:
            axes.set_aspect("equal", adjustable="datalim")
        symbols = [f"{names[k]} [{_unit_of(names[k]).symbol}]" for k in (i, j)]
        label_axes(axes, symbols[0], symbols[1] if axes is panels[0] else "", part.title)
    assert points is not None
    bar = figure.colorbar(points, ax=list(panels), aspect=22, pad=0.02)
    bar.ax.tick_params(labelsize=SMALL)


def _draw_line(
    axes: Axes, accuracy: AccuracyMap, measured: FloatArray, i: int, name: str, unit: Unit
) -> None:
    """Draw the uncertainty of a machine with one coordinate against it."""
    of_axis = _unit_of(accuracy.names[i])
    for uncertainty, places, marker, color in (
        (accuracy.uncertainty, accuracy.coordinates, ".", COLORS[0]),
        (accuracy.measured, measured, "x", DARK),
    ):
        values = getattr(uncertainty, name) / unit.factor_to_si
        axes.plot(places[:, i] / of_axis.factor_to_si, values, marker, color=color, lw=THIN)
    label_axes(
        axes, f"{accuracy.names[i]} [{of_axis.symbol}]", f"{name} uncertainty (rms) [{unit.symbol}]"
    )


def _unit_of(name: str) -> Unit:
    """Return the unit in which a controlled coordinate is drawn."""
    return DISPLAY_UNITS[Dimension.LENGTH if name in POSITION else Dimension.ANGLE]


def _list_handles(accuracy: AccuracyMap) -> list[Any]:
    """Return what the legend contains."""
    from matplotlib.lines import Line2D

    style: dict[str, Any] = {"ls": "none"}
    handles = [Line2D([], [], marker="x", color=DARK, ms=4.5, label="measured pose", **style)]
    if accuracy.extrapolated.any():
        label = "less certain than every measured pose"
        handles.append(Line2D([], [], marker="o", mfc="none", mec=COLORS[1], label=label, **style))
    values = accuracy.uncertainty
    if not (np.isfinite(values.position) & np.isfinite(values.orientation)).all():
        label = "not bounded by the data, or out of reach"
        handles.append(Line2D([], [], marker="s", color=REFERENCE, ms=4.0, label=label, **style))
    return handles
