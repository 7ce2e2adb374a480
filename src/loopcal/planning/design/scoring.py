# SPDX-License-Identifier: Apache-2.0
"""Score of a design in scaled coordinates, and the change of score by every swap at once.

With R_ref the factor of a mean design in the observable directions, nuisance parameters first, rows
x become x R_ref^-1. The mean design then has the unit matrix as its information, and scaling loses
no digits. The factor R of a design, partitioned [[R_oo, R_op], [0, R_pp]], gives its score, larger
being better:

    D: 2 sum log |diag R_pp|        I and A: -log |K R_pp^-1|^2

Scores are concave in the information. exp((score - score') / h), with h = q directions for D and
h = 1 for I and A, is the efficiency of one design relative to the other.

For swaps let Y = X R^-1 for a group's rows X, G_kk = Y_k Y_k', U = Y_k Y_j' and
W_k = (I + G_kk)^-1. Adding group k and removing group j multiplies the determinant of the
information by

    det(I + G_kk) det(S),    S = I - Y_j Y_j' + U' W_k U

and changes the trace |P|^2 of I and A, with V = Y P', to

    |P|^2 - tr(W_k V_k V_k') + tr(S^-1 B B'),    B = V_j - U' W_k V_k

Adding first keeps both formulas exact where the design without j is singular. D does not count the
nuisance parameters; their part of the determinant is the same formula in their columns alone, since
R is triangular with these first. Derivations: docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import report_finding
from loopcal.planning.design.criteria import Criterion, D, E, I
from loopcal.planning.design.design_space import (
    ObservableSpace,
    PriorInformation,
    divide_by_factor,
    factor_rows,
    find_observable_space,
    is_allowed,
    require_enough,
)
from loopcal.typing import FloatArray, IntArray

SINGULAR = 1e-6
"""A design is singular where it determines a direction with less than this share of the mean
design's information, as a ratio of standard deviations.
"""

GAIN = 1e-7
"""An exchange or a move must multiply the efficiency by more than 1 + this."""

RIDGE = 1e-3
"""Ridge that is added to a singular start, as a ratio of standard deviations to the mean design."""


@dataclass(frozen=True, eq=False)
class Scoring:
    """A criterion in the coordinates of the mean design.

    Attributes
    ----------
    space : the observable directions.
    transform : (o + p, Q) from given rows to scaled rows, Q = o' + q, nuisance directions first.
    prior_rows : (k, Q) scaled rows of the prior.
    prediction : (j, q) K of I and A, in the same coordinates; None for D.
    offset : value of D where the score is zero.
    """

    space: ObservableSpace
    transform: FloatArray
    prior_rows: FloatArray
    prediction: FloatArray | None
    offset: float

    @property
    def n_nuisance(self) -> int:
        """Number o' of nuisance directions."""
        return self.space.nuisance.shape[1]

    @property
    def height(self) -> float:
        """Number h: the score grows by h log c where all information is multiplied by c."""
        return float(len(self.space)) if self.prediction is None else 1.0

    def scale_rows(self, rows: FloatArray) -> FloatArray:
        """Return rows (..., r, o + p) in these coordinates, (..., r, Q); more than Q rows are
        folded to Q.
        """
        scaled = rows @ self.transform
        return (
            scaled
            if scaled.shape[-2] <= scaled.shape[-1]
            else np.asarray(np.linalg.qr(scaled, mode="r"))
        )

    def factor(self, scaled: FloatArray) -> FloatArray:
        """Return R (Q, Q) of the prior and scaled rows (..., Q), padded with rows of zeros."""
        columns = self.prior_rows.shape[1]
        R = factor_rows(np.concatenate([self.prior_rows, scaled.reshape(-1, columns)]))
        return np.concatenate([R, np.zeros((columns - len(R), columns))])

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


def build_scoring(
    rows: FloatArray,
    weight: float,
    criterion: Criterion,
    prior: PriorInformation,
    space: ObservableSpace,
) -> Scoring:
    """Return the scoring whose mean design is the prior and every group with the same weight.

    Parameters
    ----------
    rows : (N, r, o + p), finite. weight : of each group.

    Raises
    ------
    EstimationError
        The criterion is E, or the weights of I depend on no observable direction.
    """
    if isinstance(criterion, E):
        raise EstimationError("criterion E cannot be optimized; choose D, I or A")
    o, p = space.nuisance.shape
    blocks = np.zeros((o + len(space.machine), space.n_unknowns))
    blocks[:o, :p], blocks[o:, p:] = space.nuisance, space.machine
    stacked = np.concatenate([prior.rows, np.sqrt(weight) * rows.reshape(-1, rows.shape[-1])])
    reference = factor_rows(stacked @ blocks)
    transform = divide_by_factor(blocks, reference)
    inner, prediction = reference[p:, p:], None
    if not isinstance(criterion, D):
        L = (
            criterion.weights @ space.machine / np.sqrt(criterion.count)
            if isinstance(criterion, I)
            else np.eye(len(space))
        )
        prediction = factor_rows(divide_by_factor(L, inner))
        if not prediction.any():
            raise EstimationError(report_finding("plan.prediction-unobservable"))
    offset = float(2.0 * np.log(np.abs(np.diagonal(inner))).sum())
    prior_rows = factor_rows(prior.rows @ transform)
    return Scoring(space, transform, prior_rows, prediction, offset)


