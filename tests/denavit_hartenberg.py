# SPDX-License-Identifier: Apache-2.0
"""The shipped 6R arm in the convention of Denavit and Hartenberg, written without loopcal."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

RIGHT = np.pi / 2
ARM_6R = np.array(
    [
        (0.160, -RIGHT, 0.520, 0.0),
        (0.580, 0.0, 0.0, -RIGHT),
        (0.125, -RIGHT, 0.0, 0.0),
        (0.0, RIGHT, 0.620, 0.0),
        (0.0, -RIGHT, 0.0, 0.0),
        (0.0, 0.0, 0.100, 0.0),
    ]
)
"""a [m], alpha [rad], d [m], offset of theta [rad]: a link is Rz(theta) Tz(d) Tx(a) Rx(alpha)."""

FLANGE = np.array([[0, 0, 1.0], [0, -1.0, 0], [1.0, 0, 0]])
"""Orientation of the platform in the last frame, whose z axis is that of the last joint."""


def join(rotation: Array, position: Array) -> Array:
    """Return poses (.., 4, 4) of rotations (.., 3, 3) and positions (.., 3)."""
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], position.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, position, 1.0
    return T


def multiply_denavit_hartenberg(q: Array, links: Array = ARM_6R, beta: float = 0.0) -> Array:
    """Return the end poses (n, 4, 4) of readings (n, 6).

    beta : Hayati's angle [rad] about y behind the second link, whose axis is parallel to the next.
    """
    T = np.eye(4)
    for i, ((a, alpha, d, offset), angle) in enumerate(zip(links, q.T, strict=True)):
        theta = angle + offset
        places = np.stack([a * np.cos(theta), a * np.sin(theta), np.full_like(theta, d)], axis=1)
        turn = Rotation.from_euler("XY", [alpha, beta if i == 1 else 0.0]).as_matrix()
        about_z = Rotation.from_euler("Z", theta[:, None]).as_matrix()
        T = T @ join(about_z, places) @ join(turn, np.zeros(3))
    return T @ join(FLANGE, np.zeros(3))
