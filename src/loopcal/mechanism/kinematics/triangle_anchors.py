# SPDX-License-Identifier: Apache-2.0
"""Where the anchors of triangle drives are, for pictures and lists."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.engine import State
from loopcal.mechanism.kinematics.link_frames import compute_limb_frames
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.states import driven_values
from loopcal.mechanism.transmission.terms import ALL_TERMS, TERMS
from loopcal.mechanism.transmission.triangle import turn_head
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Anchors:
    """The anchors of a triangle drive at n poses.

    limb : number of the limb whose joint it turns. actuator : its name.
    points : (n, 2, 3) foot and head in the base [m]. pin : (n, 3) [m] on the axis of the joint.
    """

    limb: int
    actuator: str
    points: FloatArray
    pin: FloatArray


def locate_anchors(robot: Mechanism, state: State) -> tuple[Anchors, ...]:
    """Return the anchors of all triangle drives at a state (1, n)."""
    column = {a.name: i for i, a in enumerate(robot.actuators) if a.is_triangle}
    place = {name: i for i, name in enumerate(robot.assembly.driven_joints)}
    if not column:
        return ()
    _, tau = robot.slots(robot.values[None])
    angles = driven_values(robot.program, state)[0]
    frames = compute_limb_frames(robot, robot.values[None], state)
    located = []
    for i, limb in enumerate(robot.assembly.limbs):
        for j, joint in enumerate(limb.joints):
            if joint.actuator in column:
                triangle = tau[0, column[joint.actuator], len(TERMS) : len(ALL_TERMS)]
                head = turn_head(angles[:, place[joint.actuator]], triangle)
                foot = np.broadcast_to(triangle[:3], head.shape)
                own, T = np.stack([foot, head], axis=1), frames[i][0, :, j]
                points = own @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
                located.append(Anchors(i, joint.actuator, points, T[:, :3, 3]))
    return tuple(located)
