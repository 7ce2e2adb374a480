# SPDX-License-Identifier: Apache-2.0
"""Small dense matrices by the thousand: Householder triangularisation with the batch as the
contiguous axis.

Shapes are (rows, columns, batch). Only element-wise operations are used, so the result of one
matrix never depends on its neighbours, bit for bit, and a singular one yields infinities without
stopping the others. See docs/theory/engine.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray


def triangularize(matrix: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Q' matrix (r, c, batch) with its first columns upper triangular, and the determinant +-1 of
    Q' (batch,).
    """
    m = matrix.copy()
    sign = np.ones(m.shape[2:])
    for j in range(min(columns, len(m) - 1)):
        v = m[j:, j].copy()
        norm = np.sqrt(np.add.reduce(v * v, axis=0))
        alpha = -np.copysign(norm, v[0])
        v[0] -= alpha
        # v'v = 2 norm (norm + |v0|); a zero column keeps beta = 0 and is left alone
        vv = -alpha * v[0]
        beta = np.divide(1.0, vv, out=np.zeros_like(vv), where=vv > 0)
        right = m[j:, j + 1 :]
        right -= v[:, None] * (beta * np.einsum("i...,ij...->j...", v, right))
        m[j, j] = alpha
        m[j + 1 :, j] = 0.0
        sign = np.where(beta > 0, -sign, sign)
    return m, sign


def back_substitute(upper: FloatArray, right: FloatArray) -> FloatArray:
    """Solve upper x = right for (u, u, batch) and (u, c, batch); a zero pivot yields infinities or
    NaN.
    """
    x = np.empty_like(right)
    for i in range(len(upper) - 1, -1, -1):
        x[i] = (right[i] - np.add.reduce(upper[i, i + 1 :, None] * x[i + 1 :], axis=0)) / upper[
            i, i
        ]
    return x


def fold(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Fold whitened rows (t | 1, m, p) into upper triangular factors (t, p, p): R'R = factor'factor
    + rows'rows.

    By QR of the stack, neither product is formed; the signs of R's rows are arbitrary and a row of
    zeros is absent.
    """
    stacked = np.concatenate(
        [factor, np.broadcast_to(rows, (factor.shape[0], *rows.shape[1:]))], axis=1
    )
    return np.asarray(np.linalg.qr(stacked, mode="r"))
