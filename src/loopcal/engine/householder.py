# SPDX-License-Identifier: Apache-2.0
"""Small dense matrices by the thousand: Householder triangularisation with the batch as the contiguous axis.

Shapes are (rows, columns, batch). Only element-wise operations are used, so the result of one matrix never depends on
its neighbours, bit for bit, and a singular matrix yields infinities instead of stopping the others. See
docs/theory/engine.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.engine.program import Array


def triangularise(matrix: Array, columns: int) -> tuple[Array, Array]:
    """Reduce the first `columns` columns to upper triangular form by reflections applied to all columns.

    Parameters
    ----------
    matrix : (r, c, batch), left unchanged.
    columns : how many leading columns to reduce.

    Returns
    -------
    reduced : (r, c, batch) Q' matrix.
    sign : (batch,) determinant of Q', plus or minus one.
    """
    m = matrix.copy()
    r = m.shape[0]
    sign = np.ones(m.shape[2:])
    for j in range(min(columns, r - 1)):
        v = m[j:, j].copy()
        norm = np.sqrt(np.add.reduce(v * v, axis=0))
        alpha = -np.copysign(norm, v[0])
        v[0] -= alpha
        # v'v = 2 norm (norm + |v0|); a zero column keeps beta = 0 and is left alone
        vv = -alpha * v[0]
        beta = np.divide(1.0, vv, out=np.zeros_like(vv), where=vv > 0)
        w = beta * np.add.reduce(v[:, None] * m[j:, j + 1 :], axis=0)
        m[j:, j + 1 :] -= v[:, None] * w
        m[j, j] = alpha
        m[j + 1 :, j] = 0.0
        sign = np.where(beta > 0, -sign, sign)
    return m, sign


def back_substitute(upper: Array, right: Array) -> Array:
    """Solve upper x = right for (u, u, batch) and (u, c, batch); a zero pivot yields infinities or NaN."""
    x = np.empty_like(right)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in range(upper.shape[0] - 1, -1, -1):
            rest = right[i]
            if i + 1 < upper.shape[0]:
                rest = rest - np.add.reduce(upper[i, i + 1 :, None] * x[i + 1 :], axis=0)
            x[i] = rest / upper[i, i]
    return x


def accumulate(factor: Array, rows: Array) -> Array:
    """Fold rows into an upper triangular factor: R' R = factor' factor + rows' rows without forming either side.

    Parameters
    ----------
    factor : (t, p, p) upper triangular.
    rows : (t, m, p) whitened rows; a row of zeros is absent.

    Returns
    -------
    (t, p, p) upper triangular, by the QR factorisation of the stack (signs of its rows are arbitrary).
    """
    stacked = np.concatenate([factor, np.broadcast_to(rows, (factor.shape[0], *rows.shape[1:]))], axis=1)
    return np.linalg.qr(stacked, mode="r")
