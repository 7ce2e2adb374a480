# SPDX-License-Identifier: Apache-2.0
"""Householder triangularization of thousands of small matrices, the batch as contiguous axis.

Shapes are (rows, columns, batch). All operations are element-wise, so that the result of one
matrix never depends on its neighbors, bit for bit; a singular matrix gives infinities and does not
stop the others. Derivation: docs/theory/engine.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray

SMALLEST = 1e-300
"""Least divisor: far below every square of a length that matters, and without infinities."""
PART = 8
"""Rows of a part of many rows that are folded, over their columns."""


def triangularize(matrix: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Return Q' matrix (r, c, batch), upper triangular in its first columns, and det Q' (batch,).

    The determinant is +1 or -1.
    """
    m = matrix.copy()
    reflections = np.zeros((min(columns, max(len(m) - 1, 0)), *m.shape[2:]))
    for j in range(len(reflections)):
        v, alpha = m[j:, j].copy(), reflections[j]
        np.sqrt(np.add.reduce(v * v, axis=0), out=alpha)
        np.copysign(alpha, -v[0], out=alpha)
        v[0] -= alpha
        # v'v = 2 |alpha| (|alpha| + |v0|); a zero column has v = 0 and stays as it is
        beta = 1.0 / np.maximum(-alpha * v[0], SMALLEST)
        right = m[j:, j + 1 :]
        right -= v[:, None] * (beta * np.einsum("i...,ij...->j...", v, right))
        m[j, j] = alpha
        m[j + 1 :, j] = 0.0
    odd = np.add.reduce(reflections != 0.0, axis=0) % 2
    return m, 1.0 - 2.0 * odd


def back_substitute(upper: FloatArray, right: FloatArray) -> FloatArray:
    """Solve upper x = right for (u, u, batch) and (u, c, batch).

    A pivot of zero gives infinities or NaN.
    """
    x = np.empty_like(right)
    for i in range(len(upper) - 1, -1, -1):
        known = np.add.reduce(upper[i, i + 1 :, None] * x[i + 1 :], axis=0)
        x[i] = (right[i] - known) / upper[i, i]
    return x


def fold(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the triangular factor of a stack; see `loopcal.engine.fold`.

    The stack is triangularized by QR, many rows in parts that fit the cache.
    """
    t, p = factor.shape[:2]
    # a factor of no rows would be most of the stack where rows are few
    begin = factor if rows.shape[1] >= p or factor.any() else factor[:, :0]
    stack = [begin, np.broadcast_to(rows, (t, *rows.shape[1:]))]
    height = PART * p
    count = rows.shape[1] // height
    if count > 1:
        parts = stack[1][:, : count * height].reshape(t, count, height, p)
        factors = np.asarray(np.linalg.qr(parts, mode="r"))
        stack[1:] = factors.reshape(t, count * p, p), stack[1][:, count * height :]
    R = np.asarray(np.linalg.qr(np.concatenate(stack, axis=1), mode="r"))
    missing = p - R.shape[1]
    return np.concatenate([R, np.zeros((t, missing, p))], axis=1) if missing else R
