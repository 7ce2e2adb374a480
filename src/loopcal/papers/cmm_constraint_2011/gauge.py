# SPDX-License-Identifier: Apache-2.0
"""The nine directions of a hexapod's 42 parameters that plane and line cannot determine, by name.

    base shifted along k      db_i = k             the end point moves along k everywhere
    base rotated about k      db_i = k x b_i       it rotates about the base's origin everywhere
    platform rotated about k  dp_i = k x p_i       it does not move at all

for k = x, y, z. The first six move all points as one body, which changes no distance and no angle
between them.
"""

from __future__ import annotations

import numpy as np

from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray

AXES = ("x", "y", "z")
NAMES = tuple(
    f"{what} {axis}"
    for what in ("base shifted along", "base rotated about", "platform rotated about")
    for axis in AXES
)


def list_gauge_directions(robot: Mechanism) -> FloatArray:
    """Return changes of the parameters (9, p) in the order of NAMES, [m per m] and [m per rad]."""
    table = robot.parameters
    names = [leg.name for leg in robot.assembly.limbs]
    changes = np.zeros((9, len(table)))
    for leg in names:
        base, platform = (
            [table.index(f"{leg}.{end}.{axis}") for axis in AXES] for end in ("base", "platform")
        )
        changes[0:3, base] = np.eye(3)
        changes[3:6, base] = np.cross(np.eye(3), robot.values[base])
        changes[6:9, platform] = np.cross(np.eye(3), robot.values[platform])
    return changes


def remove_gauge(robot: Mechanism, deviation: FloatArray) -> FloatArray:
    """Return deviations (.., p) [m] without their part along the nine directions."""
    basis = np.linalg.qr(list_gauge_directions(robot).T)[0]
    return deviation - (deviation @ basis) @ basis.T
