# SPDX-License-Identifier: Apache-2.0
"""Poses as 4x4 matrices, and the twist by which loopcal updates and compares them.

The twist of a platform is (omega, v): omega in base axes, v the velocity of the platform ORIGIN in
base axes. An update is `R <- exp(omega) R, t <- t + v`; `pose_difference` is its inverse.
`adjoint_matrix` belongs to the other, spatial, convention; it serves files and programs that use
that one.
"""

import numpy as np

from loopcal.geometry.rotations import exp_so3, hat, log_so3, stack_matrix
from loopcal.typing import FloatArray


def make_pose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the homogeneous matrix `T = [R t; 0 1]`.

    Parameters
    ----------
    rotation : (..., 3, 3)
    translation : (..., 3) [m]
        Leading axes broadcast against those of `rotation`.

    Returns
    -------
    T : (..., 4, 4)
    """
    rows = tuple(
        (rotation[..., i, 0], rotation[..., i, 1], rotation[..., i, 2], translation[..., i])
        for i in range(3)
    )
    return stack_matrix((*rows, (0.0, 0.0, 0.0, 1.0)))


def compose_poses(*poses: FloatArray) -> FloatArray:
    """Multiply poses from left to right: `T_a_c = compose_poses(T_a_b, T_b_c)`.

    Parameters
    ----------
    *poses : (..., 4, 4)

    Returns
    -------
    T : (..., 4, 4)
    """
    product = np.eye(4)
    for factor in poses:
        product = product @ factor
    return product


def invert_pose(T: FloatArray) -> FloatArray:
    """Return the inverse pose `[R' -R't; 0 1]`: `invert_pose(T_a_b) = T_b_a`.

    Parameters
    ----------
    T : (..., 4, 4)

    Returns
    -------
    T_inverse : (..., 4, 4)
    """
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_pose(rotation, -(rotation @ T[..., :3, 3:])[..., 0])


def apply_twist(T: FloatArray, twist: FloatArray) -> FloatArray:
    """Move poses by twists: `R <- exp(omega) R`, `t <- t + v`.

    Parameters
    ----------
    T : (..., 4, 4)
    twist : (..., 6) [rad, m]
        Rotation first.

    Returns
    -------
    T_updated : (..., 4, 4)
    """
    return make_pose(exp_so3(twist[..., :3]) @ T[..., :3, :3], T[..., :3, 3] + twist[..., 3:])


def pose_difference(T_a: FloatArray, T_b: FloatArray) -> FloatArray:
    """Return the twist from pose b to pose a: `(log(R_a R_b'), t_a - t_b)`.

    It satisfies `apply_twist(T_b, pose_difference(T_a, T_b)) = T_a`.

    Parameters
    ----------
    T_a, T_b : (..., 4, 4)

    Returns
    -------
    twist : (..., 6) [rad, m]
        Rotation first.
    """
    rotation = log_so3(T_a[..., :3, :3] @ np.swapaxes(T_b[..., :3, :3], -1, -2))
    return np.concatenate([rotation, T_a[..., :3, 3] - T_b[..., :3, 3]], axis=-1)


def adjoint_matrix(T: FloatArray) -> FloatArray:
    """Return the map of SPATIAL twists between frames: `V_a = adjoint_matrix(T_a_b) V_b`.

    The matrix is `[[R, 0], [hat(t) R, R]]`. In a spatial twist the translation part is the velocity
    of the body's point that coincides with the origin of the frame in which the twist is written;
    this is not the twist of `apply_twist`. With `V^` the 4x4 matrix of the twist, `expm(V_a^) T_a_b
    = T_a_b expm(V_b^)`.

    Parameters
    ----------
    T : (..., 4, 4)

    Returns
    -------
    adjoint : (..., 6, 6)
        Rotation first.
    """
    rotation = T[..., :3, :3]
    return _blocks(rotation, hat(T[..., :3, 3]) @ rotation, rotation)


def transport_matrix(arm: FloatArray, rotation: FloatArray | None = None) -> FloatArray:
    """Return the map of platform twists to another point of the platform, written in other axes.

    `omega' = Q omega`, `v' = Q (v + omega x arm)`: a 6x6 matrix `[[Q, 0], [-Q hat(arm), Q]]`.

    Parameters
    ----------
    arm : (..., 3) [m]
        From the platform origin to the point, in base axes.
    rotation : (..., 3, 3), optional
        Q, from base axes to the new axes (default: base axes).

    Returns
    -------
    transport : (..., 6, 6)
    """
    turned = np.eye(3) if rotation is None else rotation
    lever = -(turned @ hat(arm))
    return _blocks(
        np.broadcast_to(turned, lever.shape), lever, np.broadcast_to(turned, lever.shape)
    )


def _blocks(first: FloatArray, lower: FloatArray, second: FloatArray) -> FloatArray:
    """Return the 6x6 matrices `[[first, 0], [lower, second]]` of 3x3 blocks."""
    top = np.concatenate([first, np.zeros_like(first)], axis=-1)
    return np.concatenate([top, np.concatenate([lower, second], axis=-1)], axis=-2)
