# SPDX-License-Identifier: Apache-2.0
"""Rotations: exponential, logarithm, their derivatives, and quaternions.

All functions work elementwise over leading axes: vectors are (..., 3), rotation vectors in rad,
rotations (..., 3, 3), quaternions (..., 4) with the scalar first. Half angles and the offset
`_TINY` keep each formula free of 0/0, so that one expression is valid from zero to pi, without
branches or series.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import permutations, product

import numpy as np

from loopcal import engine
from loopcal.errors import DataError
from loopcal.numerics.elimination import eliminate_from_triangle
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

# Added to squared lengths before the square root: far below any square that matters, far above the
# smallest float.
_TINY = 1e-200
_HAT = np.zeros((3, 9))  # entries of `hat(w)`, row by row, by those of w
_HAT[0, [5, 7]], _HAT[1, [2, 6]], _HAT[2, [1, 3]] = (-1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)


def stack_matrix(rows: tuple[tuple[FloatArray | float, ...], ...]) -> FloatArray:
    """Stack a rows of b entries, which broadcast against each other, into matrices (..., a, b)."""
    shapes = {entry.shape for row in rows for entry in row if isinstance(entry, np.ndarray)}
    shape = shapes.pop() if len(shapes) == 1 else np.broadcast_shapes(*shapes)
    stacked = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            stacked[..., i, j] = entry
    return stacked


def stack_blocks(rows: tuple[tuple[FloatArray | None, ...], ...]) -> FloatArray:
    """Stack blocks (..., a, b), which broadcast against each other, into matrices; None is zero.

    The first block of each row and of each column must not be None in all of them.
    """
    blocks = [block for row in rows for block in row if block is not None]
    leading = {block.shape[:-2] for block in blocks}
    shape = leading.pop() if len(leading) == 1 else np.broadcast_shapes(*leading)
    heights = [next(b.shape[-2] for b in row if b is not None) for row in rows]
    widths = [next(b.shape[-1] for b in c if b is not None) for c in zip(*rows, strict=True)]
    stacked = np.zeros((*shape, sum(heights), sum(widths)))
    top = 0
    for height, row in zip(heights, rows, strict=True):
        left = 0
        for width, block in zip(widths, row, strict=True):
            if block is not None:
                stacked[..., top : top + height, left : left + width] = block
            left += width
        top += height
    return stacked


def hat(vector: FloatArray) -> FloatArray:
    """Return the skew matrices (..., 3, 3) of vectors: `hat(a) @ b = a x b`."""
    return np.reshape(np.matmul(vector, _HAT), (*vector.shape, 3))


def find_perpendicular(axis: FloatArray, near: FloatArray) -> FloatArray:
    """Return the unit vector (3,) across an axis that is nearest to another vector."""
    across = near - axis * (axis @ near)
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    return np.asarray(across / np.linalg.norm(across), dtype=np.float64)


def _polynomial(vector: FloatArray, first: FloatArray | float, second: FloatArray) -> FloatArray:
    """Return `I + first hat(w) + second hat(w)^2`.

    Written out, it is three times faster than products of 3x3 matrices.
    """
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    ax, ay, az = first * x, first * y, first * z
    bx, by, bz = second * x, second * y, second * z
    xx, yy, zz, xy, xz, yz = bx * x, by * y, bz * z, bx * y, bx * z, by * z
    return stack_matrix(
        (
            (1.0 - yy - zz, xy - az, xz + ay),
            (xy + az, 1.0 - xx - zz, yz - ax),
            (xz - ay, yz + ax, 1.0 - xx - yy),
        )
    )


def _angle(vector: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the length of vectors (..., 3) and its square, never exactly zero."""
    square = vector[..., 0] ** 2 + vector[..., 1] ** 2 + vector[..., 2] ** 2 + _TINY
    return np.sqrt(square), square


def exp_so3(vector: FloatArray) -> FloatArray:
    """Return the rotation about `w` by its length.

    `exp(w) = I + (sin t / t) hat(w) + (1 - cos t) / t^2 hat(w)^2`, `t = |w|`; the last factor is
    computed as `(sin(t/2) / (t/2))^2 / 2`, which does not cancel.
    """
    angle, _ = _angle(vector)
    half = np.sin(0.5 * angle) / (0.5 * angle)
    return _polynomial(vector, np.sin(angle) / angle, 0.5 * half * half)


def log_so3(rotation: FloatArray) -> FloatArray:
    """Return the rotation vector of length at most pi, the inverse of `exp_so3`.

    With the quaternion `(w, v)`, `log = 2 atan2(|v|, w) v / |v|` is as accurate near pi as near
    zero. At exactly pi both signs of the axis are correct; one of them is returned.
    """
    quaternion = matrix_to_quaternion(rotation)
    vector = quaternion[..., 1:]
    length, _ = _angle(vector)
    return (2.0 * np.arctan2(length, quaternion[..., 0]) / length)[..., None] * vector


