# SPDX-License-Identifier: Apache-2.0
"""A robot at home with the measured poses, and the position errors there before calibration."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.mechanism import Mechanism, forward
from loopcal.report.figures.robot_figure import draw_robot
from loopcal.report.figures.style import finish_figure
from loopcal.typing import FloatArray
from loopcal.units import Dimension, find_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 0.15
"""Length of the longest drawn error, as a share of the robot's size."""

POSE, ERROR = "#5b3a8e", "#c2185b"
"""Colors of poses and of errors, which no limb has."""


def draw_scene(robot: Mechanism, initial: Mechanism, readings: FloatArray) -> tuple[Figure, float]:
    """Draw a robot at home, the tool point at readings, and the errors of the initial geometry.

    Parameters
    ----------
    robot : calibrated. initial : before calibration. readings : (n, a) of the poses [m or rad].

    Returns
    -------
    figure, and by which factor the errors are longer than the poses' scale. Poses that one of the
    two geometries does not reach are left out.
    """
    after, before = (forward(machine, readings) for machine in (robot, initial))
    reached = after.converged & before.converged
    tool = (after.T[reached] @ robot.tool)[:, :3, 3]
    error = (before.T[reached] @ initial.tool)[:, :3, 3] - tool
    magnification = _choose_magnification(error, robot.size)
    figure = draw_robot(robot)
    factor = find_unit(robot.units[Dimension.LENGTH]).factor_to_si
    ends = np.stack([tool, tool + magnification * error, np.full(tool.shape, np.nan)], axis=1)
    points, lines = tool / factor, ends.reshape(-1, 3) / factor
    for axes in figure.axes:
        is_space = axes.name == "3d"
        kept = slice(None) if is_space else slice(0, 2)
        axes.plot(*lines[:, kept].T, color=ERROR, lw=1.0, zorder=8)
        axes.plot(*points[:, kept].T, "o", color=POSE, ms=2.5, zorder=8)
        if is_space and len(points):
            _include(axes, lines)
    count = f"{len(tool)} measured {'pose' if len(tool) == 1 else 'poses'}"
    title = f"{robot.name} at home, {count}; errors before calibration, x {magnification:g}"
    return finish_figure(figure, title), magnification


def _choose_magnification(error: FloatArray, size: float) -> float:
    """Return 1, 2 or 5 times a power of ten with which the longest error is at most LONGEST."""
    longest = float(np.sqrt((error**2).sum(axis=1)).max(initial=0.0))
    if longest <= 1e-9 * size:
        return 1.0
    wanted = LONGEST * size / longest
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted)


def _include(axes: Any, points: FloatArray) -> None:
    """Widen the limits of axes in space so that they contain points; scales stay equal."""
    spans = []
    for axis, values in zip("xyz", points.T, strict=True):
        low, high = getattr(axes, f"get_{axis}lim")()
        low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
        getattr(axes, f"set_{axis}lim")(low, high)
        spans.append(high - low)
    axes.set_box_aspect(spans, zoom=0.9)
