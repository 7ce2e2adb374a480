# SPDX-License-Identifier: Apache-2.0
"""A scene: a robot at home with its measured poses, its errors there, and its accuracy map.

One scene is drawn twice: as a picture by `loopcal.report.figures.draw_scene`, and by the script of
the 3-D view, for which `scene_data.py` writes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from loopcal.apply import AccuracyMap
from loopcal.mechanism import Mechanism, Solution, forward
from loopcal.typing import FloatArray

LONGEST = 0.15
"""Length of the longest drawn error, as a share of the robot's size."""


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Measured poses that the geometries before and after calibration both reach.

    Attributes
    ----------
    labels : of the n poses. solution : of the calibrated robot.
    tool : (n, 3) tool points [m]. error : (n, 3) those of the geometry before minus these [m].
    magnification : by which factor the errors are drawn longer than the poses' scale.
    """

    labels: tuple[str, ...]
    solution: Solution
    tool: FloatArray
    error: FloatArray
    magnification: float


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot at home.

    Attributes
    ----------
    poses : with their errors; None without a calibration.
    accuracy : uncertainty over the workspace; None where it is not known.
    """

    robot: Mechanism
    poses: PoseErrors | None = None
    accuracy: AccuracyMap | None = None

    @property
    def map_points(self) -> FloatArray:
        """(n, 3) tool points of the accuracy map [m]; NaN where a pose is unreachable."""
        if self.accuracy is None:
            return np.zeros((0, 3))
        return (self.accuracy.uncertainty.T @ self.robot.tool)[:, :3, 3]


def compute_pose_errors(
    robot: Mechanism, initial: Mechanism, readings: FloatArray, labels: tuple[str, ...]
) -> PoseErrors:
    """Return the tool point at readings, and the errors of the initial geometry there.

    Parameters
    ----------
    robot : calibrated. initial : before calibration. readings : (n, a) of the poses [m or rad].
    labels : of the poses.

    Returns
    -------
    PoseErrors without the poses that one of the two geometries does not reach.
    """
    after, before = (forward(machine, readings) for machine in (robot, initial))
    reached = np.flatnonzero(after.converged & before.converged)
    tool = (after.T[reached] @ robot.tool)[:, :3, 3]
    error = (before.T[reached] @ initial.tool)[:, :3, 3] - tool
    return PoseErrors(
        tuple(labels[i] for i in reached),
        after.take(reached),
        tool,
        error,
        _choose_magnification(error, robot.size),
    )


def _choose_magnification(error: FloatArray, size: float) -> float:
    """Return 1, 2 or 5 times a power of ten with which the longest error is at most LONGEST."""
    longest = float(np.sqrt((error**2).sum(axis=1)).max(initial=0.0))
    if longest <= 1e-9 * size:
        return 1.0
    return round_down(LONGEST * size / longest)


def round_down(value: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at most a value above zero."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * max(step for step in (1.0, 2.0, 5.0) if step * power <= value)
