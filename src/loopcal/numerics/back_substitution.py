# SPDX-License-Identifier: Apache-2.0
"""Systems with one triangular matrix and many right sides, by numpy.

Elimination with pivots finds nothing to eliminate and nothing to exchange in an upper triangle, so
that `numpy.linalg.solve` only substitutes backward. scipy has a routine for triangles, but
importing scipy.linalg takes as long as a thousand of these solutions.
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray


def substitute_backward(R: FloatArray, b: FloatArray) -> FloatArray:
    """Return x with R x = b, for upper triangular R (n, n) and b (n, k).

    Raises
    ------
    numpy.linalg.LinAlgError : a zero on the diagonal.
    """
    return np.asarray(np.linalg.solve(R, b), dtype=np.float64)


def substitute_transposed(R: FloatArray, b: FloatArray) -> FloatArray:
    """Return x with R' x = b, for upper triangular R (n, n) and b (n, k); raise as above.

    R' in reverse order of rows and columns is an upper triangle again.
    """
    return np.asarray(np.linalg.solve(R.T[::-1, ::-1], b[::-1])[::-1], dtype=np.float64)
