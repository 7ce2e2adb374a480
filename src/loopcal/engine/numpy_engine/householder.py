# SPDX-License-Identifier: Apache-2.0
"""Householder triangularization of thousands of small matrices, the batch as contiguous axis.

Shapes are (rows, columns, batch). All operations are element-wise, so that the result of one
matrix never depends on its neighbors, bit for bit; a singular matrix gives infinities and does not
stop the others. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray

# Least divisor: far below every square of a length that matters, and without infinities.
SMALLEST = 1e-300
PART = 8  # rows of a part of many rows that are folded, over their columns


def triangularize(m: FloatArray, columns: int) -> FloatArray:
    """Return Q'm (r, c, batch), upper triangular in its first columns, in the memory of m.

    Each reflects a column x to alpha e0 by v = x - alpha e0, and another one y to
    y + v (x'y - alpha y0) / (alpha v0).
    """
    for j in range(count_reflections(len(m), columns)):
        v, right = m[j:, j], m[j:, j + 1 :]
        products = np.einsum("i...,ij...->j...", v, m[j:, j:])
        alpha = np.copysign(np.sqrt(products[0]), -v[0])
        v[0] -= alpha
        share = products[1:]
        share -= alpha * right[0]
        share /= np.minimum(alpha * v[0], -SMALLEST)  # a zero column has v = 0 and stays as it is
        right += v[:, None] * share
        v[0], v[1:] = alpha, 0.0
    return m


def count_reflections(rows: int, columns: int) -> int:
    """Return how many reflections triangularize a matrix; each turns the determinant's sign."""
    return min(columns, max(rows - 1, 0))


def back_substitute(upper: FloatArray, right: FloatArray) -> FloatArray:
    """Solve upper x = right for (u, u, batch) and (u, c, batch).

    A pivot of zero gives infinities or NaN.
    """
    x = right.copy()
    for i in range(len(upper) - 1, -1, -1):
        x[i] /= upper[i, i]
        x[:i] -= upper[:i, i, None] * x[i]
    return x


def fold(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Return the triangular factor of a stack; see `loopcal.engine.fold`.

    The stack is triangularized by QR, many rows in parts that fit the cache.
    """
    t, p = factor.shape[:2]
    rows, height = np.broadcast_to(rows, (t, *rows.shape[1:])), PART * p
    count, stack = rows.shape[1] // height, [factor, rows]
    if count > 1:
        divided = rows[:, : count * height].reshape(t, count, height, p)
        factors = np.asarray(np.linalg.qr(divided, mode="r"))
        stack = [factor, factors.reshape(t, count * p, p), rows[:, count * height :]]
    return np.asarray(np.linalg.qr(np.concatenate(stack, axis=1), mode="r"))
