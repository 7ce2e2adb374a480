# SPDX-License-Identifier: Apache-2.0
"""Where every pose really stands, if its readings are not exact: a solution of closure moved by a
few free numbers u.

Closure linearised, A y + Q dq + E de = 0, leaves the pose y and the readings q as many free
directions as its null space has. Two bases of that null space are used, each exact and each with
the pose closed by the kinematics themselves:

    as many actuators as freedoms:  u moves the readings, dq = diag(s) u,   y = -A^-1 (E de + Q dq)
    more actuators than freedoms:   u moves the pose,     y = diag(s) u,    dq = -Q^-1 (A y + E de)

A reading that is exact has s = 0: it has no direction, and nothing is divided by it. See
docs/theory/latent.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from loopcal import engine, geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.moves import Moves, mapped
from loopcal.measure import select_joint_values
from loopcal.mechanism import (
    Actuator,
    Mechanism,
    Status,
    differentiate_at_pose,
    differentiate_passive_joints,
    differentiate_pose,
    forward_trials,
    solve_at_pose,
)
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

LONGEST = 0.25
"""Longest step of a reading, as a share of its stroke, or of a pose, of the robot's size: beyond,
closure is not linear.
"""


@dataclass(frozen=True, eq=False)
class Standing:
    """Poses of a trials: their states (a, n) and their true readings q (a, n, actuators) [SI]."""

    state: engine.State
    q: FloatArray

    def of(self, trials: IntArray) -> Standing:
        """Some trials."""
        return Standing(mapped(lambda array: array[trials], self.state), self.q[trials])

    def at(self, poses: IntArray) -> Standing:
        """Some poses."""
        return Standing(mapped(lambda array: array[:, poses], self.state), self.q[:, poses])

    def put(self, chosen: tuple[IntArray | slice, IntArray | slice], other: Standing) -> Standing:
        """A copy with some rows (trials, poses) taken from another one."""

        def replaced(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            out = np.array(old)
            out[chosen] = new
            return out

        return Standing(mapped(replaced, self.state, other.state), replaced(self.q, other.q))


@dataclass(frozen=True, eq=False)
class FreeMoves(Moves):
    """Poses of a block that move with the parameters and with their own k free numbers u.

    Y (a, n, 6, k) : pose by u. turns : joint -> (a, n, k) by u.
    """

    Y: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 6, 0)))
    turns: dict[str, FloatArray] = field(default_factory=dict)


class Chart(Protocol):
    """How u moves poses that agree with closure."""

    freedoms: int

    def free(self, poses: IntArray) -> np.ndarray:
        """(n, k) which numbers may move at all."""
        ...

    def closed(self, values: FloatArray, here: Standing, follow: bool) -> Standing:
        """Solve closure at parameter values (a, p) from where poses stand; what u moves stays as it
        is.

        `follow` tells whether a pose that Newton does not solve is worth following, or a nearer one
        will be tried anyway.
        """
        ...

    def share(self, u: FloatArray) -> FloatArray:
        """Largest share (a, n) of steps u (a, n, k), at most 1, that linearised closure can be
        asked for.
        """
        ...

    def moved(self, here: Standing, u: FloatArray, poses: IntArray) -> Standing:
        """Move by u (a, n, k), closure not yet solved."""
        ...

    def linearised(
        self, values: FloatArray, here: Standing, poses: IntArray, needed: np.ndarray
    ) -> FreeMoves:
        """How closed poses move by the scaled parameters and by u."""
        ...


class ByReadings:
    """As many actuators as freedoms: u moves the readings, in units of their sigma.

    Parameters
    ----------
    unknowns : the free parameters. scale : (n, a) [SI]. joints : names that kinds look at.
    """

    def __init__(
        self, unknowns: FreeParameters, scale: FloatArray, joints: tuple[str, ...]
    ) -> None:
        self.unknowns, self.scale, self.joints = unknowns, scale, joints
        self.freedoms = scale.shape[1]
        self.longest = LONGEST * np.array(
            [stroke_of(unknowns.robot, a) for a in unknowns.robot.actuators]
        )

    def free(self, poses: IntArray) -> np.ndarray:
        """(n, a) readings that are not exact."""
        return self.scale[poses] > 0.0

    def closed(self, values: FloatArray, here: Standing, follow: bool) -> Standing:
        """Forward kinematics."""
        return Standing(
            forward_trials(self.unknowns.robot, values, here.q, here.state, follow), here.q
        )

    def share(self, u: FloatArray) -> FloatArray:
        """No reading by more than `LONGEST` of its stroke."""
        return _share(u * self.scale, self.longest)

    def moved(self, here: Standing, u: FloatArray, poses: IntArray) -> Standing:
        """Readings moved."""
        return replace(here, q=here.q + self.scale[poses] * u)

    def linearised(
        self, values: FloatArray, here: Standing, poses: IntArray, needed: np.ndarray
    ) -> FreeMoves:
        """By the implicit function theorem."""
        robot, state, scale = self.unknowns.robot, here.state, self.scale[poses]
        found = differentiate_pose(robot, values, here.q, state)
        D, Y = _free(self.unknowns, found.parameters), found.readings * scale[:, None, :]
        names = [actuator.name for actuator in robot.actuators]
        turns = {
            n: np.eye(self.freedoms)[names.index(n)] * scale[None]
            for n in self.joints
            if n in names
        }
        slopes = {}
        passive = [name for name in self.joints if name not in turns]
        if passive:
            moved = differentiate_passive_joints(robot, values, here.q, state)
            places = [moved.names.index(name) for name in passive]
            slopes = {
                n: _free(self.unknowns, moved.parameters[:, :, i])
                for n, i in zip(passive, places, strict=True)
            }
            turns |= {
                n: moved.readings[:, :, i] * scale for n, i in zip(passive, places, strict=True)
            }
        return _safe(self.unknowns, self.joints, here, needed, D, Y, slopes, turns)


class ByPose:
    """More actuators than freedoms: u moves the platform in its freedoms, turns in units of 1 m
    over the robot's size.

    Raises
    ------
    EstimationError
        An actuator drives several limbs, so that the pose does not give its reading.
    """

    def __init__(self, unknowns: FreeParameters, joints: tuple[str, ...]) -> None:
        robot = unknowns.robot
        drives = np.concatenate([g.actuator[g.actuator >= 0] for g in robot.program.groups])
        if len(drives) != len(robot.actuators):
            raise EstimationError(
                f"{robot.name} has redundant actuators that drive several limbs each, so that "
                "noise of their readings cannot be"
                " estimated; give each limb an actuator of its own"
            )
        self.unknowns, self.joints = unknowns, joints
        self.places = list(robot.program.freedoms)
        self.freedoms = len(self.places)
        self.scale = np.array([1.0 / robot.size] * 3 + [1.0] * 3)[self.places]

    def free(self, poses: IntArray) -> np.ndarray:
        """(n, m): all."""
        return np.ones((len(poses), self.freedoms), dtype=bool)

    def closed(self, values: FloatArray, here: Standing, follow: bool) -> Standing:
        """Inverse kinematics of every limb."""
        del follow
        return Standing(*solve_at_pose(self.unknowns.robot, values, here.state.T, here.state))

    def share(self, u: FloatArray) -> FloatArray:
        """No shift by more than `LONGEST` of the robot's size, no turn by more than as many
        radians.
        """
        return _share(
            u * self.scale,
            LONGEST * np.array([1.0] * 3 + [self.unknowns.robot.size] * 3)[self.places],
        )

    def moved(self, here: Standing, u: FloatArray, poses: IntArray) -> Standing:
        """Poses moved."""
        twist = np.zeros((*u.shape[:2], 6))
        twist[..., self.places] = u * self.scale
        return replace(here, state=replace(here.state, T=geometry.apply_twist(here.state.T, twist)))

    def linearised(
        self, values: FloatArray, here: Standing, poses: IntArray, needed: np.ndarray
    ) -> FreeMoves:
        """The pose by u alone, readings and passive joints by both."""
        robot, shape = self.unknowns.robot, here.q.shape[:2]
        D = np.zeros((*shape, 6, len(self.unknowns)))
        Y = np.zeros((*shape, 6, self.freedoms))
        Y[..., self.places, range(self.freedoms)] = self.scale
        found = differentiate_at_pose(robot, values, here.q, here.state)
        slopes, turns = {}, {}
        parts = (
            ([a.name for a in robot.actuators], found.readings),
            (list(found.names), found.passive),
        )
        for names, (by_parameter, by_freedom) in parts:
            for i, name in enumerate(names):
                if name in self.joints:
                    slopes[name] = _free(self.unknowns, by_parameter[:, :, i])
                    turns[name] = by_freedom[:, :, i] * self.scale
        return _safe(self.unknowns, self.joints, here, needed, D, Y, slopes, turns)


def stroke_of(robot: Mechanism, actuator: Actuator) -> float:
    """What an actuator can move by, about [m or rad]; where its stroke is not stated the robot's
    size, or a radian.
    """
    if actuator.stroke is None:
        return robot.size if actuator.dimension is Dimension.LENGTH else 1.0
    return actuator.stroke[1] - actuator.stroke[0]


def _share(step: FloatArray, longest: FloatArray) -> FloatArray:
    """Share (a, n) of steps (a, n, k) that leaves each number within the longest one (k,)."""
    return 1.0 / np.maximum(np.abs(step) / longest, 1.0).max(axis=2, initial=1.0)


def _free(unknowns: FreeParameters, by_parameter: FloatArray) -> FloatArray:
    """Columns of the free parameters in units of their tolerance."""
    return by_parameter[..., unknowns.places] * unknowns.tolerance


def _safe(
    unknowns: FreeParameters,
    joints: tuple[str, ...],
    here: Standing,
    needed: np.ndarray,
    D: FloatArray,
    Y: FloatArray,
    slopes: dict[str, FloatArray],
    turns: dict[str, FloatArray],
) -> FreeMoves:
    """Moves with zeros where a pose failed."""
    finite = [np.isfinite(array).all(axis=tuple(range(2, array.ndim))) for array in (D, Y, here.q)]
    finite += [np.isfinite(a).all(axis=2) for a in (*slopes.values(), *turns.values())]
    ok = np.asarray(here.state.status == Status.CONVERGED)
    for one in finite:
        ok = ok & one
    values = select_joint_values(unknowns.robot, joints, here.q, here.state)

    def where(array: np.ndarray) -> FloatArray:
        return (
            array
            if ok.all()
            else np.where(ok.reshape(*ok.shape, *[1] * (array.ndim - 2)), array, 0.0)
        )

    T = here.state.T if ok.all() else np.where(ok[..., None, None], here.state.T, np.eye(4))
    return FreeMoves(
        T,
        ok,
        np.any(~ok & needed, axis=1),
        where(D),
        joints={name: where(value) for name, value in values.items()},
        slopes={name: where(slope) for name, slope in slopes.items()},
        Y=where(Y),
        turns={
            name: np.broadcast_to(
                where(np.broadcast_to(t, (*ok.shape, t.shape[-1]))), (*ok.shape, t.shape[-1])
            )
            for name, t in turns.items()
        },
    )
