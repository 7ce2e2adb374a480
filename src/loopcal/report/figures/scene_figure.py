# SPDX-License-Identifier: Apache-2.0
"""A scene as a picture: a robot at home, measured poses with errors, and the accuracy map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.report.figures.robot_figure import choose_view, draw_robot
from loopcal.report.figures.style import ERROR, LABEL, POSE, SEQUENTIAL, SMALL, THIN, finish_figure
from loopcal.report.scene.scene import PoseErrors, Scene
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_scene(scene: Scene) -> Figure:
    """Draw a robot at home; with measured poses the tool points and errors there; with an accuracy
    map the uncertainty of positions over the workspace as pale points.
    """
    robot, poses = scene.robot, scene.poses
    figure = draw_robot(robot)
    factor = find_unit(robot.units[Dimension.LENGTH]).factor_to_si
    panels = figure.axes
    if scene.accuracy is not None:
        _draw_map(figure, panels, scene, factor)
    if poses is None:
        return figure
    ends, flat = _join_ends(poses) / factor, [*choose_view(robot)]
    for axes in panels:
        kept = [0, 1, 2] if axes.name == "3d" else flat
        axes.plot(*ends[:, kept].T, color=ERROR, lw=1.0, zorder=8)
        axes.plot(*poses.tool[:, kept].T / factor, "o", color=POSE, ms=2.5, zorder=8)
        if axes.name == "3d" and len(ends):
            _include(axes, ends)
    n = len(poses.tool)
    count = f"{n} measured {'pose' if n == 1 else 'poses'}"
    title = f"{robot.name} at home, {count}; errors before calibration"
    return finish_figure(figure, f"{title}, x {poses.magnification:g}")


def _join_ends(poses: PoseErrors) -> FloatArray:
    """Return the ends of the errors (3 n, 3) [m], with NaN behind each."""
    ends = (poses.tool, poses.tool + poses.magnification * poses.error)
    return np.stack([*ends, np.full(poses.tool.shape, np.nan)], axis=1).reshape(-1, 3)


def _draw_map(figure: Figure, panels: list[Any], scene: Scene, factor: float) -> None:
    """Draw the uncertainty of positions where it is known, with its scale of colors."""
    assert scene.accuracy is not None
    unit = DISPLAY_UNITS[Dimension.LENGTH]
    values = scene.accuracy.uncertainty.position / unit.factor_to_si
    known = np.isfinite(values) & np.isfinite(scene.map_points).all(axis=1)
    if not known.any():
        return
    points, drawn, flat = scene.map_points[known] / factor, [], [*choose_view(scene.robot)]
    for axes in panels:
        kept = [0, 1, 2] if axes.name == "3d" else flat
        style = {"c": values[known], "cmap": SEQUENTIAL, "s": 9.0, "marker": "s", "lw": 0.0}
        drawn.append(axes.scatter(*points[:, kept].T, alpha=0.45, zorder=0.4, **style))
        if axes.name == "3d":
            _include(axes, points)
    bar: Any = figure.colorbar(drawn[-1], ax=panels[-1], aspect=30, pad=0.02, shrink=0.8)
    bar.set_label(f"position uncertainty (rms) [{unit.symbol}]", fontsize=LABEL)
    bar.ax.tick_params(labelsize=SMALL, width=THIN)
    bar.solids.set_alpha(1.0)


def _include(axes: Any, points: FloatArray) -> None:
    """Widen the limits of axes in space so that they contain points; scales stay equal."""
    spans = []
    for axis, values in zip("xyz", points.T, strict=True):
        low, high = getattr(axes, f"get_{axis}lim")()
        low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
        getattr(axes, f"set_{axis}lim")(low, high)
        spans.append(high - low)
    axes.set_box_aspect(spans, zoom=0.9)
