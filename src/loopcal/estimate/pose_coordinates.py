# SPDX-License-Identifier: Apache-2.0
"""The k >= 0 coordinates of each pose, in which it moves while the loops stay closed.

A pose of exact readings has none: the kinematics determine it. A pose of uncertain readings moves
with its readings or, where there are more actuators than freedoms, with the platform. A pose that
was measured in full has none either, where closure is linearized there and not solved.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal import geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.pose_linearization import (
    LinearizedPoses,
    PoseStates,
    linearize_closure,
    linearize_poses,
    locate_poses,
    mask_unreached,
    scale_parameters,
    spread_states,
)
from loopcal.findings import report_finding
from loopcal.mechanism.actuation import DrivenJoints, differentiate_at_pose, solve_at_pose
from loopcal.mechanism.assembly import Actuator
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

LONGEST_STEP = 0.25
"""Longest step of a reading, as a share of its stroke, or of a pose, as a share of the robot's
size. Beyond it closure is not linear."""


class PoseCoordinates:
    """Coordinates of n poses; these have none, because their readings are exact.

    Parameters
    ----------
    free : the free parameters. names : joints that kinds look at.
    readings : (1, n, actuators) [SI] exact ones; those of states come first where they have any.

    Attributes
    ----------
    count : number k of each pose.
    are_shared : whether trials of equal parameters have equal poses.
    rows_of_readings : number of kinds, the last ones, whose rows depend on coordinates alone.
    """

    count = 0
    are_shared = True
    rows_of_readings = 0

    def __init__(self, free: FreeParameters, names: tuple[str, ...], readings: FloatArray) -> None:
        self.free: FreeParameters = free
        self.names: tuple[str, ...] = names
        self.readings: FloatArray = readings

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which coordinates (n, k) of some poses may move."""
        return np.ones((len(poses), self.count), dtype=bool)

    def first_states(self, trials: IntArray) -> PoseStates:
        """Return the states with which the poses of trials (t,) begin: home."""
        n = self.readings.shape[1]
        state = spread_states(self.free.robot.home_state, len(trials), n)
        return PoseStates(state, np.zeros((len(trials), n, 0)))

    def readings_at(self, poses: IntArray) -> FloatArray:
        """Return the exact readings (1, m, actuators) of poses (m,)."""
        is_all = len(poses) == self.readings.shape[1]
        return self.readings if is_all else self.readings[:, poses]

    def close(
        self,
        values: FloatArray,
        poses: IntArray,
        begin: PoseStates | None,
        follow: bool,
        driven: DrivenJoints | None = None,
    ) -> PoseStates:
        """Solve closure of poses (m,) at parameter values (a, p) from states (a, m), keeping what u
        moves. `follow` tells whether a pose that Newton does not solve is followed along a path,
        `driven` are joints that these readings drive, where they are known.
        """
        robot, state = self.free.robot, None if begin is None else begin.state
        q = self.readings_at(poses)
        state = forward_trials(robot, values, q, state, follow, driven=driven)
        return PoseStates(state, np.zeros((len(state.T), len(poses), 0)))

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the largest share (a, n), at most 1, of steps u (a, n, k) that is about linear."""
        return np.ones(u.shape[:2])

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move all poses by u (a, n, k), without solving closure."""
        del u
        return states

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize closed poses (m,) by parameters and coordinates.

        Derivatives may be left out where those by parameters are not needed.
        """
        q = states.q if states.q.shape[2] else self.readings_at(poses)
        if by_parameters:
            return linearize_poses(self.free, values, q, states.state, self.names)
        return locate_poses(self.free, q, states.state, self.names)


class MeasuredPoses(PoseCoordinates):
    """Poses that were measured in full, at which closure is linearized and not solved.

    Parameters
    ----------
    T : (T | 1, n, 4, 4) [m] of every trial.
    """

    are_shared = False

    def __init__(
        self, free: FreeParameters, names: tuple[str, ...], readings: FloatArray, T: FloatArray
    ) -> None:
        super().__init__(free, names, readings)
        self.T = T

    def first_states(self, trials: IntArray) -> PoseStates:
        """Return the measured poses of trials (t,)."""
        home = super().first_states(trials)
        T = self.T if len(self.T) == 1 else self.T[trials]
        T = np.broadcast_to(T, (len(trials), *T.shape[1:]))
        return replace(home, state=replace(home.state, T=T))

    def close(
        self,
        values: FloatArray,
        poses: IntArray,
        begin: PoseStates | None,
        follow: bool,
        driven: DrivenJoints | None = None,
    ) -> PoseStates:
        """Return the measured poses as they are."""
        del values, poses, follow, driven
        assert begin is not None
        return begin

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize the loop closure."""
        del by_parameters
        return linearize_closure(self.free, values, self.readings_at(poses), states.state.T)


