# SPDX-License-Identifier: Apache-2.0
"""Triangle drives: a linear actuator that turns a revolute joint through two anchor points.

The foot F is fixed before the joint, the head H moves with it; both are in the joint's own frame,
with its z axis along the joint and the joint at zero. S = exp([s_x, s_y, 0]) tilts the joint's axis
in that frame (the skew). The length of the actuator at the joint angle theta is

    l = |F - S Rz(theta) S' H|.

With u = S'F and v = S'H, each at the distance rho from the axis,

    l^2 = |u|^2 + |v|^2 - 2 u_z v_z - 2 rho_u rho_v cos(theta - gamma),

gamma the angle between them at theta = 0. A length has two angles, one on each side of the dead
points theta = gamma and gamma + pi; the drive is on the side of its start. Derivation:
docs/theory/triangle-drives.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import geometry
from loopcal.typing import FloatArray

TRIANGLE_TERMS = (
    *("foot.x", "foot.y", "foot.z", "head.x", "head.y", "head.z", "skew.x", "skew.y"),
    *("side", "middle"),
)
"""Terms of a triangle, (.., 10). `side` is +1 or -1, the sign of sin(theta - gamma), and `middle`
the nominal angle between the dead points; no parameter changes these two."""
MOVABLE = 8
"""Number of the terms that parameters can change."""


def compute_angle(length: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the joint angle [rad] at a length (..) [m] of triangles (.., 10).

    It is NaN where no angle reaches the length, which a negative one never does.
    """
    level, reach, gamma = _describe(triangle)
    side, middle = triangle[..., 8], triangle[..., 9]
    with np.errstate(invalid="ignore"):
        square = np.where(length < 0.0, np.nan, length * length)
        opening = np.arccos((level - square) / reach)
    return middle + geometry.wrap_angle(gamma + side * opening - middle)


def compute_length(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the length of the actuator [m] at joint angles (..) [rad] of triangles (.., 10)."""
    level, reach, gamma = _describe(triangle)
    return np.sqrt(level - reach * np.cos(angle - gamma))


def compute_range(triangle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lengths [m] at the dead points of triangles (.., 10): the least, the largest."""
    level, reach, _ = _describe(triangle)
    return np.sqrt(np.maximum(level - reach, 0.0)), np.sqrt(level + reach)


def find_side(start: float, triangle: FloatArray) -> tuple[float, float]:
    """Return sin(theta - gamma) at a start angle [rad], and the middle of its side [rad].

    triangle : (10,), of which the last two are not used.
    """
    _, _, gamma = _describe(triangle)
    lead = geometry.wrap_angle(start - gamma)
    sine = float(np.sin(lead))
    return sine, float(start - lead + np.sign(sine) * np.pi / 2)


def turn_head(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the head (.., 3) [m] at joint angles (..) of triangles (.., 10), h = S Rz S' H."""
    return _apply(_turn(angle, triangle), triangle[..., 3:6])


def differentiate_length(angle: FloatArray, triangle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of the length by the angle (..) and by the movable terms (.., 8).

    With n the unit vector from head to foot, k the axis of the joint and h the turned head:
    dl/dtheta = k . (n x h), the arm of the actuator's force; dl/dF = n; dl/dH = -Q'n with
    Q = S Rz S'; dl/ds = J_l' (H x Q'n - h x n) with the left Jacobian J_l of S.
    """
    foot, head = triangle[..., 0:3], triangle[..., 3:6]
    skew = _pad(triangle[..., 6:8])
    S, Q = geometry.exp_so3(skew), _turn(angle, triangle)
    turned = _apply(Q, head)
    n = foot - turned
    n = n / np.sqrt((n * n).sum(axis=-1, keepdims=True))
    back = _apply(np.swapaxes(Q, -1, -2), n)
    arm = (S[..., :, 2] * np.cross(n, turned)).sum(axis=-1)
    tilt = np.cross(head, back) - np.cross(turned, n)
    slope = np.swapaxes(geometry.left_jacobian_so3(skew), -1, -2)
    by_skew = np.einsum("...ij,...j->...i", slope, tilt)[..., :2]
    shape = np.broadcast_shapes(n.shape, (*by_skew.shape[:-1], 1))[:-1]
    slopes = [np.broadcast_to(d, (*shape, d.shape[-1])) for d in (n, -back, by_skew)]
    return arm, np.concatenate(slopes, axis=-1)


def _describe(triangle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a, b and gamma of l^2 = a - b cos(theta - gamma) for triangles (.., 10)."""
    tilt = np.swapaxes(geometry.exp_so3(_pad(triangle[..., 6:8])), -1, -2)
    u, v = _apply(tilt, triangle[..., 0:3]), _apply(tilt, triangle[..., 3:6])
    level = (u * u).sum(axis=-1) + (v * v).sum(axis=-1) - 2 * u[..., 2] * v[..., 2]
    reach = 2 * np.hypot(u[..., 0], u[..., 1]) * np.hypot(v[..., 0], v[..., 1])
    gamma = np.arctan2(u[..., 1], u[..., 0]) - np.arctan2(v[..., 1], v[..., 0])
    return level, reach, gamma


def _turn(angle: FloatArray, triangle: FloatArray) -> FloatArray:
    """Return the rotations (.., 3, 3) of the head, S Rz(theta) S'."""
    S = geometry.exp_so3(_pad(triangle[..., 6:8]))
    return S @ geometry.rotation_about_axis(angle, 2) @ np.swapaxes(S, -1, -2)


def _pad(skew: FloatArray) -> FloatArray:
    """Return skews (.., 2) as rotation vectors (.., 3)."""
    return np.concatenate([skew, np.zeros_like(skew[..., :1])], axis=-1)


def _apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return matrices (.., 3, 3) times vectors (.., 3)."""
    return np.matmul(matrix, vector[..., None])[..., 0]
