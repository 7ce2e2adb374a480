# SPDX-License-Identifier: Apache-2.0
"""Triangular factors of whitened rows [A | b], into which any number of rows is folded.

The factor R of rows X satisfies R'R = X'X. Folding more rows is one QR decomposition of the stack
[R; rows]: neither product is formed, and the memory is the number of columns squared. The
right-hand side is the last column, so that the last diagonal entry is the norm of what no solution
explains. See docs/theory/estimation.md.
"""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray


def empty_factor(trials: int, parameters: int) -> FloatArray:
    """Return the factor of no rows, zeros (t, p + 1, p + 1), into which `fold_rows` folds rows."""
    return np.zeros((trials, parameters + 1, parameters + 1))


def fold_rows(factor: FloatArray, rows: FloatArray) -> FloatArray:
    """Fold rows (t | 1, m, c) into upper triangular factors (t, c, c).

    The signs of the rows of a factor are arbitrary. A row of zeros changes nothing else.
    """
    more = np.broadcast_to(rows, (len(factor), *rows.shape[1:]))
    return np.asarray(np.linalg.qr(np.concatenate([factor, more], axis=1), mode="r"))
