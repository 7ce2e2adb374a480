# SPDX-License-Identifier: Apache-2.0
"""Rotations: exponential, logarithm, their derivatives, and quaternions.

All functions work elementwise over leading axes: vectors are (..., 3), rotation vectors in rad,
rotations (..., 3, 3), quaternions (..., 4) with the scalar first. Half angles and the offset
`_TINY` keep each formula free of 0/0, so that one expression is valid from zero to pi, without
branches or series.
"""

import numpy as np

from loopcal.typing import FloatArray

# Added to squared lengths before the square root: far below any square that matters, far above the
# smallest float.
_TINY = 1e-200

_HAT = np.zeros((3, 9))
"""Entries of `hat(w)`, row by row, by those of w."""
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
