# SPDX-License-Identifier: Apache-2.0
"""Anchor points of the lines of a cable robot, from poses at known positions."""

from __future__ import annotations

import numpy as np

from loopcal.typing import FloatArray

RELATIVE_ROUNDING = 1e-6
"""Singular value, relative to the largest, below which the poses do not determine an anchor [1]."""

NEEDED_RANK = 4


def solve_line_anchor(
    positions: FloatArray, extensions: FloatArray
) -> tuple[FloatArray, int, FloatArray]:
    """Solve for the anchor of a line by linear least squares.

    At a known position x, a line from the anchor a to x, which is d longer than at the origin,
    gives |x - a| = |a| + d, and so x . a + d |a| = (x . x - d^2) / 2: linear in a and |a|.

    Parameters
    ----------
    positions : (k, 3) x. extensions : (k,) d, in the same unit.

    Returns
    -------
    anchor : (3,) a. rank : of the equations; below `NEEDED_RANK` the positions are too few, or in a
        plane through the origin, and the anchor is not determined.
    singular_values : of the equations.
    """
    rows = np.column_stack([positions, extensions])
    target = 0.5 * ((positions * positions).sum(axis=1) - extensions * extensions)
    solution, _, rank, s = np.linalg.lstsq(rows, target, rcond=RELATIVE_ROUNDING)
    return solution[:3], int(rank), s
