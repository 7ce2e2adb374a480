# SPDX-License-Identifier: Apache-2.0
"""The decomposition of a triangular factor, from which everything about an estimate is read.

Rows [A | b] of a linear least-squares problem are folded, block by block, into one triangular
factor (`loopcal.engine.fold`), whose memory is the number of columns squared and whose last
diagonal entry is the norm of what no solution explains. Singular values, rank, solutions, filters
and covariances come from the singular value decomposition of that factor. The product A'A is never
formed: it would turn null directions of 1e-14 into 1e-7. Every array has a leading trial axis t.
See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from loopcal import engine
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray

# Singular values below this share of the largest count as zero. The matrix must be whitened and its
# columns scaled. Null directions of an exact model come out at 1e-17 to 1e-13 by double rounding;
# the weakest genuine directions seen in complete error models of real machines are near 1e-9.
RANK_TOLERANCE = 1e-11
# The same rule for columns that are eliminated (frames, targets, surfaces, offsets, poses). It is
# ten times wider than RANK_TOLERANCE: these columns have passed the eliminations of the scopes
# inside them, each with its rounding, and a direction that is wrongly called observable would take
# a genuine equation away from the machine.
NUISANCE_TOLERANCE = 1e-10
# A parameter has infinite variance when null directions carry more than this of its unit vector
# (sqrt of rounding).
NULL_COMPONENT = 1e-8


# A null direction has no part in parameters that carry less than this of it: weak directions, of
# 1e-9 of the largest singular value, turn null directions by 1e-7 in double rounding.
NULL_PART = 1e-5


def are_nonzero(singular_values: np.ndarray, tolerance: float = RANK_TOLERANCE) -> BoolArray:
    """Return which singular values (.., k), largest first, count as nonzero: the rank rule.

    They are those above `tolerance` times the largest. The default is for whitened rows and scaled
    columns.
    """
    return np.asarray(singular_values > tolerance * singular_values[..., :1])


@dataclass(frozen=True, eq=False)
class Decomposition(TrialBatch):
    """Singular value decomposition A = U diag(s) V' of folded rows [A | b].

    A deviation z has the coordinates y = V' z; in them the least-squares sum is sum (s_i y_i -
    c_i)^2 plus the part outside the range. A `penalty` (t, p) adds penalty_i y_i^2: zero for plain
    least squares, infinite where a direction is not used at all. Its filter factors are f_i = s_i^2
    / (s_i^2 + penalty_i).

    Where some columns are never penalized, V holds two groups of columns: those of unpenalized
    parameters alone, and those of the others, each with the best change of the unpenalized ones.
    U stays orthonormal, and V'z of the second group depends on the penalized parameters alone, so
    that all formulas hold; V itself is oblique, and its inverse is kept as `dual`. V is oblique as
    well where the penalty acts on other unknowns: with z = L u its columns are L times those for u.

    singular_values : (t, p) s, descending.
    directions : (t, p, p) V, column i belongs to s_i.
    projections : (t, p) c = U'b.
    outside : (t,) squared length of the part of b outside the range of A.
    rows : (t,) number of equations folded (rows of weight zero not counted).
    tolerance : singular values below tolerance * s_1 count as zero.
    dual : (t, p, p) inverse of V where V is oblique; None where it is V'.
    unpenalized : (t, p) directions of parameters that are never penalized; None without any.
    """

    singular_values: FloatArray
    directions: FloatArray
    projections: FloatArray
    outside: FloatArray
    rows: IntArray
    tolerance: float = RANK_TOLERANCE
    dual: FloatArray | None = None
    unpenalized: BoolArray | None = None

    @cached_property
    def used(self) -> BoolArray:
        """(t, p) which singular values count as nonzero."""
        s = self.singular_values
        return are_nonzero(s, self.tolerance)

    @property
    def rank(self) -> IntArray:
        """(t,) number of singular values above the tolerance."""
        return self.used.sum(axis=1)

    @property
    def unexplained(self) -> FloatArray:
        """(t,) squared length of b outside what counts: where the rank is less than p, null
        directions have a share of it.
        """
        return self.outside + np.where(self.used, 0.0, self.projections**2).sum(axis=1)

    @property
    def condition(self) -> FloatArray:
        """(t,) largest singular value over the smallest that counts; infinite for zeros."""
        s = self.singular_values
        smallest = np.where(self.used, s, np.inf).min(axis=1, initial=np.inf)
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(smallest), s.max(axis=1, initial=0.0) / smallest, np.inf)

    @property
    def gap(self) -> FloatArray:
        """(t,) smallest singular value that counts over the largest that does not; infinite where
        none was cut.
        """
        s = self.singular_values
        kept = np.where(self.used, s, np.inf).min(axis=1, initial=np.inf)
        cut = np.where(self.used, 0.0, s).max(axis=1, initial=0.0)
        return np.divide(kept, cut, out=np.full(len(s), np.inf), where=cut > 0.0)

    @property
    def inverse(self) -> FloatArray:
        """(t, p, p) inverse of V."""
        return self.directions.swapaxes(-1, -2) if self.dual is None else self.dual

    def with_dual(self) -> Decomposition:
        """Return this decomposition with its dual stated, as one of trials of oblique V is."""
        return replace(self, dual=self.inverse)

    def coordinates(self, deviation: FloatArray) -> FloatArray:
        """Return y = V^-1 z, (t, p), of a deviation z (t, p)."""
        if self.dual is not None:
            return np.matmul(self.dual, deviation[:, :, None])[:, :, 0]
        return np.matmul(deviation[:, None, :], self.directions)[:, 0]

    def deviation(self, coordinates: FloatArray) -> FloatArray:
        """Return z = V y, (t, p), of coordinates y (t, p)."""
        return np.matmul(self.directions, coordinates[:, :, None])[:, :, 0]

    def filter_factors(self, penalty: FloatArray) -> FloatArray:
        """Return f_i = s_i^2 / (s_i^2 + penalty_i), (t, p): the share of each least-squares
        coordinate that is kept.
        """
        square = self.singular_values**2
        total = square + penalty
        return np.divide(square, total, out=np.zeros_like(total), where=total > 0.0)

    def solution(self, penalty: FloatArray) -> FloatArray:
        """Return the coordinates y_i = f_i c_i / s_i, (t, p), that minimize sum (s_i y_i - c_i)^2 +
        penalty_i y_i^2.
        """
        s = self.singular_values
        total = s**2 + penalty
        return np.divide(s * self.projections, total, out=np.zeros_like(s), where=total > 0.0)

    def remaining(self, penalty: FloatArray) -> FloatArray:
        """Return sum ((1 - f_i) c_i)^2 + outside, (t,): what the filtered solution leaves."""
        left = (1.0 - self.filter_factors(penalty)) * self.projections
        return (left**2).sum(axis=1) + self.outside

    def variances(
        self, penalty: FloatArray, noise: FloatArray | float = 1.0, prior: FloatArray | None = None
    ) -> FloatArray:
        """Return the variance (t, p) of each coordinate: infinite where the direction is not used.

        For the variance `noise` sigma^2 of the rows and tau_i^2 of the true coordinates (`prior`,
        1 / penalty by default) it is noise plus the expected square of the bias: f_i^2 sigma^2 /
        s_i^2 + (1 - f_i)^2 tau_i^2. By default and with sigma = 1 that is 1 / (s_i^2 + penalty_i),
        and with no penalty sigma^2 / s_i^2.
        """
        square = self.singular_values**2
        sigma2 = np.broadcast_to(np.asarray(noise, dtype=np.float64), (len(square),))[:, None]
        cut = np.isinf(penalty) | ((square + penalty) ** 2 <= 0.0)
        finite = np.where(cut, 1.0, penalty)
        total = np.where(cut, 1.0, square + finite)
        bias = finite if prior is None else finite**2 * np.where(finite > 0.0, prior, 0.0)
        return np.where(cut, np.inf, (sigma2 * square + bias) / total**2)

    def noise_roots(self, penalty: FloatArray, noise: FloatArray | float = 1.0) -> FloatArray:
        """Return a square root (t, p, p) of the covariance of z by the noise of the rows:
        V diag(sigma s_i / (s_i^2 + penalty_i)), zero in directions that are not used.
        """
        s = self.singular_values
        total = s**2 + penalty
        gain = np.divide(s, total, out=np.zeros_like(s), where=np.isfinite(total) & (total > 0.0))
        return self.directions * (np.sqrt(np.reshape(noise, (-1, 1))) * gain)[:, None, :]

    def covariance(
        self, penalty: FloatArray, noise: FloatArray | float = 1.0, prior: FloatArray | None = None
    ) -> FloatArray:
        """Return the covariance (t, p, p) of the deviation, in the units of the columns.

        A parameter that has a part in a direction that is not used has infinite variance, and its
        covariances with all others are not defined (nan): the one rule of the project for
        directions that the data do not determine.
        """
        variances = self.variances(penalty, noise, prior)
        infinite = np.isinf(variances)
        spread = self.directions * np.sqrt(np.where(infinite, 0.0, variances))[:, None, :]
        covariance = np.matmul(spread, spread.swapaxes(-1, -2))
        if infinite.any():
            unknown = self._touched(infinite)
            covariance[unknown[:, :, None] | unknown[:, None, :]] = np.nan
            trial, parameter = np.nonzero(unknown)
            covariance[trial, parameter, parameter] = np.inf
        return covariance

    def standard_deviations(
        self, penalty: FloatArray, noise: FloatArray | float = 1.0, prior: FloatArray | None = None
    ) -> FloatArray:
        """Return the standard deviations (t, p) by the rule of `covariance`, without the matrix."""
        variances = self.variances(penalty, noise, prior)
        infinite = np.isinf(variances)
        finite = np.where(infinite, 0.0, variances)
        result = np.sqrt(np.matmul(self.directions**2, finite[:, :, None])[:, :, 0])
        return np.where(self._touched(infinite), np.inf, result) if infinite.any() else result

    def null_space(self, trial: int = 0) -> FloatArray:
        """Return a basis (p, d) of the deviations that change no row, for one trial;
        orthonormal where V is not oblique.
        """
        return self.directions[trial][:, ~self.used[trial]]

    def plain(self) -> Decomposition:
        """Return the decomposition without unpenalized columns: that with the singular values of A.

        It is this object where no columns are unpenalized.
        """
        if self.dual is None:
            return self if self.unpenalized is None else replace(self, unpenalized=None)
        u, s, vt = np.linalg.svd(self.singular_values[:, :, None] * self.dual)
        projections = np.matmul(self.projections[:, None, :], u)[:, 0]
        directions = np.ascontiguousarray(vt.swapaxes(-1, -2))
        return replace(
            self,
            singular_values=s,
            directions=directions,
            projections=projections,
            dual=None,
            unpenalized=None,
        )

    def knowledge(
        self,
        penalty: FloatArray,
        noise: float = 1.0,
        prior: FloatArray | None = None,
        trial: int = 0,
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return orthonormal directions (p, p) of z, the variance (p,) of each, and which
        the rows see, of one trial.

        Where V is oblique these come from the singular values of diag(var)^(-1/2) V^-1.
        """
        variances = self.variances(penalty, noise, prior)[trial]
        if self.dual is None or np.isnan(variances).any():
            return self.plain().directions[trial], variances, self.plain().used[trial]
        dual = self.dual[trial]
        root = np.where(np.isfinite(variances), 1.0 / np.sqrt(variances), 0.0)
        _, s, vt = np.linalg.svd(root[:, None] * dual)
        known = are_nonzero(s, self.tolerance)
        variance = np.where(known, 1.0 / np.where(known, s, 1.0) ** 2, np.inf)
        effect = np.linalg.norm(self.singular_values[trial][:, None] * (dual @ vt.T), axis=0)
        return vt.T, variance, effect > self.tolerance * self.singular_values[trial].max()

    def mixed(self, root: FloatArray) -> Decomposition:
        """Return the decomposition for z = root u, where this is the one for u."""
        dual = np.linalg.solve(root.T, self.inverse.swapaxes(-1, -2)).swapaxes(-1, -2)
        return replace(self, directions=root @ self.directions, dual=dual)

    def separated(self, alone: BoolArray) -> Decomposition:
        """Return the decomposition whose null directions are, as far as possible, those of the
        parameters `alone` (p,), which count as unpenalized.
        """
        directions, dual, c = self.directions.copy(), self.inverse.copy(), self.projections.copy()
        for t, is_null in enumerate(~self.used):
            _, _, vt = np.linalg.svd(directions[t][~alone][:, is_null])
            directions[t][:, is_null] = directions[t][:, is_null] @ vt.T
            dual[t][is_null], c[t][is_null] = vt @ dual[t][is_null], vt @ c[t][is_null]
        part = np.linalg.norm(directions[:, ~alone], axis=1)
        marked = ~self.used & (part < NULL_PART * np.linalg.norm(directions, axis=1))
        directions[marked[:, None, :] & ~alone[:, None]] = 0.0
        return replace(self, directions=directions, dual=dual, projections=c, unpenalized=marked)

    def divided(self, sigma: FloatArray) -> Decomposition:
        """Return the decomposition of the rows divided by sigma (t,)."""
        s, c, outside = (
            self.singular_values / sigma[:, None],
            self.projections / sigma[:, None],
            self.outside / sigma**2,
        )
        return replace(self, singular_values=s, projections=c, outside=outside)

    def _touched(self, infinite: BoolArray) -> BoolArray:
        """(t, p) which parameters have a part in the directions marked (t, p)."""
        part = np.matmul(self.directions**2, infinite[:, :, None].astype(np.float64))[:, :, 0]
        return part > NULL_COMPONENT**2


