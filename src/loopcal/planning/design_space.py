# SPDX-License-Identifier: Apache-2.0
"""Problems of optimal design: prior, observable directions, criteria, and the scores of designs.

A **group** is what is measured together: one pose, or several poses that one row compares. Its rows
[F | A] have the nuisance parameters of the instruments (F, to be eliminated) before the unknowns of
the machine (A). Directions of the machine that no candidate separates from the nuisance parameters
are removed once, by a stated spread, for all designs alike. See docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from loopcal import engine
from loopcal.errors import EstimationError
from loopcal.numerics.decomposition import are_nonzero
from loopcal.numerics.elimination import eliminate_from_triangle
from loopcal.typing import BoolArray, FloatArray, IntArray

# A design is singular where it determines a direction with less than this share of the mean
# design's information, as a ratio of standard deviations.
SINGULAR = 1e-6
MANY_ROWS = 12  # rows of a group that may have less rank: a pose alone has six


def factor_rows(rows: FloatArray) -> FloatArray:
    """Return rows R (.., c, c) with the information R'R of rows (.., m, c), triangular; fewer than
    c rows as they are.
    """
    *shape, m, c = rows.shape
    if m < c:
        return rows
    R = engine.fold(np.zeros((prod(shape), c, c)), rows.reshape(prod(shape), m, c))
    return R.reshape(*shape, c, c)


def factor_square(rows: FloatArray) -> FloatArray:
    """Return the factor of rows (m, c) with rows of zeros below where m < c, (c, c)."""
    return engine.fold(np.zeros((1, rows.shape[1], rows.shape[1])), rows[None])[0]


def divide_by_factor(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Return X R^-1 for rows X (..., q) and a nonsingular triangular factor R (q, q)."""
    from scipy.linalg.blas import dtrsm  # pyright: ignore[reportAttributeAccessIssue]

    flat = rows.reshape(-1, rows.shape[-1])
    # R' is lower triangular, and both transposes are already in the order of BLAS
    return np.asarray(dtrsm(1.0, R.T, flat.T, lower=1).T, dtype=np.float64).reshape(rows.shape)


