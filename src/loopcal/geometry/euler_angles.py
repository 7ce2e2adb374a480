# SPDX-License-Identifier: Apache-2.0
"""Orientation by three angles: the 24 Euler conventions, and tilt and torsion.

Each has functions to and from a matrix and `rates`, the matrix E with `omega = E d(angles)`. Order
names, EULER_ORDERS, follow scipy: lower case turns about fixed axes ("xyz": first about x, then y,
then z of the base, `R = Rz Ry Rx`), upper case about the moving ones ("XYZ": `R = Rx Ry Rz`). An
unknown order raises DataError. Angles (..., 3) [rad] are in the order of the letters, rotations
(..., 3, 3). These functions are not those of scipy.spatial.transform because of the rates, the
leading axes, exact angles where two axes are parallel, and the time that its import takes.
"""

import numpy as np

from loopcal.errors import DataError
from loopcal.geometry.rotations import stack_matrix
from loopcal.typing import FloatArray

_SEQUENCES = ("xyz", "yzx", "zxy", "xzy", "yxz", "zyx", "xyx", "xzx", "yxy", "yzy", "zxz", "zyz")
EULER_ORDERS = _SEQUENCES + tuple(sequence.upper() for sequence in _SEQUENCES)

# Below this cosine (or sine) of the middle angle [1], a few ulps, two axes are parallel and the
# first angle is set to zero.
_GIMBAL = 1e-15

Vector = tuple[FloatArray, ...]
"""Three components (...) of vectors."""


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
            f"the Euler order {order!r} is not one of the 24: use {', '.join(_SEQUENCES)} for "
            "rotations about fixed axes, or the same in capitals for rotations about the moving "
            "axes"
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
    columns, fixed = _rate_columns(angles, order)
    columns = columns[::-1] if fixed else columns
    return stack_matrix(tuple(zip(*columns, strict=True)))


def euler_rates_inverse(angles: FloatArray, order: str) -> FloatArray:
    """Return the inverse of `euler_rates`, `d(angles) = E^-1 omega`; huge if two axes are parallel.

    The rows are cross products of the columns of E over its determinant, +-cos(a2) or +-sin(a2).
    """
    (first, second, third), fixed = _rate_columns(angles, order)
    across = _cross(second, third)
    determinant = _nonzero(across[0] * first[0] + across[1] * first[1] + across[2] * first[2])
    rows = (across, _cross(third, first), _cross(first, second))
    rows = rows[::-1] if fixed else rows
    return stack_matrix(tuple(tuple(entry / determinant for entry in row) for row in rows))


def _rate_columns(angles: FloatArray, order: str) -> tuple[tuple[Vector, ...], bool]:
    """Return the columns of `euler_rates` about moving axes, and whether they are in reverse."""
    (i, j, last), fixed = _moving_axes(order)
    moving = angles[..., ::-1] if fixed else angles
    k, sign = 3 - i - j, 1.0 if (j - i) % 3 == 1 else -1.0
    (c, s), (cc, ss) = ((np.cos(moving[..., a]), np.sin(moving[..., a])) for a in (0, 1))
    s, ss = sign * s, sign * ss
    # Rj(a2) turns ek by ss towards ei, and ei by -ss towards ek; Ri(a1) turns ek by -s towards ej
    along, across = (cc, -ss) if last == i else (ss, cc)
    zero, one = np.zeros_like(c), np.ones_like(c)
    by_axes = ((one, zero, zero), (zero, c, s), (along, -s * across, c * across))
    place = np.argsort((i, j, k))
    return tuple(tuple(column[a] for a in place) for column in by_axes), fixed


def _cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product of vectors given by their components."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _nonzero(divisor: FloatArray) -> FloatArray:
    """Return a divisor without exact zeros: singular rows become huge, others stay correct."""
    return np.where(divisor == 0.0, 1e-100, divisor)


def tilt_torsion_to_matrix(
    phi: FloatArray | float, theta: FloatArray | float, psi: FloatArray | float
) -> FloatArray:
    """Return the rotation of azimuth, tilt and torsion: `R = Rz(phi) Ry(theta) Rz(psi - phi)`.

    The platform normal leans by theta towards the azimuth phi; psi rotates about the normal.
    Source: I. A. Bonev, J. Ryu, "A new approach to orientation workspace analysis of 6-DOF parallel
    manipulators", DOI 10.1016/S0094-114X(00)00032-X.
    """
    return (
        rotation_about_axis(phi, 2)
        @ rotation_about_axis(theta, 1)
        @ rotation_about_axis(psi - phi, 2)
    )


def matrix_to_tilt_torsion(rotation: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return azimuth, tilt and torsion of a rotation, the inverse of `tilt_torsion_to_matrix`.

    phi and psi are in (-pi, pi], theta in [0, pi]. At zero tilt phi is undefined and returned as
    zero; psi is defined.
    """
    angles = matrix_to_euler(rotation, "ZYZ")
    phi, theta = angles[..., 0], angles[..., 1]
    return phi, theta, wrap_angle(phi + angles[..., 2])


def tilt_torsion_rates(
    phi: FloatArray | float, theta: FloatArray | float, psi: FloatArray | float
) -> FloatArray:
    """Return E (..., 3, 3) with `omega = E d(phi, theta, psi)`; singular at zero tilt.

    Its columns are `ez - R ez`, `Rz(phi) ey`, `R ez`. psi has no effect, since the torsion comes
    first; it makes all rates have equal arguments.
    """
    cphi, sphi, ctheta, stheta = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
    nx, ny, nz = cphi * stheta, sphi * stheta, ctheta + 0.0 * psi
    return stack_matrix(((-nx, -sphi, nx), (-ny, cphi, ny), (1.0 - nz, 0.0, nz)))


def tilt_torsion_rates_inverse(
    phi: FloatArray | float, theta: FloatArray | float, psi: FloatArray | float
) -> FloatArray:
    """Return the inverse of `tilt_torsion_rates`, `d(phi, theta, psi) = E^-1 omega`.

    With the normal n and its derivative e in theta, which with `Rz(phi) ey` are three orthogonal
    directions: `dphi = -e . omega / sin(theta)`, `dtheta = Rz(phi) ey . omega`, `dpsi = (n -
    tan(theta/2) e) . omega`. The first row alone is huge at zero tilt.
    """
    cphi, sphi, ctheta, stheta = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta)
    half = np.tan(0.5 * theta) + 0.0 * psi
    ex, ey, ez = cphi * ctheta, sphi * ctheta, -stheta
    sine = _nonzero(stheta)
    return stack_matrix(
        (
            (-ex / sine, -ey / sine, -ez / sine),
            (-sphi, cphi, 0.0),
            (cphi * stheta - half * ex, sphi * stheta - half * ey, ctheta - half * ez),
        )
    )