class ReadingCoordinates(PoseCoordinates):
    """As many actuators as freedoms: u moves the readings, in units of their sigma.

    Parameters
    ----------
    scale : (n, actuators) [SI]; 0 of exact readings.
    """

    are_shared = False
    rows_of_readings = 1

    def __init__(self, free: FreeParameters, names: tuple[str, ...], scale: FloatArray) -> None:
        super().__init__(free, names, np.zeros((1, 0, 0)))
        self.scale: FloatArray = scale
        self.count: int = scale.shape[1]
        strokes = [stroke_of(free.robot, a) for a in free.robot.actuators]
        self.longest: FloatArray = LONGEST_STEP * np.array(strokes)

    def is_free(self, poses: IntArray) -> BoolArray:
        """Return which readings (n, actuators) are not exact."""
        return self.scale[poses] > 0.0

    def close(
        self,
        values: FloatArray,
        poses: IntArray,
        begin: PoseStates | None,
        follow: bool,
        driven: DrivenJoints | None = None,
    ) -> PoseStates:
        """Solve the forward kinematics."""
        del poses, driven
        assert begin is not None
        state = forward_trials(self.free.robot, values, begin.q, begin.state, follow)
        return PoseStates(state, begin.q)

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no reading moves more than `LONGEST_STEP` of its stroke."""
        return _largest_share(u * self.scale, self.longest)

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move the readings."""
        return replace(states, q=states.q + self.scale * u)

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize by the implicit function theorem."""
        del by_parameters
        scale = self.scale[poses]
        return linearize_poses(self.free, values, states.q, states.state, self.names, scale)


class TwistCoordinates(PoseCoordinates):
    """More actuators than freedoms: u moves the platform in its freedoms, turns in units of 1 m
    over the robot's size.

    Raises
    ------
    EstimationError
        An actuator drives several limbs, so that the pose does not determine its reading.
    """

    are_shared = False

    def __init__(self, free: FreeParameters, names: tuple[str, ...]) -> None:
        super().__init__(free, names, np.zeros((1, 0, 0)))
        robot = free.robot
        drives = np.concatenate([g.actuator[g.actuator >= 0] for g in robot.program.groups])
        if len(drives) != len(robot.actuators):
            raise EstimationError(report_finding("poses.shared-actuators", robot=robot.name))
        self.places: list[int] = list(robot.program.freedoms)
        self.count: int = len(self.places)
        self.scale: FloatArray = np.array([1.0 / robot.size] * 3 + [1.0] * 3)[self.places]
        self.longest: FloatArray = (
            LONGEST_STEP * np.array([1.0] * 3 + [robot.size] * 3)[self.places]
        )

    def close(
        self,
        values: FloatArray,
        poses: IntArray,
        begin: PoseStates | None,
        follow: bool,
        driven: DrivenJoints | None = None,
    ) -> PoseStates:
        """Solve the inverse kinematics of every limb."""
        del poses, follow, driven
        assert begin is not None
        return PoseStates(*solve_at_pose(self.free.robot, values, begin.state.T, begin.state))

    def limit_step(self, u: FloatArray) -> FloatArray:
        """Return the share by which no shift exceeds `LONGEST_STEP` of the robot's size, and no
        turn as many radians.
        """
        return _largest_share(u * self.scale, self.longest)

    def move(self, states: PoseStates, u: FloatArray) -> PoseStates:
        """Move the platform."""
        twist = np.zeros((*u.shape[:2], 6))
        twist[..., self.places] = u * self.scale
        T = geometry.apply_twist(states.state.T, twist)
        return replace(states, state=replace(states.state, T=T))

    def linearize(
        self, values: FloatArray, states: PoseStates, poses: IntArray, by_parameters: bool = True
    ) -> LinearizedPoses:
        """Linearize: the pose depends on u alone, readings and passive joints on u and z."""
        del poses, by_parameters
        robot, shape = self.free.robot, states.q.shape[:2]
        Y = np.zeros((*shape, 6, self.count))
        Y[..., self.places, range(self.count)] = self.scale
        moves = differentiate_at_pose(robot, values, states.q, states.state)
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
            states.state.T,
            np.zeros(0, dtype=bool),
            np.zeros((*shape, 6, len(self.free.places))),
            joints_by_parameters=slopes,
            by_coordinates=Y,
            joints_by_coordinates=turns,
        )
        return mask_unreached(self.free, self.names, states.q, states.state, unmasked)


def stroke_of(robot: Mechanism, actuator: Actuator) -> float:
    """Return the stroke of an actuator [m or rad]; without one the robot's size, or a radian."""
    if actuator.stroke is None:
        return robot.size if actuator.dimension is Dimension.LENGTH else 1.0
    return actuator.stroke[1] - actuator.stroke[0]


def _largest_share(step: FloatArray, longest: FloatArray) -> FloatArray:
    """Return the share (a, n) of steps (a, n, k) that leaves each number within `longest` (k,)."""
    return 1.0 / np.maximum(np.abs(step) / longest, 1.0).max(axis=2, initial=1.0)