def is_allowed(rows: FloatArray) -> BoolArray:
    """Return for rows (N, r, c) of N groups which groups (N,) contain no NaN."""
    return np.asarray(np.isfinite(rows).all(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Information that exists before the first new pose."""

    # (k, o + p) whitened and in tolerances: rows measured already, or identity rows for
    # tolerances
    rows: FloatArray
    n_nuisance: int = 0  # o, number of nuisance parameters; their columns come first

    @classmethod
    def none(cls, machine: int, nuisance: int = 0) -> PriorInformation:
        """Return no information on `machine` unknowns and `nuisance` nuisance parameters."""
        return cls(np.zeros((0, nuisance + machine)), nuisance)

    @classmethod
    def from_tolerances(cls, machine: int, nuisance: int = 0) -> PriorInformation:
        """Return variance 1 for each machine unknown and nothing for the nuisance parameters."""
        return cls(np.eye(nuisance + machine)[nuisance:], nuisance)

    def with_rows(self, rows: ArrayLike) -> PriorInformation:
        """Return this with more rows (..., o + p)."""
        added = np.asarray(rows, dtype=np.float64).reshape(-1, self.rows.shape[1])
        return PriorInformation(factor_rows(np.concatenate([self.rows, added])), self.n_nuisance)


@dataclass(frozen=True, eq=False)
class ObservableSpace:
    """The directions that a set of rows can determine; designs are compared in this space."""

    machine: FloatArray  # (p, q) orthonormal directions of the machine's unknowns
    nuisance: FloatArray  # (o, o') directions of the nuisance parameters
    singular_values: FloatArray  # (p,) of the machine's columns after elimination, descending

    def __len__(self) -> int:
        return self.machine.shape[1]

    @property
    def n_unknowns(self) -> int:
        """Number of nuisance and machine directions together."""
        return self.nuisance.shape[1] + self.machine.shape[1]

    def project(self, rows: FloatArray) -> FloatArray:
        """Return rows (..., o + p) in these directions, (..., o' + q), nuisance first."""
        o = len(self.nuisance)
        return np.concatenate(
            [rows[..., :o] @ self.nuisance, rows[..., o:] @ self.machine], axis=-1
        )


def find_observable_space(rows: FloatArray, prior: PriorInformation) -> ObservableSpace:
    """Return the directions that all allowed groups (N, r, o + p) and the prior determine together.

    The remainder of the machine's columns, without the nuisance parameters, is cut at the rank
    tolerance times its largest singular value.
    """
    allowed = rows[is_allowed(rows)].reshape(-1, rows.shape[-1])
    o = prior.n_nuisance
    R = factor_square(np.concatenate([prior.rows, allowed]))
    nuisance, rest = np.zeros((0, 0)), R
    if o:
        norm = np.linalg.norm(R[:o, :o], axis=0)
        length = np.where(norm > 0.0, norm, 1.0)
        done = eliminate_from_triangle(R[:o, :o], R[:o, o:], R[o:, o:], length)
        nuisance, rest = done.directions[done.is_observable].T / length[:, None], done.rest
    _, s, vt = np.linalg.svd(rest)
    observable = vt[: len(s)][are_nonzero(s)]
    return ObservableSpace(observable.T, nuisance, s)


def factor_design(rows: FloatArray, prior: PriorInformation, space: ObservableSpace) -> FloatArray:
    """Return the factor (q, q) of rows (n, r, o + p) and the prior in the machine's observable
    directions, the nuisance parameters eliminated.
    """
    stacked = np.concatenate([prior.rows, rows.reshape(-1, rows.shape[-1])])
    o = space.nuisance.shape[1]
    return factor_square(space.project(stacked))[o:, o:]


@dataclass(frozen=True, eq=False)
class Criterion:
    """A scalar figure of the covariance C of the machine's unknowns, in spreads.

    name : "D", log determinant of the information, large where the volume of uncertainty is small;
        the best design does not depend on scaling. "I", mean variance of a prediction. "A", sum of
        the variances of the observable directions. "E", variance of the worst of them; never
        optimized.
    weights : (k, p) for I: derivatives of all predicted quantities by the machine's unknowns.
    count : number of predictions (poses) in `weights`; the sum of the variances is divided by it.
    """

    name: Literal["D", "I", "A", "E"]
    weights: FloatArray | None = None
    count: int = 1

    @property
    def is_d(self) -> bool:
        """Whether larger values are better."""
        return self.name == "D"


def is_full_rank(singular_values: np.ndarray) -> bool:
    """Return whether a triangular factor with these descending singular values can be inverted.

    The threshold is the rounding of the decomposition: a design that determines a direction barely
    is poor, and the criterion says so, but it is not singular.
    """
    s = singular_values
    return not s.size or bool(s[-1] > np.finfo(np.float64).eps * len(s) * s[0])


def evaluate_criterion(criterion: Criterion, factor: FloatArray, machine: FloatArray) -> float:
    """Return the value of a criterion; -inf for D and inf for the others where R is singular.

    factor : (q, q) upper triangular R; R'R is the information on the observable directions.
    machine : (p, q) these directions, orthonormal in the machine's unknowns.
    """
    s = np.linalg.svd(factor, compute_uv=False)
    if not is_full_rank(s):
        return -np.inf if criterion.is_d else np.inf
    if criterion.weights is not None:
        projected = divide_by_factor(criterion.weights @ machine, factor)
        return float((projected**2).sum() / criterion.count)
    if criterion.is_d:
        return float(2.0 * np.log(s).sum())
    variances = 1.0 / s**2
    return float(variances.sum() if criterion.name == "A" else variances.max(initial=0.0))


@dataclass(frozen=True, eq=False)
class DesignProblem:
    """Groups to choose from, and what makes a choice good."""

    rows: FloatArray  # (N, r, o + p) whitened and in spreads; NaN where a group is not allowed
    criterion: Criterion
    prior: PriorInformation
    repeats: bool = False  # whether a group may be measured more than once
    counted: str = "poses"  # plural noun for the groups

    @cached_property
    def space(self) -> ObservableSpace:
        """The directions in which designs are compared."""
        return find_observable_space(self.rows, self.prior)

    @cached_property
    def allowed(self) -> IntArray:
        """Indices of the groups that may be chosen."""
        return np.flatnonzero(is_allowed(self.rows))

    def evaluate(self, chosen: IntArray, criterion: Criterion | None = None) -> float:
        """Return a criterion of a design (n,); by default the one that makes a choice good."""
        factor = factor_design(self.rows[chosen], self.prior, self.space)
        return evaluate_criterion(criterion or self.criterion, factor, self.space.machine)

    def compare(self, value: float, best: float) -> float:
        """Return the efficiency of a value relative to the best possible one, 0 to 1: the ratio of
        determinants to the power 1 / q for D, the ratio of variances for the others.
        """
        if self.criterion.is_d:
            return float(np.exp((value - best) / len(self.space)))
        return float(best / value)

    @cached_property
    def n_unknowns(self) -> int:
        """Number of directions that the prior does not determine."""
        if not self.prior.rows.any():
            return self.space.n_unknowns
        s = np.linalg.svd(self.space.project(self.prior.rows), compute_uv=False)
        return self.space.n_unknowns - int(are_nonzero(s).sum())

    @property
    def n_needed(self) -> int:
        """Smallest number of groups that can determine all directions together with the prior."""
        return max(-(-self.n_unknowns // self.rows.shape[1]), 1)

    def require_enough(self, n: int) -> None:
        """Refuse a number of groups that cannot determine all directions."""
        count = len(self.allowed)
        if count == 0:
            raise EstimationError.of("plan.no-candidate-allowed", total=len(self.rows))
        if len(self.space) == 0:
            raise EstimationError.of("plan.no-direction-observable")
        if n > count and not self.repeats:
            counts = {"requested": n, "what": self.counted, "available": count}
            raise EstimationError.of("plan.too-few-candidates", **counts)
        if n < self.n_needed:
            raise EstimationError.of(
                "plan.design-too-small",
                requested=n,
                equations=n * self.rows.shape[1],
                unknowns=self.n_unknowns,
                needed=self.n_needed,
            )

    def build_scoring(self, n: int) -> Scoring:
        """Return the scoring whose mean design is the prior and all groups with the weight of n."""
        criterion, space, prior = self.criterion, self.space, self.prior
        if criterion.name == "E":
            raise EstimationError("an exchange cannot optimize criterion E. Choose D, I or A")
        rows, weight = self.rows[self.allowed], n / len(self.allowed)
        o, p = space.nuisance.shape
        blocks = np.zeros((o + len(space.machine), space.n_unknowns))
        blocks[:o, :p], blocks[o:, p:] = space.nuisance, space.machine
        stacked = np.concatenate([prior.rows, np.sqrt(weight) * rows.reshape(-1, rows.shape[-1])])
        reference = factor_rows(stacked @ blocks)
        transform = divide_by_factor(blocks, reference)
        inner, prediction = reference[p:, p:], None
        if not criterion.is_d:
            L = np.eye(len(space))
            if criterion.weights is not None:
                L = criterion.weights @ space.machine / np.sqrt(criterion.count)
            prediction = factor_rows(divide_by_factor(L, inner))
            if not prediction.any():
                raise EstimationError.of("plan.prediction-unobservable")
        offset = float(2.0 * np.log(np.abs(np.diagonal(inner))).sum())
        return Scoring(space, transform, factor_rows(prior.rows @ transform), prediction, offset)

    def scale_candidates(self, n: int) -> ScaledCandidates:
        """Return the allowed groups scaled by the mean design of n of them; many rows of which at
        most half are independent, such as corners of a picture, become as many as these.
        """
        self.require_enough(n)
        scoring = self.build_scoring(n)
        rows = scoring.scale_rows(self.rows[self.allowed])
        if rows.shape[1] >= MANY_ROWS:
            _, s, directions = np.linalg.svd(rows, full_matrices=False)
            rank = int(are_nonzero(s).sum(axis=1).max())
            if 2 * rank <= rows.shape[1]:
                rows = (s[:, :, None] * directions)[:, :rank]
        return ScaledCandidates(self, scoring, rows, self.allowed)


@dataclass(frozen=True, eq=False)
class Scoring:
    """A criterion in the coordinates of the mean design."""

    space: ObservableSpace  # the observable directions
    # (o + p, Q) from given rows to scaled rows, Q = o' + q, nuisance directions first
    transform: FloatArray
    prior_rows: FloatArray  # (k, Q) scaled rows of the prior
    prediction: FloatArray | None  # (j, q) K of I and A, in the same coordinates; None for D
    offset: float  # value of D where the score is zero

    @property
    def n_nuisance(self) -> int:
        """Number o' of nuisance directions."""
        return self.space.nuisance.shape[1]

    @property
    def height(self) -> float:
        """Number h: the score grows by h log c where all information is multiplied by c."""
        return float(len(self.space)) if self.prediction is None else 1.0

    def scale_rows(self, rows: FloatArray) -> FloatArray:
        """Return rows (..., r, o + p) in these coordinates, (..., r, Q); more than Q are folded."""
        scaled = rows @ self.transform
        return scaled if scaled.shape[-2] <= scaled.shape[-1] else factor_rows(scaled)

    def factor(self, scaled: FloatArray) -> FloatArray:
        """Return R (Q, Q) of the prior and scaled rows (..., Q)."""
        columns = self.prior_rows.shape[1]
        return factor_square(np.concatenate([self.prior_rows, scaled.reshape(-1, columns)]))

    def score(self, R: FloatArray) -> float:
        """Return the score of a factor; -inf where it is singular."""
        pivots = np.abs(np.diagonal(R))
        if not (pivots > SINGULAR**2).all():
            return -np.inf
        if self.prediction is None:
            return float(2.0 * np.log(pivots[self.n_nuisance :]).sum())
        return float(-np.log((self.predict(R) ** 2).sum()))

    def predict(self, R: FloatArray) -> FloatArray:
        """Return P = K R_pp^-1 (j, q); the sum of its squares is the trace of I and A."""
        assert self.prediction is not None
        return divide_by_factor(self.prediction, R[self.n_nuisance :, self.n_nuisance :])

    def value(self, score: float) -> float:
        """Return the value of the criterion at a score."""
        return score + self.offset if self.prediction is None else float(np.exp(-score))

    def with_ridge(self, ridge: float) -> Scoring:
        """Return this with `ridge`^2 of the mean design as prior; no design is singular then."""
        rows = np.concatenate([self.prior_rows, ridge * np.eye(self.prior_rows.shape[1])])
        return replace(self, prior_rows=rows)


def is_determined(R: FloatArray) -> bool:
    """Return whether a design with factor R determines all directions; see SINGULAR."""
    return bool(np.linalg.svd(R, compute_uv=False)[-1] > SINGULAR)


@dataclass(frozen=True, eq=False)
class ScaledCandidates:
    """The allowed groups of a problem in the coordinates of its scoring."""

    problem: DesignProblem
    scoring: Scoring  # of designs
    rows: FloatArray  # (N, r, Q) scaled
    indices: IntArray  # (N,) of the groups among all

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def repeats(self) -> bool:
        """Whether a group may be chosen more than once."""
        return self.problem.repeats

    def take(self, chosen: IntArray) -> ScaledCandidates:
        """Return some of the groups."""
        return replace(self, rows=self.rows[chosen], indices=self.indices[chosen])

    def factor(self, chosen: IntArray) -> FloatArray:
        """Return the factor (Q, Q) of the prior and the chosen groups (n,)."""
        return self.scoring.factor(self.rows[chosen])

    def is_determined(self, chosen: IntArray) -> bool:
        """Return whether the chosen groups (n,) determine all directions."""
        return is_determined(self.factor(chosen))


def find_slope_columns(scoring: Scoring, R: FloatArray) -> FloatArray:
    """Return B (Q, j) at a nonsingular factor R (Q, Q) of a design: |X B|^2 is the derivative of
    the score by the weight of a group with scaled rows X.
    """
    columns = divide_by_factor(np.eye(len(R)), R)[:, scoring.n_nuisance :]
    if scoring.prediction is None:
        return columns
    P = scoring.predict(R)
    return columns @ P.T / np.linalg.norm(P)


def compute_slopes(scaled: FloatArray, columns: FloatArray) -> FloatArray:
    """Return the derivatives |X B|^2 (N,) of the score by weights of groups X (N, r, Q), with the
    B (Q, j) of `find_slope_columns`.
    """
    Y = scaled.reshape(-1, len(columns)) @ columns
    return np.einsum("mj,mj->m", Y, Y).reshape(scaled.shape[:2]).sum(axis=1)


# The change of score by every swap at once.


@dataclass(frozen=True, eq=False)
class SwapTerms:
    """Terms of the swap formulas for all groups at the present design."""

    Y: FloatArray  # (N, r, Q)
    W: FloatArray  # (N, r, r)
    log_added: FloatArray  # (N,) log det(I + G_kk)
    # the same terms in the nuisance columns; None without any, and for I and A
    nuisance: SwapTerms | None = None
    V: FloatArray | None = None  # (N, r, j) for I and A; None for D
    gram: FloatArray | None = None  # (N, r, r) V V'; None for D
    trace: float = 0.0  # |P|^2


def compute_swap_terms(scoring: Scoring, R: FloatArray, scaled: FloatArray) -> SwapTerms:
    """Return the swap terms of scaled rows (N, r, Q) for a nonsingular factor R (Q, Q)."""
    Y = divide_by_factor(scaled, R)
    if scoring.prediction is None:
        return _determinant_terms(Y, scoring.n_nuisance)
    P = scoring.predict(R)
    V = Y[:, :, scoring.n_nuisance :] @ P.T
    gram = V @ V.swapaxes(1, 2)
    return replace(_determinant_terms(Y, 0), V=V, gram=gram, trace=float((P**2).sum()))


def _determinant_terms(Y: FloatArray, n_nuisance: int) -> SwapTerms:
    """Return the terms that D needs."""
    total = np.eye(Y.shape[1]) + Y @ Y.swapaxes(1, 2)
    return SwapTerms(
        Y,
        np.asarray(np.linalg.inv(total), dtype=np.float64),
        np.asarray(np.linalg.slogdet(total)[1], dtype=np.float64),
        _determinant_terms(Y[:, :, :n_nuisance], 0) if n_nuisance else None,
    )


def score_additions(terms: SwapTerms) -> FloatArray:
    """Return the change of score (N,) when one group is added and none is removed."""
    if terms.V is None or terms.gram is None:
        return terms.log_added - (0.0 if terms.nuisance is None else terms.nuisance.log_added)
    trace = terms.trace - (terms.W * terms.gram).sum(axis=(1, 2))
    return np.log(terms.trace) - np.log(np.maximum(trace, np.finfo(np.float64).tiny))


def score_swaps(terms: SwapTerms, j: int, among: IntArray | None = None) -> FloatArray:
    """Return the change of score (N,) when each group, or each of those `among` them, replaces
    group j, which is in the design; -inf where the new design is singular.
    """
    taken = slice(None) if among is None else among
    Y, W = terms.Y[j], terms.W[taken]
    U = np.tensordot(terms.Y[taken], Y, (2, 1))
    WU = W @ U
    S = np.eye(len(Y)) - Y @ Y.T + U.swapaxes(1, 2) @ WU
    sign, logdet = np.linalg.slogdet(S)
    regular = sign > 0.0
    if terms.V is None or terms.gram is None:
        nuisance = 0.0 if terms.nuisance is None else score_swaps(terms.nuisance, j, among)
        return np.where(regular, terms.log_added[taken] + logdet - nuisance, -np.inf)
    V, gram = terms.V[j], terms.gram[taken]
    cross = WU.swapaxes(1, 2) @ np.tensordot(terms.V[taken], V, (2, 1))
    product = V @ V.T - cross - cross.swapaxes(1, 2) + WU.swapaxes(1, 2) @ gram @ WU
    S = np.where(regular[:, None, None], S, np.eye(len(Y)))
    back = np.trace(np.linalg.solve(S, product), axis1=1, axis2=2)
    trace = terms.trace - (W * gram).sum(axis=(1, 2)) + back
    return np.where(
        regular & (trace > 0.0),
        np.log(terms.trace) - np.log(np.where(trace > 0.0, trace, 1.0)),
        -np.inf,
    )