# Sine of the angle up to which null directions of two linearizations are the same direction.
PARALLEL = 1e-2


def find_null_space(rows: FloatArray, tolerance: float = RANK_TOLERANCE) -> FloatArray:
    """Return an orthonormal basis (p, k) of the vectors that rows (m, p) do not see."""
    _, s, vt = np.linalg.svd(rows, full_matrices=True)
    return vt[int(are_nonzero(s, tolerance).sum()) :].T


def intersect_spaces(first: FloatArray, second: FloatArray, sine: float = PARALLEL) -> FloatArray:
    """Return an orthonormal basis (p, k) of the directions in the span of `first` (p, a) whose
    angle to the span of `second` (p, b) has at most this sine; both have orthonormal columns.
    """
    outside = first - second @ (second.T @ first)
    _, sines, vt = np.linalg.svd(outside, full_matrices=False)
    return first @ vt[sines < sine].T


def empty_factor(trials: int, parameters: int) -> FloatArray:
    """Return the factor of no rows, zeros (t, p + 1, p + 1), into which rows are folded."""
    return np.zeros((trials, parameters + 1, parameters + 1))


def decompose(
    factor: FloatArray,
    rows: IntArray,
    about: FloatArray | None = None,
    tolerance: float = RANK_TOLERANCE,
    unpenalized: BoolArray | None = None,
    root: FloatArray | None = None,
) -> Decomposition:
    """Decompose a triangular factor of rows [A | b].

    factor : (t, p + 1, p + 1) upper triangular, see `loopcal.engine.fold`.
    rows : (t,) number of equations that were folded.
    about : (t, p), optional. With it the last column is read as a residual r at the deviation z =
        `about`, and the problem becomes the one for the total deviation: |A z_new - b| with b = A z
        - r.
    tolerance : relative rank tolerance.
    unpenalized : (p,), optional. Columns that no penalty may touch.
    root : (p, p), optional. L of z = L u, where the penalty acts on u: a root of the prior
        covariance of z. It must not mix unpenalized columns with others.
    """
    p = factor.shape[-1] - 1
    triangle, last = factor[:, :p, :p], factor[:, :p, p]
    if about is not None:
        last = np.matmul(triangle, about[:, :, None])[:, :, 0] - last
    if root is not None:
        triangle = triangle @ root
    outside = factor[:, p, p] ** 2
    if unpenalized is not None and unpenalized.any() and not unpenalized.all():
        d = _split(triangle, last, outside, rows, tolerance, unpenalized)
    else:
        u, s, vt = np.linalg.svd(triangle)
        projections = np.matmul(last[:, None, :], u)[:, 0]
        # One memory layout, whichever trials are taken later: products round by the layout of
        # their factors.
        directions = np.ascontiguousarray(vt.swapaxes(-1, -2))
        is_all = unpenalized is not None and unpenalized.all()
        marked = np.ones(s.shape, dtype=bool) if is_all else None
        d = Decomposition(s, directions, projections, outside, rows, tolerance, unpenalized=marked)
    return d if root is None else d.mixed(root)


