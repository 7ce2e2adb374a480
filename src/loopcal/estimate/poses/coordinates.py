# SPDX-License-Identifier: Apache-2.0
"""Coordinates in which a pose of uncertain readings moves while the loops stay closed.

Linearized closure, A y + Q dq + E de = 0, leaves the pose y and the readings q as many free
directions as its null space has. Two bases of the null space are used. Both are exact, and in both
the kinematics close the pose:

    as many actuators as freedoms    u moves the readings, dq = diag(s) u,  y = -A^-1 (E de + Q dq)
    more actuators than freedoms     u moves the pose,     y = diag(s) u,   dq = -Q^-1 (A y + E de)

An exact reading has s = 0: it has no direction, and nothing is divided by it. See
docs/theory/uncertain-readings.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from loopcal import geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.poses.linearization import (
    LinearizedPoses,
    linearize_poses,
    mask_unreached,
    scale_parameters,
)
from loopcal.estimate.poses.states import PoseStates
from loopcal.findings import report_finding
from loopcal.mechanism import Mechanism, differentiate_at_pose, forward_trials, solve_at_pose
from loopcal.mechanism.assembly import Actuator
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

LONGEST_STEP = 0.25
"""Longest step of a reading, as a share of its stroke, or of a pose, as a share of the robot's
size. Beyond it closure is not linear."""


class PoseCoordinates(Protocol):
    """How coordinates u move poses that satisfy closure."""

    freedoms: int

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which coordinates (n, k) of some poses may move."""
        ...

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve closure at parameter values (a, p), keeping what u moves.

        `follow` tells whether a pose that Newton does not solve is followed along a path.
        """
        ...

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the largest share (a, n), at most 1, of steps u (a, n, k) that is about linear."""
        ...

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move all poses by u (a, n, k), without solving closure."""
        ...

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize closed poses, whose numbers are (n,), by parameters and coordinates."""
        ...


class ReadingCoordinates:
    """As many actuators as freedoms: u moves the readings, in units of their sigma.

    Parameters
    ----------
    free : the free parameters. scale : (n, actuators) [SI]. names : joints that kinds look at.
    """

    free: FreeParameters
    scale: FloatArray
    names: tuple[str, ...]
    freedoms: int
    longest: FloatArray

    def __init__(self, free: FreeParameters, scale: FloatArray, names: tuple[str, ...]) -> None:
        self.free, self.scale, self.names = free, scale, names
        self.freedoms = scale.shape[1]
        strokes = [stroke_of(free.robot, a) for a in free.robot.actuators]
        self.longest = LONGEST_STEP * np.array(strokes)

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which readings (n, actuators) are not exact."""
        return self.scale[poses] > 0.0

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve the forward kinematics."""
        state = forward_trials(self.free.robot, values, poses.q, poses.state, follow)
        return PoseStates(state, poses.q)

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no reading moves more than `LONGEST_STEP` of its stroke."""
        return _largest_share(u * self.scale, self.longest)

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move the readings."""
        return replace(poses, q=poses.q + self.scale * u)

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize by the implicit function theorem."""
        scale = self.scale[numbers]
        return linearize_poses(self.free, values, poses.q, poses.state, self.names, scale)


class TwistCoordinates:
    """More actuators than freedoms: u moves the platform in its freedoms, turns in units of 1 m
    over the robot's size.

    Raises
    ------
    EstimationError
        An actuator drives several limbs, so that the pose does not determine its reading.
    """

    free: FreeParameters
    names: tuple[str, ...]
    places: list[int]
    freedoms: int
    scale: FloatArray
    longest: FloatArray

    def __init__(self, free: FreeParameters, names: tuple[str, ...]) -> None:
        robot = free.robot
        drives = np.concatenate([g.actuator[g.actuator >= 0] for g in robot.program.groups])
        if len(drives) != len(robot.actuators):
            raise EstimationError(report_finding("poses.shared-actuators", robot=robot.name))
        self.free, self.names = free, names
        self.places = list(robot.program.freedoms)
        self.freedoms = len(self.places)
        self.scale = np.array([1.0 / robot.size] * 3 + [1.0] * 3)[self.places]
        self.longest = LONGEST_STEP * np.array([1.0] * 3 + [robot.size] * 3)[self.places]

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return (n, m): all coordinates move."""
        return np.ones((len(poses), self.freedoms), dtype=bool)

    def close(self, values: FloatArray, poses: PoseStates, follow: bool) -> PoseStates:
        """Solve the inverse kinematics of every limb."""
        del follow
        return PoseStates(*solve_at_pose(self.free.robot, values, poses.state.T, poses.state))

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no shift exceeds `LONGEST_STEP` of the robot's size, and no
        turn as many radians.
        """
        return _largest_share(u * self.scale, self.longest)

    def move(self, poses: PoseStates, u: FloatArray) -> PoseStates:
        """Move the poses."""
        twist = np.zeros((*u.shape[:2], 6))
        twist[..., self.places] = u * self.scale
        T = geometry.apply_twist(poses.state.T, twist)
        return replace(poses, state=replace(poses.state, T=T))

    def linearize(
        self, values: FloatArray, poses: PoseStates, numbers: IntArray
    ) -> LinearizedPoses:
        """Linearize: the pose depends on u alone, readings and passive joints on u and z."""
        robot, shape = self.free.robot, poses.q.shape[:2]
        Y = np.zeros((*shape, 6, self.freedoms))
        Y[..., self.places, range(self.freedoms)] = self.scale
        moves = differentiate_at_pose(robot, values, poses.q, poses.state)
        slopes, turns = {}, {}
        joints = (
            ([a.name for a in robot.actuators], moves.readings),
            (list(moves.names), moves.passive),
        )
        for names, (by_parameter, by_freedom) in joints:
            for i, name in enumerate(names):
                if name in self.names:
                    slopes[name] = scale_parameters(self.free, by_parameter[:, :, i])
                    turns[name] = by_freedom[:, :, i] * self.scale
        unmasked = LinearizedPoses(
            poses.state.T,
            np.zeros(0, dtype=bool),
            np.zeros((*shape, 6, len(self.free.places))),
            joints_by_parameters=slopes,
            by_coordinates=Y,
            joints_by_coordinates=turns,
        )
        return mask_unreached(self.free, self.names, poses.q, poses.state, unmasked)


def stroke_of(robot: Mechanism, actuator: Actuator) -> float:
    """Return the stroke of an actuator [m or rad]; without one the robot's size, or a radian."""
    if actuator.stroke is None:
        return robot.size if actuator.dimension is Dimension.LENGTH else 1.0
    return actuator.stroke[1] - actuator.stroke[0]


def _largest_share(step: FloatArray, longest: FloatArray) -> FloatArray:
    """Return the share (a, n) of steps (a, n, k) that leaves each number within `longest` (k,)."""
    return 1.0 / np.maximum(np.abs(step) / longest, 1.0).max(axis=2, initial=1.0)
