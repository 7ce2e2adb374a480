# SPDX-License-Identifier: Apache-2.0
"""Rotations: exponential, logarithm, their derivatives, and quaternions.

All functions work elementwise over leading axes. Half angles and the offset `_TINY` keep each
formula free of 0/0, so that one expression is valid from zero to pi, without branches or series.
"""

import numpy as np

from loopcal.typing import FloatArray

# Added to squared lengths before the square root: far below any square that matters, far above the
# smallest float.
_TINY = 1e-200


def stack_matrix(rows: tuple[tuple[FloatArray | float, ...], ...]) -> FloatArray:
    """Stack entries of equal shape (...) row by row into matrices.

    Parameters
    ----------
    rows : nested tuple, a rows of b entries
        Each entry (...); entries broadcast against each other.

    Returns
    -------
    stacked : (..., a, b)
    """
    shape = np.broadcast_shapes(*{np.shape(entry) for row in rows for entry in row})
    stacked = np.empty((*shape, len(rows), len(rows[0])))
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            stacked[..., i, j] = entry
    return stacked


def hat(vector: FloatArray) -> FloatArray:
    """Return the skew matrix of a vector: `hat(a) @ b = a x b`.

    Parameters
    ----------
    vector : (..., 3)

    Returns
    -------
    skew : (..., 3, 3), same unit
    """
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    return stack_matrix(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


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

    Parameters
    ----------
    vector : (..., 3) [rad]

    Returns
    -------
    rotation : (..., 3, 3)
    """
    angle, _ = _angle(vector)
    half = np.sin(0.5 * angle) / (0.5 * angle)
    return _polynomial(vector, np.sin(angle) / angle, 0.5 * half * half)


def log_so3(rotation: FloatArray) -> FloatArray:
    """Return the rotation vector of length at most pi, the inverse of `exp_so3`.

    With the quaternion `(w, v)`, `log = 2 atan2(|v|, w) v / |v|` is as accurate near pi as near
    zero. At exactly pi both signs of the axis are correct; one of them is returned.

    Parameters
    ----------
    rotation : (..., 3, 3)

    Returns
    -------
    vector : (..., 3) [rad]
    """
    quaternion = matrix_to_quaternion(rotation)
    vector = quaternion[..., 1:]
    length, _ = _angle(vector)
    return (2.0 * np.arctan2(length, quaternion[..., 0]) / length)[..., None] * vector


def left_jacobian_so3(vector: FloatArray) -> FloatArray:
    """Return the derivative of the exponential.

    To first order in `d`, `exp(w + d) = exp(J(w) d) exp(w)` with
    `J(w) = I + (1 - cos t) / t^2 hat(w) + (1 - sin t / t) / t^2 hat(w)^2`.

    Parameters
    ----------
    vector : (..., 3) [rad]

    Returns
    -------
    jacobian : (..., 3, 3)
    """
    angle, square = _angle(vector)
    half = np.sin(0.5 * angle) / (0.5 * angle)
    return _polynomial(vector, 0.5 * half * half, (1.0 - np.sin(angle) / angle) / square)


def left_jacobian_inverse_so3(vector: FloatArray) -> FloatArray:
    """Return the derivative of the logarithm.

    To first order in `d`, `log(exp(d) R) = log(R) + J^-1(log R) d` with
    `J^-1(w) = I - hat(w) / 2 + (1 - (t/2) cot(t/2)) / t^2 hat(w)^2`, regular for t < 2 pi.

    Parameters
    ----------
    vector : (..., 3) [rad]

    Returns
    -------
    inverse : (..., 3, 3)
    """
    angle, square = _angle(vector)
    half = 0.5 * angle
    return _polynomial(vector, -0.5, (1.0 - half * np.cos(half) / np.sin(half)) / square)


def quaternion_to_matrix(quaternion: FloatArray) -> FloatArray:
    """Return the rotation of a quaternion; the quaternion is normalized first.

    Parameters
    ----------
    quaternion : (..., 4)
        Scalar first, any length but zero.

    Returns
    -------
    rotation : (..., 3, 3)
    """
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
    """Return the unit quaternion of a rotation, scalar first and not negative.

    The entries of `4 q q'` are sums of entries of R. The row with the largest diagonal is `q` times
    a number that is never small; normalizing it gives `q`.

    Parameters
    ----------
    rotation : (..., 3, 3)

    Returns
    -------
    quaternion : (..., 4)

    References
    ----------
    S. W. Shepperd, "Quaternion from rotation matrix", DOI 10.2514/3.55767b.
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
        np.where(
            lower, np.where(first, rows[0][j], rows[1][j]), np.where(second, rows[2][j], rows[3][j])
        )
        for j in range(4)
    ]
    scale = np.where(chosen[0] < 0.0, -1.0, 1.0) / np.sqrt(sum(entry * entry for entry in chosen))
    return np.stack([scale * entry for entry in chosen], axis=-1)


def project_to_rotation(matrix: FloatArray) -> tuple[FloatArray, float]:
    """Return the rotation nearest to a matrix, and how far the matrix is from a rotation.

    With the singular value decomposition M = U S V', the nearest rotation is U V' (Frobenius norm).

    Parameters
    ----------
    matrix : (3, 3)

    Returns
    -------
    rotation : (3, 3)
    error : largest entry of |M M' - 1|; infinite for a reflection.
    """
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    U, _, Vt = np.linalg.svd(matrix)
    return U @ Vt, float("inf") if np.linalg.det(matrix) < 0.0 else error
