# SPDX-License-Identifier: Apache-2.0
"""Upper triangular systems R x = b of many trials, and how far each R is from a singular matrix.

Where a lower bound of the smallest singular value is above the rank tolerance, every direction
counts, and a Gauss-Newton step is R^-1 b: a back substitution in place of a singular value
decomposition. Two bounds are used, both from the norm of the inverse, sigma_min = 1 / |R^-1|_2:

    comparison  |R^-1| <= M^-1 entry by entry, where M has |r_ii| on its diagonal and -|r_ij| off it
                (Higham, "Accuracy and Stability of Numerical Algorithms", 2nd edition, SIAM 2002,
                chapter 8.3). With y = M^-1 (1 .. 1)' then |R^-1|_2 <= sqrt(p) max y. All terms of y
                are positive, so that its rounding is a few p times that of a number. The bound can
                be too small by powers of ten.
    inverse     |R^-1|_2 <= |R^-1|_F, for the matrices of which the first bound says too little.

Each trial is computed by itself: its result does not depend on the others, bit for bit. See
docs/theory/identification.md.
"""

from __future__ import annotations

import numpy as np

from loopcal import engine
from loopcal.typing import BoolArray, FloatArray

PART = 12
"""Unknowns that are solved for at once: the time of small systems is that of the call, the time of
large ones is spent on zeros below the diagonal."""

MARGIN = 2.0
"""A smallest singular value counts as certainly above a tolerance where its bound is this many
times as large: far more than the rounding of bounds and decompositions."""

ROUNDING = 1e-12
"""Share of the norm below which rounding could decide whether a singular value counts."""


def solve_triangles(triangle: FloatArray, right: FloatArray) -> FloatArray:
    """Return x (t, p) with R x = b, for R (t, p, p) upper triangular without zeros on the diagonal
    and b (t, p); by back substitution in parts.
    """
    p = triangle.shape[1]
    x = np.empty_like(right)
    for first in range((p - 1) // PART * PART, -1, -PART):
        part, rest = slice(first, first + PART), slice(first + PART, p)
        known = right[:, part, None]
        if first + PART < p:
            known = known - np.matmul(triangle[:, part, rest], x[:, rest, None])
        x[:, part] = np.linalg.solve(triangle[:, part, part], known)[:, :, 0]
    return x


def solve_regular(
    triangle: FloatArray, right: FloatArray, tolerance: float
) -> tuple[FloatArray, BoolArray]:
    """Return x (t, p) with R x = b, and of which R all singular values are certainly above
    `tolerance` times the largest; x is zero in the other trials.

    Parameters
    ----------
    triangle : (t, p, p) R upper triangular. right : (t, p) b.
    tolerance : a singular value counts as zero up to this share of the largest one.
    """
    t, p = right.shape
    triangle = np.ascontiguousarray(triangle)  # the order of sums depends on the strides
    diagonal = np.abs(np.einsum("tii->ti", triangle))
    with np.errstate(over="ignore"):
        norm = np.sqrt(np.einsum("tij,tij->t", triangle, triangle))
    is_usable = (diagonal > 0.0).all(axis=1) & np.isfinite(norm) & np.isfinite(right).all(axis=1)
    if not is_usable.all():
        x, is_regular = np.zeros((t, p)), np.zeros(t, dtype=bool)
        usable = np.flatnonzero(is_usable)
        if usable.size:
            solved = solve_regular(triangle[usable], right[usable], tolerance)
            x[usable], is_regular[usable] = solved
        return x, is_regular
    x, growth = engine.solve_triangles(triangle, right) or _solve_both(triangle, right, diagonal)
    needed = MARGIN * max(tolerance, ROUNDING) * norm
    is_regular = needed * np.sqrt(p) * growth < 1.0
    doubtful = np.flatnonzero(~is_regular)
    if doubtful.size:
        inverse = np.linalg.inv(triangle[doubtful])
        length = np.sqrt((inverse**2).sum(axis=(1, 2)))
        is_regular[doubtful] = needed[doubtful] * length < 1.0
    return np.where(is_regular[:, None], x, 0.0), is_regular


def _solve_both(
    triangle: FloatArray, right: FloatArray, diagonal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the result of `loopcal.engine.solve_triangles`; `diagonal` (t, p) is |r_ii|."""
    t, p = right.shape
    comparison = -np.abs(triangle)
    np.einsum("tii->ti", comparison)[...] = diagonal
    both = solve_triangles(
        np.concatenate([triangle, comparison]), np.concatenate([right, np.ones((t, p))])
    )
    return both[:t], both[t:].max(axis=1, initial=0.0)
