# SPDX-License-Identifier: Apache-2.0
"""What an instrument measures at groups of points on planes and perpendicular lines: the kinds
`plane` and `line`, whose surfaces are unknown and shared by each group.

Kinds that name the same surface share the unknowns of that name, so that the line is perpendicular
to the plane by construction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from loopcal.measure import Instrument, Line, Noise, Plane, Sensor
from loopcal.mechanism import POSITION, Mechanism, pose_from_coordinates
from loopcal.typing import FloatArray, IntArray


def make_plane_line_instrument(
    robot: Mechanism, axis: IntArray, points: IntArray, make_noise: Callable[[str, int], Noise]
) -> Instrument:
    """Return a plane and a line along each axis that is used, unknown in each group.

    Parameters
    ----------
    axis : (u,) 0, 1 or 2, along which the line of each group runs.
    points : (u, k) poses of each group: first the point on plane and line, then the other one on
        the line.
    make_noise : from the name of a kind and its number of gaps to their noise.
    """
    sensors = []
    for along in np.unique(axis):
        chosen = np.flatnonzero(axis == along)
        for kind, touched, gaps in (
            (Plane, np.delete(points[chosen], 1, axis=1), 1),
            (Line, points[chosen, :2], 2),
        ):
            surface = kind(
                unknown=("surface",),
                surface=f"surface-{POSITION[along]}",
                along=np.eye(3)[along],
                through=robot.home[:3, 3],
            )
            names = np.repeat([f"group{g + 1}" for g in chosen], touched.shape[1])
            noise = make_noise(kind.name, gaps)
            sensors.append(Sensor(surface, noise, rows=touched.ravel(), group=names))
    return Instrument(tuple(sensors)).with_tool(robot)


def find_line_axes(robot: Mechanism, coordinates: FloatArray, groups: int) -> IntArray:
    """Return the axes (u,) of the lines of points with coordinates (n, c) [m, rad], group
    after group.
    """
    T = pose_from_coordinates(coordinates, robot.controlled, robot.home) @ robot.tool
    points = T[:, :3, 3].reshape(groups, -1, 3)
    return np.asarray(np.abs(points[:, 1] - points[:, 0]).argmax(axis=1))