def _split(
    triangle: FloatArray,
    last: FloatArray,
    outside: FloatArray,
    rows: IntArray,
    tolerance: float,
    unpenalized: BoolArray,
) -> Decomposition:
    """Decompose [F G], unpenalized columns F first.

    F = U1 S1 W', and the part of G that F does not explain is (I - U1 U1') G = U2 S2 V2'.

    With T = S1^+ U1'G the columns of V are (W, 0) and (-W T V2, V2), and its inverse is [[W', T],
    [0, V2']].
    """
    p, k = len(unpenalized), int(unpenalized.sum())
    order = np.concatenate([np.flatnonzero(unpenalized), np.flatnonzero(~unpenalized)])
    reduced: FloatArray = np.array(
        np.linalg.qr(np.concatenate([triangle[:, :, order], last[:, :, None]], axis=2), mode="r")
    )
    u1, s1, w1t = np.linalg.svd(reduced[:, :k, :k])
    top = np.linalg.norm(reduced[:, :, :p], axis=(1, 2))
    used = s1 > tolerance * top[:, None]
    first = np.matmul(u1.swapaxes(-1, -2), reduced[:, :k, k:])  # U1'G and U1'b
    rest = np.concatenate([np.where(used[:, :, None], 0.0, first), reduced[:, k:, k:]], axis=1)
    u2, s2, v2t = np.linalg.svd(rest[:, :, :-1], full_matrices=False)
    second = np.matmul(rest[:, None, :, -1], u2)[:, 0]
    outside = outside + np.maximum((rest[:, :, -1] ** 2).sum(axis=1) - (second**2).sum(axis=1), 0.0)
    inverse = np.divide(1.0, s1, out=np.zeros_like(s1), where=used)
    shift = inverse[:, :, None] * first[:, :, :-1]
    dual, directions = np.zeros_like(triangle), np.zeros_like(triangle)
    dual[:, :k, :k], dual[:, :k, k:], dual[:, k:, k:] = w1t, shift, v2t
    w1, v2 = w1t.swapaxes(-1, -2), v2t.swapaxes(-1, -2)
    directions[:, :k, :k], directions[:, :k, k:], directions[:, k:, k:] = w1, -w1 @ (shift @ v2), v2
    s = np.concatenate([np.where(used, s1, 0.0), s2], axis=1)
    c = np.concatenate([np.where(used, first[:, :, -1], 0.0), second], axis=1)
    by_size, back = np.argsort(-s, axis=1, kind="stable"), np.argsort(order)
    marked = by_size < k
    dual = np.take_along_axis(dual[:, :, back], by_size[:, :, None], axis=1)
    directions = np.take_along_axis(directions[:, back], by_size[:, None, :], axis=2)
    s, c = np.take_along_axis(s, by_size, axis=1), np.take_along_axis(c, by_size, axis=1)
    return Decomposition(s, directions, c, outside, rows, tolerance, dual, marked)


