# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of a single limb whose joints are all driven: the product of its links.

No loop is to be closed: T = L_0 J_1 L_1 .. J_J L_J A^-1 with the displaced links L, the joint
motions J and the attachment A on the platform.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.engine import CONVERGED, NOT_FINITE, State
from loopcal.mechanism.closure.limb_frames import follow_limb
from loopcal.mechanism.model import Mechanism
from loopcal.typing import FloatArray


def solve_serial(
    robot: Mechanism, e: FloatArray, driven: FloatArray, shape: tuple[int, ...] = (1, 1)
) -> State:
    """Return the state (t, n) at driven joint values (t | 1, n, a) and displacements e (t | 1, d).

    Rows whose joint values are not finite are marked. `shape` : (t, n) of the start, 1 broadcasts.
    """
    (group,) = robot.program.groups
    t, n = max(len(e), len(driven), shape[0]), max(driven.shape[1], shape[1])
    joints = np.zeros((t, n, len(group.actuator)))
    joints[..., : len(group.joints)] = driven[..., group.actuator[: len(group.joints), 0]]
    with np.errstate(invalid="ignore"):
        frames, attachment = follow_limb(group, 0, e, joints)
        T = np.broadcast_to(frames[-1] @ geometry.invert_pose(attachment), (t, n, 4, 4))
    finite = np.isfinite(joints).all(axis=2)
    zero = np.zeros((t, n))
    return State(
        np.array(T),
        (joints[:, :, None],),
        np.where(finite, np.int8(CONVERGED), np.int8(NOT_FINITE)),
        np.where(finite, zero, np.nan),
        zero.astype(np.int64),
        np.ones((t, n), np.int8),
    )
