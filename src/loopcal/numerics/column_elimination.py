# SPDX-License-Identifier: Apache-2.0
"""Elimination of leading columns of stacked rows by orthogonal projection.

Rows [F | A | r] depend on unknowns x (columns F) that are to be eliminated, and on others z. With
F = Q [R; 0] and R = U S V' the best x is a linear function of z, x = -F^+ (A z + r), and the rows
Q' [A | r] below R, together with those of U' Q' [A | r] whose singular value is zero, are free of
x: the projection of the rows onto the complement of the range of F, without forming it. Columns
are scaled to length one before singular values are compared, so that units do not matter. A
direction whose singular value is below NUISANCE_TOLERANCE is unobservable: x has no part in it, and
its rows are kept. All functions work on any leading axes. See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.numerics.decomposition import NUISANCE_TOLERANCE
from loopcal.numerics.rounding import without_rounding
from loopcal.typing import BoolArray, FloatArray, IntArray

SMALLEST_ROW = 1e-14
"""Rows that the projection leaves shorter than this share of the largest are rounding."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """Rows [F | A] without the k columns F.

    Attributes
    ----------
    rest : (.., m, w) rows left of A, free of the eliminated unknowns.
    solution : (.., k, w); the best eliminated unknowns are x = -solution @ z.
    inverse : (.., k, k) pseudo-inverse of the triangle of F.
    is_observable : (.., k) directions that the rows determine.
    directions : (.., k, k) the directions, one per row, in columns of length one.
    singular_values : (.., k) of F with columns of length one, descending.
    explained : (..,) squared length of the last column of A that the range of F explains.
    """

    rest: FloatArray
    solution: FloatArray
    inverse: FloatArray
    is_observable: BoolArray
    directions: FloatArray
    singular_values: FloatArray
    explained: FloatArray

    @property
    def rank(self) -> IntArray:
        """(..,) number of observable directions."""
        return self.is_observable.sum(axis=-1)

    @property
    def unobservable(self) -> FloatArray:
        """(.., k, k) the unobservable directions, one per row; zero for the observable ones."""
        return np.where(self.is_observable[..., None], 0.0, self.directions)


def eliminate_from_triangle(
    triangle: FloatArray, right: FloatArray, below: FloatArray, length: FloatArray | None = None
) -> Elimination:
    """Eliminate k unknowns from rows [[triangle, right], [0, below]].

    Parameters
    ----------
    triangle : (.., k, k). right : (.., k, w). below : (.., m, w).
    length : (.., k), optional. Lengths of the columns over all rows, where the triangle is what
        earlier eliminations left of them; by default those of the triangle's columns.

    Returns
    -------
    Elimination; its `rest` has k + m rows, those of observable directions being zero.
    """
    if length is None:
        norm = np.linalg.norm(triangle, axis=-2)
        length = np.where(norm > 0.0, norm, 1.0)
    return _eliminate(triangle / length[..., None, :], right, below, length)


def _eliminate(
    scaled_triangle: FloatArray, right: FloatArray, below: FloatArray, length: FloatArray
) -> Elimination:
    """Eliminate k unknowns whose triangle (.., k, k) is divided by the lengths of its columns."""
    left, s, vt = np.linalg.svd(scaled_triangle)
    # columns have length one: the largest singular value is at least one, unless earlier
    # eliminations have left nothing but rounding
    used = s > NUISANCE_TOLERANCE * np.maximum(s[..., :1], 1.0)
    turned = np.matmul(left.swapaxes(-1, -2), right)
    root = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    scaled = vt.swapaxes(-1, -2) * root[..., None, :] / length[..., None]
    rest = np.concatenate([np.where(used[..., None], 0.0, turned), below], axis=-2)
    return Elimination(
        rest=rest,
        solution=np.matmul(scaled, turned),
        inverse=np.matmul(scaled, left.swapaxes(-1, -2)),
        is_observable=used,
        directions=vt,
        singular_values=s,
        explained=np.where(used, turned[..., -1] ** 2, 0.0).sum(axis=-1),
    )


def eliminate_columns(rows: FloatArray, count: int) -> Elimination:
    """Eliminate the first `count` columns k of rows (.., N, k + w), N >= k.

    What the projection leaves of a column that the eliminated ones explain in full is set to zero,
    so that its rounding does not become a direction. What is left of rows that are not finite is
    NaN.
    """
    # absent rows go last: no reflection touches them there, and they do not mix with the others
    order = np.argsort(~rows.any(axis=-1), axis=-1, kind="stable")
    rows = np.take_along_axis(rows, order[..., None], axis=-2)
    bad = np.asarray(~np.isfinite(rows).all(axis=(-1, -2)))
    if bad.any():
        rows = np.where(bad[..., None, None], 0.0, rows)
    norm = np.linalg.norm(rows[..., :count], axis=-2)
    length = np.where(norm > 0.0, norm, 1.0)
    q, r = np.linalg.qr(rows[..., :count] / length[..., None, :], mode="complete")
    right = np.matmul(q.swapaxes(-1, -2), rows[..., count:])
    done = _eliminate(r[..., :count, :], right[..., :count, :], right[..., count:, :], length)
    rest = done.rest
    before = np.linalg.norm(rows[..., None, count:-1], axis=-3)
    rest[..., :-1] = without_rounding(rest[..., :-1], before)
    size = np.abs(right).max(axis=(-1, -2), keepdims=True, initial=0.0)
    largest = np.abs(rest).max(axis=-1, keepdims=True, initial=0.0)
    rest[...] = np.where(largest > SMALLEST_ROW * size, rest, 0.0)
    if bad.any():
        rest[bad] = np.nan
    return done


def eliminate_from_factor(factor: FloatArray, count: int) -> FloatArray:
    """Eliminate the first `count` columns k of one triangular factor (1, k + c, k + c).

    Returns
    -------
    factor : (1, c, c) of the rows left.
    """
    if count == 0:
        return factor
    done = eliminate_from_triangle(
        factor[:, :count, :count], factor[:, :count, count:], factor[:, count:, count:]
    )
    return np.asarray(np.linalg.qr(done.rest, mode="r"))