def left_jacobian_so3(vector: FloatArray) -> FloatArray:
    """Return the derivative (..., 3, 3) of the exponential.

    To first order in `d`, `exp(w + d) = exp(J(w) d) exp(w)` with
    `J(w) = I + (1 - cos t) / t^2 hat(w) + (1 - sin t / t) / t^2 hat(w)^2`.
    """
    angle, square = _angle(vector)
    half = np.sin(0.5 * angle) / (0.5 * angle)
    return _polynomial(vector, 0.5 * half * half, (1.0 - np.sin(angle) / angle) / square)


def left_jacobian_inverse_so3(vector: FloatArray) -> FloatArray:
    """Return the derivative (..., 3, 3) of the logarithm.

    To first order in `d`, `log(exp(d) R) = log(R) + J^-1(log R) d` with
    `J^-1(w) = I - hat(w) / 2 + (1 - (t/2) cot(t/2)) / t^2 hat(w)^2`, regular for t < 2 pi.
    """
    angle, square = _angle(vector)
    half = 0.5 * angle
    return _polynomial(vector, -0.5, (1.0 - half * np.cos(half) / np.sin(half)) / square)


def quaternion_to_matrix(quaternion: FloatArray) -> FloatArray:
    """Return the rotation of a quaternion of any length but zero."""
    scale = np.sqrt(2.0 / np.sum(quaternion * quaternion, axis=-1))
    w, x, y, z = (scale * quaternion[..., i] for i in range(4))
    return stack_matrix(
        (
            (1.0 - y * y - z * z, x * y - w * z, x * z + w * y),
            (x * y + w * z, 1.0 - x * x - z * z, y * z - w * x),
            (x * z - w * y, y * z + w * x, 1.0 - x * x - y * y),
        )
    )


def matrix_to_quaternion(rotation: FloatArray) -> FloatArray:
    """Return the unit quaternion of a rotation, its scalar not negative.

    The entries of `4 q q'` are sums of entries of R. The row with the largest diagonal is `q` times
    a number that is never small; normalizing it gives `q`. Source: S. W. Shepperd, "Quaternion from
    rotation matrix", DOI 10.2514/3.55767b.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (
        tuple(rotation[..., i, j] for j in range(3)) for i in range(3)
    )
    trace = xx + yy + zz
    diagonal = (1.0 + trace, 1.0 + 2.0 * xx - trace, 1.0 + 2.0 * yy - trace, 1.0 + 2.0 * zz - trace)
    wx, wy, wz = zy - yz, xz - zx, yx - xy
    sxy, sxz, syz = xy + yx, xz + zx, yz + zy
    rows = (
        (diagonal[0], wx, wy, wz),
        (wx, diagonal[1], sxy, sxz),
        (wy, sxy, diagonal[2], syz),
        (wz, sxz, syz, diagonal[3]),
    )
    first = diagonal[0] >= diagonal[1]
    second = diagonal[2] >= diagonal[3]
    lower = np.maximum(diagonal[0], diagonal[1]) >= np.maximum(diagonal[2], diagonal[3])
    chosen = [
        np.where(lower, np.where(first, a, b), np.where(second, c, d))
        for a, b, c, d in zip(*rows, strict=True)
    ]
    scale = np.where(chosen[0] < 0.0, -1.0, 1.0) / np.sqrt(sum(entry * entry for entry in chosen))
    return np.stack([scale * entry for entry in chosen], axis=-1)


def measure_rotation_error(matrix: FloatArray) -> FloatArray:
    """Return how far matrices (..., 3, 3) are from rotations, (...).

    It is the largest entry of `|M M' - 1|`, infinite for a reflection.
    """
    error = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    volume = np.sum(np.cross(matrix[..., 0], matrix[..., 1]) * matrix[..., 2], axis=-1)
    return np.where(volume < 0.0, np.inf, error)


def project_to_rotations(matrix: FloatArray) -> FloatArray:
    """Return the rotations nearest to matrices (..., 3, 3) in the Frobenius norm."""
    U, _, V = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(U @ V))
    return (U * sign[..., None, :]) @ V


# Poses as 4x4 matrices, and the twist by which loopcal updates and compares them.

_LAST = np.ones((1, 1))  # the last number of the last row of a pose


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

    `omega' = Q omega`, `v' = Q (v + omega x arm)`: the matrix `[[Q, 0], [-Q hat(arm), Q]]`, for the
    arm (..., 3) [m] from the platform origin to the point, in base axes, and Q from base axes to
    the new ones (default: base axes).
    """
    turned = np.eye(3) if rotation is None else rotation
    return stack_blocks(((turned, None), (-(turned @ hat(arm)), turned)))