# Systems with one triangular matrix and many right sides, by numpy.


# Unknowns of a triangle that is solved at once, by LU: the time of more grows with their cube.
LEAF = 64


def substitute_backward(R: FloatArray, b: FloatArray) -> FloatArray:
    """Return x with R x = b, for upper triangular R (n, n) and b (n, k).

    numpy.linalg.LinAlgError : a zero on the diagonal.
    """
    n = len(R)
    if n <= LEAF:
        return np.asarray(np.linalg.solve(R, b), dtype=np.float64)
    low = substitute_backward(R[n // 2 :, n // 2 :], b[n // 2 :])
    rest = b[: n // 2] - R[: n // 2, n // 2 :] @ low
    return np.concatenate([substitute_backward(R[: n // 2, : n // 2], rest), low])


def substitute_transposed(R: FloatArray, b: FloatArray) -> FloatArray:
    """Return x with R' x = b, for upper triangular R (n, n) and b (n, k); raise as above.

    R' in reverse order of rows and columns is an upper triangle again.
    """
    return substitute_backward(R.T[::-1, ::-1], b[::-1])[::-1]


# Upper triangular systems R x = b of many trials, and how far each R is from a singular
# matrix.

# Unknowns that are solved for at once: the time of small systems is that of the call, the time of
# large ones is spent on zeros below the diagonal.
PART = 12
# A smallest singular value counts as certainly above a tolerance where its bound is this many times
# as large: far more than the rounding of bounds and decompositions.
MARGIN = 2.0
# Share of the norm below which rounding could decide whether a singular value counts.
ROUNDING = 1e-12


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


def certain_share(tolerance: float) -> float:
    """Return the share of |R| above which `solve_regular` needs all singular values of R."""
    return MARGIN * max(tolerance, ROUNDING)


def solve_regular(
    triangle: FloatArray, right: FloatArray, tolerance: float
) -> tuple[FloatArray, BoolArray]:
    """Return x (t, p) with R x = b, and of which R all singular values are certainly above
    `tolerance` times the largest; x is zero in the other trials.

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
    needed = certain_share(tolerance) * norm
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
