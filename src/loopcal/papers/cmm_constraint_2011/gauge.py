# SPDX-License-Identifier: Apache-2.0
"""The nine directions of a hexapod's 42 parameters that no plane and line can tell, by name.

    base shifted along k      db_i = k             the end point moves along k everywhere
    base turned about k       db_i = k x b_i       it turns about the base's origin everywhere
    platform turned about k   dp_i = k x p_i       it does not move at all

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
    for what in ("base shifted along", "base turned about", "platform turned about")
    for axis in AXES
)


def gauge_directions(robot: Mechanism) -> FloatArray:
    """Changes of the parameters (9, p), in the order of NAMES, [m per m] and [m per rad], at the
    robot's values.
    """
    table = robot.parameters
    names = [leg.name for leg in robot.assembly.limbs]
    found = np.zeros((9, len(table)))
    for leg in names:
        base, platform = (
            [table.index(f"{leg}.{end}.{axis}") for axis in AXES] for end in ("base", "platform")
        )
        found[0:3, base] = np.eye(3)
        found[3:6, base] = np.cross(np.eye(3), robot.values[base])
        found[6:9, platform] = np.cross(np.eye(3), robot.values[platform])
    return found


def without_gauge(robot: Mechanism, deviation: FloatArray) -> FloatArray:
    """Deviations (.., p) [m] with their part along the nine directions taken out."""
    basis = np.linalg.qr(gauge_directions(robot).T)[0]
    return deviation - (deviation @ basis) @ basis.T