def differentiate_by_frames(T: FloatArray) -> FloatArray:
    """Return the twists (..., 6, 12) of platforms at T_base_platform (..., 4, 4) [m] by motions of
    their base and platform frames.

    A motion (w, c) of the base frame moves a pose by `(w, c + w x t)`, one of the platform frame by
    `(R w, R c)`.
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


# Orientation by three angles: the 24 Euler conventions, and tilt and torsion.

_SEQUENCES = ("xyz", "yzx", "zxy", "xzy", "yxz", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz")
EULER_ORDERS = _SEQUENCES + tuple(sequence.upper() for sequence in _SEQUENCES)
# Below this cosine (or sine) of the middle angle [1], a few ulps, two axes are parallel and the
# first angle is set to zero.
_GIMBAL = 1e-15


def wrap_angle(angle: FloatArray | float) -> FloatArray:
    """Return angles (...) plus full turns, in (-pi, pi] [rad]."""
    return np.pi - np.mod(np.pi - angle, 2.0 * np.pi)


def rotation_about_axis(angle: FloatArray | float, axis: int) -> FloatArray:
    """Return the rotations about coordinate axis 0, 1 or 2 by angles (...) [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    if axis == 0:
        return stack_matrix(((1.0, 0.0, 0.0), (0.0, c, -s), (0.0, s, c)))
    if axis == 1:
        return stack_matrix(((c, 0.0, s), (0.0, 1.0, 0.0), (-s, 0.0, c)))
    return stack_matrix(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))


def check_order(order: str) -> None:
    """Refuse an order that is none of EULER_ORDERS; raises DataError."""
    if order not in EULER_ORDERS:
        raise DataError(
            f"the Euler order {order!r} is not one of the 24: use {', '.join(_SEQUENCES)} "
            f"for rotations about fixed axes, or capitals for rotations about the moving axes"
        )


def _moving_axes(order: str) -> tuple[tuple[int, int, int], bool]:
    """Return the axes as a moving sequence, and whether the angles are in reverse (fixed axes).

    `Rz(c) Ry(b) Rx(a)` about fixed axes "xyz" is the same product as "ZYX" about moving ones.
    """
    check_order(order)
    axes = tuple("xyz".index(letter) for letter in order.lower())
    fixed = order.islower()
    first, second, third = axes[::-1] if fixed else axes
    return (first, second, third), fixed


def euler_to_matrix(angles: FloatArray, order: str) -> FloatArray:
    """Return the rotation of three Euler angles, e.g. `R = Rz(c) Ry(b) Rx(a)` for "xyz"."""
    axes, fixed = _moving_axes(order)
    moving = angles[..., ::-1] if fixed else angles
    columns = [np.eye(3)[:, i, None] for i in range(3)]
    for angle, axis in zip(moving.reshape(-1, 3).T, axes, strict=True):
        # the turn combines the columns of the two other axes
        c, s, i, j = np.cos(angle), np.sin(angle), (axis + 1) % 3, (axis + 2) % 3
        first, second = columns[i], columns[j]
        columns[i], columns[j] = first * c + second * s, second * c - first * s
    return np.stack(columns).T.copy().reshape(*angles.shape[:-1], 3, 3)


def matrix_to_euler(rotation: FloatArray, order: str) -> FloatArray:
    """Return the Euler angles of a rotation, the inverse of `euler_to_matrix`.

    With `R = Ri(a1) Rj(a2) Rk(a3)` about moving axes, a1 and a2 come from arc tangents of entries
    of R, and a3 from `Ri(a1)' R = Rj(a2) Rk(a3)`. The angles reproduce R to rounding even if the
    middle angle makes two axes parallel; the first moving angle is zero then. First and last angle
    are in (-pi, pi], the middle one in [-pi/2, pi/2] (three letters) or [0, pi] (first letter
    repeated).
    """
    (i, j, last), fixed = _moving_axes(order)
    k = 3 - i - j
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    if i == last:
        sine, cosine = rotation[..., j, i], -sign * rotation[..., k, i]
        regular = np.hypot(sine, cosine)
        second = np.arctan2(regular, rotation[..., i, i])
    else:
        sine, cosine = -sign * rotation[..., j, k], rotation[..., k, k]
        regular = np.hypot(sine, cosine)
        second = np.arctan2(sign * rotation[..., i, k], regular)
    first = np.where(regular > _GIMBAL, np.arctan2(sine, cosine), 0.0)
    # Row j of Ri(a1)' R; the middle turn is about axis j and leaves this row to the last turn
    # alone.
    row = (
        np.cos(first)[..., None] * rotation[..., j, :]
        + (sign * np.sin(first))[..., None] * rotation[..., k, :]
    )
    third = np.arctan2(-sign * row[..., k] if i == last else sign * row[..., i], row[..., j])
    return np.stack([third, second, first] if fixed else [first, second, third], axis=-1)


def euler_rates(angles: FloatArray, order: str) -> FloatArray:
    """Return E (..., 3, 3) with `omega = E d(angles)`, omega in the axes that the rotation maps to.

    About moving axes the columns are `ei`, `Ri(a1) ej`, `Ri(a1) Rj(a2) ek`. Singular if two axes
    are parallel.
    """
    (c, s, along, across), place, fixed = _rate_terms(angles, order)
    columns = ((1.0, 0.0, 0.0), (0.0, c, s), (along, -s * across, c * across))
    columns = columns[::-1] if fixed else columns
    return stack_matrix(tuple(tuple(column[a] for column in columns) for a in place))


