# SPDX-License-Identifier: Apache-2.0
"""Poses as 4x4 matrices, and the twist by which loopcal updates and compares them.

The twist of a platform is (omega, v): omega in base axes, v the velocity of the platform ORIGIN in
base axes. An update is `R <- exp(omega) R, t <- t + v`; `pose_difference` is its inverse. Poses are
(..., 4, 4) [m], twists (..., 6) [rad, m] with the rotation first.
"""

import numpy as np

from loopcal.geometry.rotations import exp_so3, hat, log_so3, stack_blocks
from loopcal.typing import FloatArray

_LAST = np.ones((1, 1))
"""The last number of the last row of a pose."""


def make_pose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Return the homogeneous matrix `T = [R t; 0 1]` of rotation and translation (..., 3) [m].

    Leading axes broadcast against each other.
    """
    return stack_blocks(((rotation, translation[..., None]), (None, _LAST)))


def invert_pose(T: FloatArray) -> FloatArray:
    """Return the inverse pose `[R' -R't; 0 1]`: `invert_pose(T_a_b) = T_b_a`."""
    rotation = np.swapaxes(T[..., :3, :3], -1, -2)
    return make_pose(rotation, -(rotation @ T[..., :3, 3:])[..., 0])


def apply_twist(T: FloatArray, twist: FloatArray) -> FloatArray:
    """Move poses by twists: `R <- exp(omega) R`, `t <- t + v`."""
    return make_pose(exp_so3(twist[..., :3]) @ T[..., :3, :3], T[..., :3, 3] + twist[..., 3:])


def pose_difference(T_a: FloatArray, T_b: FloatArray) -> FloatArray:
    """Return the twist from pose b to pose a: `(log(R_a R_b'), t_a - t_b)`.

    It satisfies `apply_twist(T_b, pose_difference(T_a, T_b)) = T_a`.
    """
    rotation = log_so3(T_a[..., :3, :3] @ np.swapaxes(T_b[..., :3, :3], -1, -2))
    return np.concatenate([rotation, T_a[..., :3, 3] - T_b[..., :3, 3]], axis=-1)


def transport_matrix(arm: FloatArray, rotation: FloatArray | None = None) -> FloatArray:
    """Return the map (..., 6, 6) of platform twists to another point, written in other axes.

    `omega' = Q omega`, `v' = Q (v + omega x arm)`: the matrix `[[Q, 0], [-Q hat(arm), Q]]`.

    Parameters
    ----------
    arm : (..., 3) from the platform origin to the point, in base axes [m].
    rotation : (..., 3, 3) Q, from base axes to the new axes (default: base axes).
    """
    turned = np.eye(3) if rotation is None else rotation
    return stack_blocks(((turned, None), (-(turned @ hat(arm)), turned)))


def differentiate_by_frames(T: FloatArray) -> FloatArray:
    """Return the twists (..., 6, 12) of platforms by motions of their base and platform frames.

    A motion (w, c) of the base frame moves a pose by `(w, c + w x t)`, one of the platform frame by
    `(R w, R c)`.

    Parameters
    ----------
    T : (..., 4, 4) T_base_platform [m].
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    eye = np.eye(3)
    return stack_blocks(((eye, None, R, None), (-hat(t), eye, None, R)))


def differentiate_entries(T: FloatArray) -> FloatArray:
    """Return the derivative (..., 12, 6) of the numbers [R t] of poses, row by row, by the twist.

    A column r of the rotation moves by `omega x r`, the origin by `v`.
    """
    slope = np.zeros((*T.shape[:-2], 3, 4, 6))
    columns = np.swapaxes(T[..., :3, :3], -1, -2)
    slope[..., :3, :3] = -np.swapaxes(hat(columns), -3, -2)
    slope[..., 3, 3:] = np.eye(3)
    return slope.reshape(*T.shape[:-2], 12, 6)


def differentiate_by_entries(T: FloatArray) -> FloatArray:
    """Return the derivative (..., 6, 12) of the twist by the numbers of a pose.

    `omega` is half the sum of r x dr over the columns of the rotation. It is the inverse of
    `differentiate_entries` for motions of a rigid body.
    """
    scale = np.repeat([0.5, 1.0], 3)[:, None]
    return scale * np.swapaxes(differentiate_entries(T), -1, -2)
