# SPDX-License-Identifier: Apache-2.0
"""Is a position allowed? Strokes of the readings, limits of the joints, cones of the rods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from loopcal.engine import State
from loopcal.mechanism.frames import compute_limb_frames
from loopcal.mechanism.model import Mechanism
from loopcal.typing import BoolArray, FloatArray


@dataclass(frozen=True)
class Limit:
    """One quantity that must stay between two bounds.

    Attributes
    ----------
    name : in words, e.g. `stroke of q3`. low, high : bounds [m or rad]. value : (t, n) [m or rad].
    """

    name: str
    low: float
    high: float
    value: FloatArray

    @property
    def margin(self) -> FloatArray:
        """Distance to the nearer bound (t, n), negative outside [m or rad]."""
        return np.minimum(self.value - self.low, self.high - self.value)


def evaluate_limits(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> tuple[Limit, ...]:
    """Everything that limits the machine, at readings q (t | 1, n, a) and their states (t, n)."""
    found = [
        Limit(f"stroke of {a.name}", *a.stroke, np.broadcast_to(q[..., i], state.status.shape))
        for i, a in enumerate(robot.actuators)
        if a.stroke is not None
    ]
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        for k, i in enumerate(group.limbs):
            limb = robot.assembly.limbs[i]
            found += [
                Limit(f"{limb.name}.{joint.name}", *joint.limits, joints[:, :, k, j])
                for j, joint in enumerate(limb.joints)
                if joint.limits is not None
            ]
    if any(limb.cones for limb in robot.assembly.limbs):
        found += _cones(robot, values, state)
    return tuple(found)


def check_limits(
    robot: Mechanism, values: FloatArray, q: FloatArray, state: State
) -> tuple[BoolArray, NDArray[np.object_]]:
    """Which rows are allowed (t, n), and what forbids the others in words (t, n), '' where nothing
    does.
    """
    allowed, why = np.ones(state.status.shape, bool), np.full(state.status.shape, "", dtype=object)
    for limit in evaluate_limits(robot, values, q, state):
        # a bound itself is allowed, up to the rounding of its own number
        outside = ~(limit.margin >= -1e-12 * max(abs(limit.low), abs(limit.high)))
        first = outside & allowed
        for row in zip(*np.nonzero(first), strict=True):
            why[row] = (
                f"{limit.name} is {limit.value[row]:.6g}, allowed are {limit.low:.6g} to "
                f"{limit.high:.6g} (SI units)"
            )
        allowed &= ~outside
    return allowed, why


def _cones(robot: Mechanism, values: FloatArray, state: State) -> list[Limit]:
    """Angles between rods and the axes of their cones."""
    found = []
    for limb, frames in zip(
        robot.assembly.limbs, compute_limb_frames(robot, values, state), strict=True
    ):
        rod = frames[:, :, -1, :3, 3] - frames[:, :, -2, :3, 3]
        rod = rod / np.linalg.norm(rod, axis=-1, keepdims=True)
        for cone in limb.cones:
            frame, sign = (frames[:, :, -2], 1.0) if cone.end == "tip" else (frames[:, :, -1], -1.0)
            axis = frame[..., :3, :3] @ (np.array(cone.axis) / np.linalg.norm(cone.axis))
            lean = np.arctan2(
                np.linalg.norm(np.cross(axis, rod), axis=-1), sign * (axis * rod).sum(axis=-1)
            )
            found.append(Limit(f"lean of {limb.name} at its {cone.end}", 0.0, cone.angle, lean))
    return found
