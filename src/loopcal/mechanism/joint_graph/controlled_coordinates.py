# SPDX-License-Identifier: Apache-2.0
"""Coordinates in which a mechanism can be commanded: those that its motions change independently.

Orientations are roll, pitch and yaw, or phi, theta and psi where home is near pitch +-90 degrees,
at which roll and yaw are the same rotation.
"""

from __future__ import annotations

import numpy as np

from loopcal.mechanism.platform_coordinates import (
    EULER,
    POSITION,
    TILT,
    compare_coordinates,
    read_coordinates,
)
from loopcal.typing import FloatArray

INDEPENDENT = 1e-3
"""Singular value, relative to the largest rate, above which coordinates are independent [1]."""

STEEP = 0.2
"""Cosine of the pitch below which roll and yaw are not used [1]."""


def choose_coordinates(T: FloatArray, twists: FloatArray) -> tuple[str, ...]:
    """Return coordinates of a platform that move independently, positions first.

    Parameters
    ----------
    T : (4, 4) of the platform at home. twists : (6, m) for the m motions of the mechanism,
        (rotation, translation) [rad, m].
    """
    is_steep = np.hypot(T[0, 0], T[1, 0]) < STEEP
    names = (*POSITION, *(TILT if is_steep else EULER))
    slope = compare_coordinates(T[None], read_coordinates(T[None], names), names, 1.0)[1][0]
    rates = slope @ twists
    chosen: list[int] = []
    # phi and theta are one direction, and are named together
    for group in ([0], [1], [2], *([[3, 4], [5]] if is_steep else [[3], [4], [5]])):
        rows = rates[[*chosen, *group]]
        s = np.linalg.svd(rows, compute_uv=False)
        if len(rows) <= twists.shape[1] and s[-1] > INDEPENDENT * np.abs(twists).max():
            chosen += group
    return tuple(names[i] for i in chosen)