def euler_rates_inverse(angles: FloatArray, order: str) -> FloatArray:
    """Return the inverse of `euler_rates`, `d(angles) = E^-1 omega`; huge if two axes are parallel.

    Its determinant is +-cos(a2) or +-sin(a2).
    """
    (c, s, along, across), place, fixed = _rate_terms(angles, order)
    across = _nonzero(across)
    c_third, s_third = c / across, s / across
    rows = ((1.0, along * s_third, -along * c_third), (0.0, c, s), (0.0, -s_third, c_third))
    rows = rows[::-1] if fixed else rows
    return stack_matrix(tuple(tuple(row[a] for a in place) for row in rows))


def _rate_terms(angles: FloatArray, order: str) -> tuple[tuple[FloatArray, ...], list[int], bool]:
    """Return the numbers c, s, p, r of the columns of `euler_rates` about moving axes, (1, 0, 0),
    (0, c, s) and (p, -s r, c r) along axes i, j, k; the places of x, y, z among these, and whether
    the columns are in reverse.
    """
    (i, j, last), fixed = _moving_axes(order)
    moving = angles[..., ::-1] if fixed else angles
    k, sign = 3 - i - j, 1.0 if (j - i) % 3 == 1 else -1.0
    (c, s), (cc, ss) = ((np.cos(moving[..., a]), np.sin(moving[..., a])) for a in (0, 1))
    s, ss = sign * s, sign * ss
    # Rj(a2) turns ek by ss towards ei, and ei by -ss towards ek; Ri(a1) turns ek by -s towards ej
    along, across = (cc, -ss) if last == i else (ss, cc)
    return (c, s, along, across), sorted(range(3), key=(i, j, k).__getitem__), fixed


def _nonzero(divisor: FloatArray) -> FloatArray:
    """Return a divisor without exact zeros: singular rows become huge, others stay correct."""
    return np.where(divisor == 0.0, 1e-100, divisor)


# Matrix from tilt and torsion (phi, theta, psi) to Euler angles "ZYZ" (phi, theta, psi - phi).
TO_ZYZ = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])


def tilt_torsion_to_matrix(angles: FloatArray) -> FloatArray:
    """Return the rotation of azimuth, tilt and torsion: `R = Rz(phi) Ry(theta) Rz(psi - phi)`.

    The platform normal leans by theta towards the azimuth phi; psi rotates about the normal.
    Source: I. A. Bonev, J. Ryu, "A new approach to orientation workspace analysis of 6-DOF parallel
    manipulators", DOI 10.1016/S0094-114X(00)00032-X.
    """
    return euler_to_matrix(angles @ TO_ZYZ.T, "ZYZ")


def matrix_to_tilt_torsion(rotation: FloatArray) -> FloatArray:
    """Return azimuth, tilt and torsion of a rotation, the inverse of `tilt_torsion_to_matrix`.

    phi and psi are in (-pi, pi], theta in [0, pi]. At zero tilt phi is undefined and returned as
    zero; psi is defined.
    """
    angles = matrix_to_euler(rotation, "ZYZ")
    psi = wrap_angle(angles[..., 0] + angles[..., 2])
    return np.stack([angles[..., 0], angles[..., 1], psi], axis=-1)


def tilt_torsion_rates(angles: FloatArray) -> FloatArray:
    """Return E (..., 3, 3) with `omega = E d(phi, theta, psi)`; singular at zero tilt.

    Its columns are `ez - R ez`, `Rz(phi) ey`, `R ez`.
    """
    return euler_rates(angles @ TO_ZYZ.T, "ZYZ") @ TO_ZYZ


def tilt_torsion_rates_inverse(angles: FloatArray) -> FloatArray:
    """Return the inverse of `tilt_torsion_rates`, `d(phi, theta, psi) = E^-1 omega`.

    With the normal n and its derivative e in theta, which with `Rz(phi) ey` are three orthogonal
    directions: `dphi = -e . omega / sin(theta)`, `dtheta = Rz(phi) ey . omega`, `dpsi = (n -
    tan(theta/2) e) . omega`. The first row alone is huge at zero tilt.
    """
    phi, theta = angles[..., 0], angles[..., 1]
    cphi, sphi, ctheta, stheta = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
    half, sine = np.tan(0.5 * theta), _nonzero(stheta)
    ex, ey, ez = cphi * ctheta, sphi * ctheta, -stheta
    return stack_matrix(
        (
            (-ex / sine, -ey / sine, -ez / sine),
            (-sphi, cphi, 0.0),
            (cphi * stheta - half * ex, sphi * stheta - half * ey, ctheta - half * ez),
        )
    )


# Forms of orientation in columns: rotation vector, quaternion, tilt and torsion, Euler angles.

Conversion = Callable[[FloatArray], FloatArray]


def _repeat_identity(values: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(3), (*values.shape[:-1], 3, 3))