@dataclass(frozen=True, eq=False)
class ScaledCandidates:
    """The allowed groups of a problem in the coordinates of its scoring.

    Attributes
    ----------
    scoring : of designs. rows : (N, r, Q) scaled. indices : (N,) of the groups among all.
    repeats : whether a group may be chosen more than once.
    """

    scoring: Scoring
    rows: FloatArray
    indices: IntArray
    repeats: bool

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, chosen: IntArray) -> ScaledCandidates:
        """Return some of the groups."""
        return replace(self, rows=self.rows[chosen], indices=self.indices[chosen])

    def factor(self, chosen: IntArray) -> FloatArray:
        """Return the factor (Q, Q) of the prior and the chosen groups (n,)."""
        return self.scoring.factor(self.rows[chosen])

    def is_determined(self, chosen: IntArray) -> bool:
        """Return whether the chosen groups (n,) determine all directions."""
        return is_determined(self.factor(chosen))


def scale_candidates(
    rows: FloatArray, n: int, criterion: Criterion, prior: PriorInformation, repeats: bool
) -> ScaledCandidates:
    """Return the allowed groups scaled by the mean design of n of them.

    Raises
    ------
    EstimationError
        See `require_enough` and `build_scoring`.
    """
    space = find_observable_space(rows, prior)
    require_enough(n, rows, prior, space, repeats)
    usable = np.flatnonzero(is_allowed(rows))
    scoring = build_scoring(rows[usable], n / len(usable), criterion, prior, space)
    return ScaledCandidates(scoring, scoring.scale_rows(rows[usable]), usable, repeats)


@dataclass(frozen=True, eq=False)
class SwapTerms:
    """Terms of the swap formulas for all groups at the present design.

    Attributes
    ----------
    Y : (N, r, Q). W : (N, r, r).
    log_added : (N,) log det(I + G_kk).
    nuisance : the same terms in the nuisance columns; None without any, and for I and A.
    V : (N, r, j) for I and A; None for D.
    gram : (N, r, r) V V'; None for D.
    trace : |P|^2.
    """

    Y: FloatArray
    W: FloatArray
    log_added: FloatArray
    nuisance: SwapTerms | None = None
    V: FloatArray | None = None
    gram: FloatArray | None = None
    trace: float = 0.0


def compute_swap_terms(scoring: Scoring, R: FloatArray, scaled: FloatArray) -> SwapTerms:
    """Return the swap terms of scaled rows (N, r, Q) for a nonsingular factor R (Q, Q)."""
    Y = divide_by_factor(scaled, R)
    if scoring.prediction is None:
        return _determinant_terms(Y, scoring.n_nuisance)
    P = scoring.predict(R)
    V = Y[:, :, scoring.n_nuisance :] @ P.T
    base = _determinant_terms(Y, 0)
    gram = V @ V.swapaxes(1, 2)
    return replace(base, V=V, gram=gram, trace=float((P**2).sum()))


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


def score_swaps(terms: SwapTerms, j: int) -> FloatArray:
    """Return the change of score (N,) when each group replaces group j, which is in the design.

    -inf where the new design is singular.
    """
    Y = terms.Y[j]
    U = terms.Y @ Y.T
    WU = terms.W @ U
    S = np.eye(len(Y)) - Y @ Y.T + U.swapaxes(1, 2) @ WU
    sign, logdet = np.linalg.slogdet(S)
    regular = sign > 0.0
    if terms.V is None or terms.gram is None:
        nuisance = 0.0 if terms.nuisance is None else score_swaps(terms.nuisance, j)
        return np.where(regular, terms.log_added + logdet - nuisance, -np.inf)
    V = terms.V[j]
    cross = WU.swapaxes(1, 2) @ (terms.V @ V.T)
    product = V @ V.T - cross - cross.swapaxes(1, 2) + WU.swapaxes(1, 2) @ terms.gram @ WU
    S = np.where(regular[:, None, None], S, np.eye(len(Y)))
    back = np.trace(np.linalg.solve(S, product), axis1=1, axis2=2)
    trace = terms.trace - (terms.W * terms.gram).sum(axis=(1, 2)) + back
    return np.where(
        regular & (trace > 0.0),
        np.log(terms.trace) - np.log(np.where(trace > 0.0, trace, 1.0)),
        -np.inf,
    )
