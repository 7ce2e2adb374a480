# SPDX-License-Identifier: Apache-2.0
"""A plan of planes with perpendicular lines: the points of each group in three views."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.mechanism import POSITION
from loopcal.planning import SurfacePlan
from loopcal.report.figures.style import (
    COLORS,
    DARK,
    DOT,
    LINE,
    MARKERS,
    SMALL,
    THIN,
    add_legend,
    finish_figure,
    label_axes,
    start_figure,
)
from loopcal.report.numbers import units_of
from loopcal.units import Dimension

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from loopcal.typing import FloatArray

VIEWS = ((0, 1), (0, 2), (1, 2))
"""Pairs of coordinates: from above, from the front, from the side."""

MOST_GROUPS = 8
"""Groups with a label of their own in the legend."""


def draw_surface_plan(plan: SurfacePlan) -> Figure:
    """Draw where the tool is at the points of each group: the first two are on the line, and the
    first and all others in the plane. A number is that of a group at its first point.
    """
    from matplotlib.lines import Line2D

    unit = units_of(plan.robot)[Dimension.LENGTH]
    places = plan.positions / unit.factor_to_si
    figure = start_figure(12.6, 5.0)
    panels: Any = figure.subplots(1, len(VIEWS))
    for axes, view in zip(panels, VIEWS, strict=True):
        for group, points in enumerate(places):
            _draw_group(axes, points[:, view], group)
        _write_numbers(axes, places[:, 0, view])
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.12)
        x, y = (POSITION[i] for i in view)
        label_axes(axes, f"{x} [{unit.symbol}]", f"{y} [{unit.symbol}]")
    handles = [
        Line2D([], [], color=DARK, lw=2.2, marker="o", ms=DOT, label="line: points 1 and 2"),
        Line2D([], [], color=DARK, lw=THIN, marker="o", ms=DOT, label="plane: point 1 and others"),
    ]
    if len(places) <= MOST_GROUPS:
        handles += [
            Line2D([], [], color=_color(i), marker=_marker(i), ms=DOT + 1, ls="none",
                   label=f"group {i + 1}, line along {POSITION[plan.axis[i]]}")
            for i in range(len(places))
        ]  # fmt: skip
    add_legend(figure, handles)
    groups, points = plan.poses.groups.shape
    planes = "1 plane" if groups == 1 else f"{groups} planes"
    words = f"{planes} with a perpendicular line, n = {points} points in each"
    return finish_figure(figure, f"{plan.robot.name}: {words}")


def _draw_group(axes: Axes, points: FloatArray, group: int) -> None:
    """Draw the points (k, 2) of a group: a thick line, and a fan of thin ones in the plane."""
    color, marker = _color(group), _marker(group)
    axes.plot(*points[:2].T, "-", color=color, lw=2.2, zorder=2)
    for point in points[2:]:
        axes.plot(*np.stack([points[0], point]).T, "-", color=color, lw=THIN, alpha=0.6, zorder=1)
    axes.plot(*points.T, marker, color=color, ms=DOT + LINE, ls="none", zorder=3)


def _write_numbers(axes: Axes, first: FloatArray) -> None:
    """Write the numbers of groups at their first points (u, 2); those of one place together."""
    groups: dict[tuple[float, ...], list[int]] = {}
    for group, point in enumerate(first):
        groups.setdefault(tuple(np.round(point, 6).tolist()), []).append(group)
    for (x, y), members in groups.items():
        axes.annotate(
            ", ".join(str(group + 1) for group in members),
            (x, y),
            xytext=(5, 4),
            textcoords="offset points",
            fontsize=SMALL,
            zorder=4,
            bbox={"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.7},
        )


def _color(group: int) -> str:
    return COLORS[group % len(COLORS)]


def _marker(group: int) -> str:
    return MARKERS[group // len(COLORS) % len(MARKERS)]