@dataclass(frozen=True)
class OrientationForm:
    """A form in which a rotation is written; the name decides all else.

    name : its name in files, e.g. "euler-xyz".
    columns : names of its c columns. noise_columns : names of the three noises.
    dimension : of the columns.
    to_matrix : columns (..., c) to rotations (..., 3, 3). from_matrix : the inverse.
    rates : columns to E (..., 3, 3). rates_inverse : columns to E^-1, huge where E is singular.
    angles : whether the columns are three angles, of which any may be measured alone.
    """

    name: str
    columns: tuple[str, ...] = field(compare=False)
    noise_columns: tuple[str, str, str] = field(compare=False)
    dimension: Dimension = field(compare=False)
    to_matrix: Conversion = field(compare=False, repr=False)
    from_matrix: Conversion = field(compare=False, repr=False)
    rates: Conversion = field(default=_repeat_identity, compare=False, repr=False)
    rates_inverse: Conversion = field(default=_repeat_identity, compare=False, repr=False)
    angles: bool = field(default=False, compare=False)


_SIMPLE = {
    form.name: form
    for form in (
        OrientationForm(
            "rotation-vector",
            ("rx", "ry", "rz"),
            ("rx", "ry", "rz"),
            Dimension.ANGLE,
            exp_so3,
            log_so3,
        ),
        OrientationForm(
            "quaternion",
            ("qw", "qx", "qy", "qz"),
            ("rx", "ry", "rz"),
            Dimension.RATIO,
            quaternion_to_matrix,
            matrix_to_quaternion,
        ),
        OrientationForm(
            "tilt-torsion",
            ("phi", "theta", "psi"),
            ("phi", "theta", "psi"),
            Dimension.ANGLE,
            tilt_torsion_to_matrix,
            matrix_to_tilt_torsion,
            tilt_torsion_rates,
            tilt_torsion_rates_inverse,
            angles=True,
        ),
    )
}


def parse_orientation(name: str) -> OrientationForm:
    """Return the form of orientation with this name.

    Names are "rotation-vector", "quaternion" (scalar first, any length), "tilt-torsion", and
    "euler-" with one of the 24 orders. Raises DataError for another name.
    """
    if name in _SIMPLE:
        return _SIMPLE[name]
    if not name.startswith("euler-"):
        raise DataError(
            f"unknown orientation form {name!r}. Use {', '.join(_SIMPLE)}, or euler- and an order "
            "such as euler-xyz"
        )
    order = name.removeprefix("euler-")
    check_order(order)
    return OrientationForm(
        name,
        ("a", "b", "c"),
        ("a", "b", "c"),
        Dimension.ANGLE,
        partial(euler_to_matrix, order=order),
        partial(matrix_to_euler, order=order),
        partial(euler_rates, order=order),
        partial(euler_rates_inverse, order=order),
        angles=True,
    )


# Alignment in closed form: frames, points and centers from points, poses, rays or lengths.

_SIGNED_PERMUTATIONS = [
    np.eye(3)[list(order)] * sign
    for order in permutations(range(3))
    for sign in product((1.0, -1.0), repeat=3)
]
# The 24 rotations (24, 3, 3) of a cube: every rotation is within 63 degrees of one of them.
OCTAHEDRAL_ROTATIONS: FloatArray = np.array(
    [R for R in _SIGNED_PERMUTATIONS if np.linalg.det(R) > 0.0]
)
OCTAHEDRAL_ROTATIONS.setflags(write=False)

TINY = 1e-300  # divisor [1] in place of zero
FLATNESS = 1e-6  # ratio of extents [1] below which points count as coplanar, or as collinear
ROTATION_CHANGE = 1e-6  # change of a rotation [rad] that ends `minimize_over_rotations`
MEETING = 0.03  # angle [rad] between two starts from which one of them stands for both

NEWTON_STEPS, FLATTEST, ROUNDING = 40, 1e-9, 1e-15
"""Steps of Newton's method on rotations, of which a dozen are usual; the curvature, as a share of
the trace of its form, below which a direction counts as flat; the rounding of values of the form.
"""

GENERATORS = hat(np.eye(3))  # matrices (3, 3, 3) of the cross products with the three axes
GENERATORS.setflags(write=False)

ALIGNMENT_TOLERANCE = 1e-9  # singular values below this share of the largest count as zero [1]

ANCHOR_TOLERANCE, ANCHOR_RANK = 1e-6, 4
"""Relative singular value [1] below which positions do not determine the anchor of a line, and the
rank that determines it.
"""


def solve_least_squares(A: FloatArray, b: FloatArray) -> FloatArray:
    """Return the least-squares solution of `A x = b`, the shortest one where it is not unique.

    Singular values below `ALIGNMENT_TOLERANCE` times the largest count as zero.
    """
    return np.asarray(np.linalg.lstsq(A, b, rcond=ALIGNMENT_TOLERANCE)[0], dtype=float)


