# SPDX-License-Identifier: Apache-2.0
"""The quantities that a user changes in the live view of a robot, and the pose that they give.

These are the actuator readings. A robot with more actuators than freedoms, such as one with cables,
cannot change one reading alone, so its axes are the coordinates in which it is commanded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.error_frames import solve_home
from loopcal.errors import LoopcalError
from loopcal.mechanism import (
    POSITION,
    Mechanism,
    Solution,
    forward,
    inverse,
    read_coordinates,
    sample_workspace,
)
from loopcal.typing import FloatArray
from loopcal.units import DISPLAY_UNITS, Dimension, Unit

SAMPLES, SEED = 64, 0
"""Poses of the workspace, and the seed of their draw, from which ranges are taken."""

REACH = 0.1
"""Range about home where nothing else is known, as a share of the robot's size, or in radians."""


@dataclass(frozen=True)
class Axis:
    """A reading or coordinate: its name and unit on the screen, range and value at home [SI]."""

    name: str
    unit: Unit
    low: float
    high: float
    home: float


def has_free_readings(robot: Mechanism) -> bool:
    """Return whether the actuators of a robot can move one at a time."""
    return len(robot.actuators) <= len(robot.freedoms)


def list_axes(robot: Mechanism) -> tuple[Axis, ...]:
    """Return the axes of a robot. The range of a reading is its stroke, else what poses of the
    workspace need; without both it is a share of the robot's size or an angle about home.
    """
    is_reading = has_free_readings(robot)
    if is_reading:
        names = tuple(actuator.name for actuator in robot.actuators)
        dimensions = [actuator.dimension for actuator in robot.actuators]
        strokes = [actuator.stroke for actuator in robot.actuators]
    else:
        names, strokes = robot.controlled, [None] * len(robot.controlled)
        dimensions = [Dimension.LENGTH if n in POSITION else Dimension.ANGLE for n in names]
    home = _read_axes(robot, solve_home(robot))[0]
    try:
        values = np.vstack(
            [home, _read_axes(robot, sample_workspace(robot, SAMPLES, SEED).solution)]
        )
    except LoopcalError:  # the robot states no workspace
        lengths = np.array([dimension is Dimension.LENGTH for dimension in dimensions])
        reach = np.where(lengths, REACH * robot.size, REACH)
        values = np.stack([home - reach, home + reach])
    ends = np.stack([values.min(axis=0), values.max(axis=0)], axis=1)
    for i, stroke in enumerate(strokes):
        if stroke is not None:
            ends[i] = min(stroke[0], home[i]), max(stroke[1], home[i])
    units = [DISPLAY_UNITS[dimension] for dimension in dimensions]
    return tuple(Axis(*row) for row in zip(names, units, *ends.T, home, strict=True))


def solve_axes(robot: Mechanism, values: FloatArray, start: Solution) -> Solution:
    """Return the pose (1,) for values (c,) of the axes, from a pose, or else from home."""
    solve = forward if has_free_readings(robot) else inverse
    solution = solve(robot, values[None], start=start)
    return solution if solution.converged[0] else solve(robot, values[None])


def _read_axes(robot: Mechanism, solution: Solution) -> FloatArray:
    """Return the values (n, c) of the axes at n poses [SI]."""
    if has_free_readings(robot):
        return solution.q
    return read_coordinates(solution.T, robot.controlled)