def align_point_sets(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the pose T (4, 4) that minimizes `sum |T p - r|^2` over points p, reference r (r, 3).

    Source: Umeyama, IEEE Transactions on Pattern Analysis 13(4) 376, 1991, doi 10.1109/34.88573,
    without the scale.
    """
    middle, center = points.mean(axis=0), reference.mean(axis=0)
    R = project_to_rotations((reference - center).T @ (points - middle))
    return make_pose(R, center - R @ middle)


def minimize_over_rotations(
    H: FloatArray,
    g: FloatArray,
    count: int = 3,
    constant: FloatArray | None = None,
    worth: float = np.inf,
) -> list[FloatArray]:
    """Return for each of s forms the rotations (k, 3, 3) at the lowest local minima of
    `v' H v - 2 g' v`, at most `count` different ones, for positive semidefinite H (s, 9, 9).

    The vector v holds the nine entries of R row by row. Newton's method on the rotation group
    begins at the rotation nearest to the unconstrained minimum and at the 24 rotations of a cube.

    With a `constant` (s,), which makes the forms sums of squares, the cube is left out where every
    other minimum is proven to have more than `worth` times the sum of the first one. Let F be the
    sum less that of the unconstrained minimum, and a and b the smallest and the largest eigenvalue
    of H. On the shortest path between two rotations with F < a^2 / b, F is at most twice as large,
    and half its second derivative, at least 2 a - sqrt(2 b F), is positive: of both only one is a
    minimum.
    """
    scale = np.maximum(np.trace(H, axis1=1, axis2=2), TINY)[:, None]
    H, g = H / scale[..., None], g / scale  # values and curvatures of order one
    size, axes = np.linalg.eigh(H)
    along = (g[:, None] @ axes)[:, 0]
    is_used = size > ALIGNMENT_TOLERANCE * size[:, -1:]
    free = np.divide(along, size, out=np.zeros_like(along), where=is_used)
    R = project_to_rotations((axes @ free[..., None]).reshape(-1, 1, 3, 3))
    is_only = np.zeros(len(H), dtype=bool)
    if constant is not None and worth < np.inf:
        R, value, _ = _descend_over_rotations(H, g, R)
        rest = constant / scale[:, 0] - (along * free).sum(axis=1)
        most = worth * (value[:, 0] + constant / scale[:, 0]) - rest
        is_only = size[:, -1] * np.maximum(most, ROUNDING) < np.maximum(size[:, 0], 0.0) ** 2
    ends, others = list(R), np.flatnonzero(~is_only)
    if others.size:
        cube = np.broadcast_to(OCTAHEDRAL_ROTATIONS, (len(others), *OCTAHEDRAL_ROTATIONS.shape))
        begin = np.concatenate([R[others], cube], axis=1)
        found = zip(*_descend_over_rotations(H[others], g[others], begin), strict=True)
        for i, (r, v, on) in zip(others, found, strict=True):
            ends[i] = r[on][np.argsort(v[on])[:count]]
    return ends


def _descend_over_rotations(
    H: FloatArray, g: FloatArray, begin: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return where Newton's method leads from rotations (s, c, 3, 3), the values (s, c) of the
    forms there, and which starts went on to their end.

    It takes the absolute curvatures, and a radius that a failed step quarters. Of starts that meet,
    one goes on. Near a minimum it converges quadratically however large the residual is, where
    Gauss-Newton does not.
    """
    R, of = begin.reshape(-1, 3, 3).copy(), np.repeat(np.arange(len(H)), begin.shape[1])
    value = _evaluate_form(H[of], g[of], R)
    radius, active, order = np.ones(len(R)), np.arange(len(R)), np.arange(begin.shape[1])
    goes_on = np.ones(begin.shape[:2], dtype=bool)
    for _ in range(NEWTON_STEPS):
        if not active.size:
            break
        form, linear = H[of[active]], g[of[active]]
        step = _find_newton_step(form, linear, R[active])
        length = np.linalg.norm(step, axis=1)
        longest = np.minimum(length, radius[active])
        moved = exp_so3(step * (longest / np.maximum(length, TINY))[:, None]) @ R[active]
        new_value = _evaluate_form(form, linear, moved)
        better = new_value < value[active] + ROUNDING
        R[active[better]], value[active[better]] = moved[better], new_value[better]
        radius[active] = np.where(better, np.minimum(1.0, 2.0 * radius[active]), 0.25 * longest)
        entries = R.reshape(len(H), -1, 9)
        meets = entries @ np.swapaxes(entries, 1, 2) >= 3.0 - MEETING**2  # 1 + 2 cos(angle)
        goes_on &= np.argmax(meets & goes_on[:, None], axis=2) == order
        active = active[(longest > ROTATION_CHANGE) & goes_on.ravel()[active]]
    return R.reshape(begin.shape), value.reshape(goes_on.shape), goes_on


def _evaluate_form(H: FloatArray, g: FloatArray, R: FloatArray) -> FloatArray:
    """Return `v' H v - 2 g' v` (k,) of rotations R (k, 3, 3), each with its form."""
    v = R.reshape(-1, 9)
    return (((v[:, None] @ H)[:, 0] - 2.0 * g) * v).sum(axis=1)


def _find_newton_step(H: FloatArray, g: FloatArray, R: FloatArray) -> FloatArray:
    """Return rotation vectors w (k, 3) from R (k, 3, 3): minus the gradient of half the form by w
    in exp(w) R, over the absolute values of its curvatures.
    """
    slope = (R.reshape(-1, 1, 9) @ H)[:, 0] - g
    first = (GENERATORS @ R[:, None]).reshape(-1, 3, 9)
    # the product of generators i and j is e_j e_i' - (i = j), that of the second derivatives
    bend = slope.reshape(-1, 3, 3) @ np.swapaxes(R, 1, 2)
    bend = (
        0.5 * (bend + np.swapaxes(bend, 1, 2))
        - np.eye(3) * np.einsum("kii->k", bend)[:, None, None]
    )
    size, axes = np.linalg.eigh(first @ H @ np.swapaxes(first, 1, 2) + bend)
    along = (np.swapaxes(axes, 1, 2) @ (first @ slope[..., None]))[..., 0]
    return -(axes @ (along / np.maximum(np.abs(size), FLATTEST))[..., None])[..., 0]


def solve_hand_eye(
    T: FloatArray, measured: FloatArray, frame: FloatArray | None, tool: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return frame F and tool X (4, 4) with `F measured = T X`, for poses T_base_platform and
    T_frame_tool (r, 4, 4). At most one of F and X is given; None where unknown.

    Rotations: the trace of `sum R_F' R_T R_X R_measured'` is largest at the leading singular
    vectors of `sum R_T kron R_measured` (Shah, Journal of Mechanisms and Robotics 5(3) 031007,
    2013, doi 10.1115/1.4024473). Translations follow from a linear system.
    """
    A, B = T[:, :3, :3], measured[:, :3, :3]
    if tool is not None:
        R_X = tool[:3, :3]
        R_F = project_to_rotations(np.einsum("rij,jk,rlk->il", A, R_X, B))
    elif frame is not None:
        R_F = frame[:3, :3]
        R_X = project_to_rotations(np.einsum("rji,jk,rkl->il", A, R_F, B))
    else:
        K = np.einsum("rij,rkl->ikjl", A, B).reshape(9, 9)
        U, _, V = np.linalg.svd(K)
        left, right = U[:, 0].reshape(3, 3), V[0].reshape(3, 3)
        sign = 1.0 if np.linalg.det(left) > 0.0 else -1.0
        R_F, R_X = project_to_rotations(sign * left), project_to_rotations(sign * right)
    # R_F m + t_F = A t_X + t
    t_F, t_X = (np.zeros(3) if known is None else known[:3, 3] for known in (frame, tool))
    rhs = T[:, :3, 3] - measured[:, :3, 3] @ R_F.T - t_F + A @ t_X
    parts = (np.broadcast_to(np.eye(3), A.shape), frame), (-A, tool)
    columns = np.concatenate([part for part, known in parts if known is None], axis=-1)
    solution = solve_least_squares(columns.reshape(rhs.size, -1), rhs.ravel())
    if frame is None:
        t_F = solution[:3]
    if tool is None:
        t_X = solution[-3:]
    return make_pose(R_F, t_F), make_pose(R_X, t_X)


def solve_frame_and_points(
    measured: FloatArray, moving: FloatArray, constant: FloatArray, worth: float = np.inf
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return candidates of a frame (k, 4, 4) and of the coordinates p (k, w) of points on a moving
    body with `R measured + t = moving p + constant`, for s sets of measured (s, q, 3), NaN where
    missing, moving (s, q, 3, w) and constant (s, q, 3); and the set (k,) of each, in order.

    For a given rotation R the other unknowns enter linearly. Eliminating them leaves a quadratic
    form of R; `worth` as of `minimize_over_rotations`.
    """
    (s, q), w = measured.shape[:2], moving.shape[-1]
    is_there = np.asarray(~np.isnan(measured).any(axis=-1))[..., None]
    fixed = np.broadcast_to(-np.eye(3), (s, q, 3, 3))
    C = np.concatenate([moving, fixed], axis=-1) * is_there[..., None]
    C = C.reshape(s, 3 * q, w + 3)
    known = np.where(is_there, measured, 0.0)
    M = (np.eye(3)[:, :, None] * known[:, :, None, None, :]).reshape(s, 3 * q, 9)
    b = (constant * is_there).reshape(s, 3 * q, 1)
    R, u = engine.fold(np.zeros((s, w + 13, w + 13)), np.concatenate([C, M, b], axis=-1)), w + 3
    done = eliminate_from_triangle(R[:, :u, :u], R[:, :u, u:], R[:, u:, u:])
    form, least = np.swapaxes(done.rest[..., :9], 1, 2) @ done.rest, done.rest[..., 9]
    given = form[..., :9], form[..., 9], 3, (least * least).sum(axis=1)
    rotations = minimize_over_rotations(*given, worth)
    of, R = np.repeat(np.arange(s), [len(each) for each in rotations]), np.concatenate(rotations)
    rest = (done.solution[..., :9][of] @ R.reshape(-1, 9, 1))[..., 0] - done.solution[of, :, 9]
    return make_pose(R, rest[:, w:]), rest[:, :w], of


def solve_resection(rays: FloatArray, points: FloatArray) -> FloatArray:
    """Return candidate frames (k, 4, 4) of a station from rays to known points (r, 3) in the base
    [m], the best first; rays are unit vectors b (r, 3) in the frame of the station.

    `(1 - b b') (A p - s) = 0` with A = R' and s = R' t is linear in A and s. Eliminating s leaves a
    quadratic form of A.
    """
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    middle = points.mean(axis=0)
    M = np.einsum("rij,rk->rijk", across, points - middle).reshape(-1, 9)
    C = across.reshape(-1, 3)
    of_M = solve_least_squares(C, M)
    out = M - C @ of_M
    A = minimize_over_rotations((out.T @ out)[None], np.zeros((1, 9)), count=8)[0]
    s = A.reshape(-1, 9) @ of_M.T
    ahead = np.einsum("ri,kij,rj->kr", rays, A, points - middle) - np.einsum("ri,ki->kr", rays, s)
    order = np.argsort(-np.mean(ahead > 0.0, axis=1), kind="stable")
    R = np.swapaxes(A, -1, -2)
    return make_pose(R, (R @ s[..., None])[..., 0] + middle)[order]


def solve_trilateration(
    points: FloatArray, distances: FloatArray, *, with_offset: bool
) -> tuple[FloatArray, FloatArray]:
    """Return centers c (k, 3) and offsets o (k,) with `|p - c| + o = d` for points p (r, 3) [m] and
    distances d (r,) [m]; o is 0 unless it is unknown (`with_offset`).

    `|p|^2 - d^2 = 2 p'c - 2 d o - (|c|^2 - o^2)` is linear in c, o and the bracket. Distances from
    points near a plane do not determine on which side of it c is, so both sides are candidates: k
    is 3, or 2 where the points are coplanar.
    """
    middle = points.mean(axis=0)
    p = points - middle
    _, s, axes = np.linalg.svd(p, full_matrices=False)
    columns = [2.0 * p, -np.ones((len(p), 1))] + (
        [-2.0 * distances[:, None]] if with_offset else []
    )
    solution = solve_least_squares(
        np.concatenate(columns, axis=1), np.sum(p * p, axis=1) - distances**2
    )
    offset, center, normal = solution[4] if with_offset else 0.0, solution[:3], axes[2]
    foot = center - (center @ normal) * normal
    height = np.sqrt(
        max(float(np.mean((distances - offset) ** 2 - np.sum((p - foot) ** 2, axis=1))), 0.0)
    )
    centers = foot + height * np.array([[1.0], [-1.0]]) * normal
    if s[2] > FLATNESS * s[0]:
        centers = np.concatenate([center[None], centers])
    return middle + centers, np.full(len(centers), offset)


def solve_line_anchor(
    positions: FloatArray, extensions: FloatArray
) -> tuple[FloatArray, int, FloatArray]:
    """Return the anchor a (3,) of a line from positions x (k, 3) and the extensions d (k,) of the
    line at them, the rank of the equations, and their singular values.

    A line from a to x is d longer than at the origin: `|x - a| = |a| + d`, and therefore `x'a + d
    |a| = (x'x - d^2) / 2`, which is linear in a and |a|. Below `ANCHOR_RANK` the positions are too
    few, or in a plane through the origin, and the anchor is not determined.
    """
    rows = np.column_stack([positions, extensions])
    target = 0.5 * ((positions * positions).sum(axis=1) - extensions * extensions)
    solution, _, rank, s = np.linalg.lstsq(rows, target, rcond=ANCHOR_TOLERANCE)
    return solution[:3], int(rank), s


def solve_directions(
    measured: FloatArray, rotations: FloatArray, axis: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Return orientations R (k, 3, 3) and directions a (k, 3) with `R measured = rotations a`, the
    best first, for unit vectors (r, 3) in the frame of the instrument and rotations (r, 3, 3).

    The sum of `measured' R' rotations a` is largest: for given a, at a projection; for any a, where
    the length of its factor by a, which is linear in R, is largest. A given `axis` (3,) is a.
    """
    if axis is not None:
        R = project_to_rotations(np.einsum("rij,j,rk->ik", rotations, axis, measured))
        return R[None], axis[None]
    S = np.einsum("rji,rl->ijl", rotations, measured).reshape(3, 9)
    form = np.linalg.norm(S) ** 2 * np.eye(9) - S.T @ S
    R = minimize_over_rotations(form[None], np.zeros((1, 9)), 6)[0]
    a = R.reshape(-1, 9) @ S.T
    return R, a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), TINY)
