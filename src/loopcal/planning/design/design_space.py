# SPDX-License-Identifier: Apache-2.0
"""Information of designs: prior rows, observable directions, and the factor of a chosen design.

A **group** is what is measured together: one pose, or several poses that one row compares. Its rows
[F | A] have the nuisance parameters of the instruments (F, to be eliminated) before the unknowns of
the machine (A). Directions of the machine that no candidate separates from the nuisance parameters
are removed once, by a stated tolerance, for all designs alike. See docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from loopcal.errors import EstimationError
from loopcal.findings import report_finding
from loopcal.numerics.column_elimination import eliminate_from_triangle
from loopcal.numerics.decomposition import RANK_TOLERANCE, are_nonzero
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class PriorInformation:
    """Information that exists before the first new pose.

    Attributes
    ----------
    rows : (k, o + p) whitened and in tolerances: rows measured already, or identity rows for
        tolerances.
    n_nuisance : o, number of nuisance parameters; their columns come first.
    """

    rows: FloatArray
    n_nuisance: int = 0

    @classmethod
    def none(cls, machine: int, nuisance: int = 0) -> PriorInformation:
        """Return no information on `machine` unknowns and `nuisance` nuisance parameters."""
        return cls(np.zeros((0, nuisance + machine)), nuisance)

    @classmethod
    def from_tolerances(cls, machine: int, nuisance: int = 0) -> PriorInformation:
        """Return variance 1 for each machine unknown and nothing for the nuisance parameters."""
        return cls(np.eye(nuisance + machine)[nuisance:], nuisance)

    def with_rows(self, rows: ArrayLike) -> PriorInformation:
        """Return this with more rows (..., o + p): measured poses, or tolerances of nuisance
        parameters.
        """
        added = np.asarray(rows, dtype=np.float64).reshape(-1, self.rows.shape[1])
        return PriorInformation(factor_rows(np.concatenate([self.rows, added])), self.n_nuisance)


@dataclass(frozen=True, eq=False)
class ObservableSpace:
    """The directions that a set of rows can determine; designs are compared in this space.

    Attributes
    ----------
    machine : (p, q) orthonormal directions of the machine's unknowns.
    nuisance : (o, o') directions of the nuisance parameters.
    singular_values : (p,) of the machine's columns after elimination, descending.
    """

    machine: FloatArray
    nuisance: FloatArray
    singular_values: FloatArray

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


@dataclass(frozen=True, eq=False)
class Design:
    """A chosen set of groups.

    Attributes
    ----------
    chosen : (n,) indices of the candidates, ascending.
    value : of the criterion.
    history : values of the best start: after it began, and after each exchange.
    values : final value of each start.
    space : the directions in which the value counts.
    is_converged : whether no single exchange improves it; False where the exchanges ran out.
    """

    chosen: IntArray
    value: float
    history: tuple[float, ...]
    values: tuple[float, ...]
    space: ObservableSpace
    is_converged: bool = True


def factor_rows(rows: FloatArray) -> FloatArray:
    """Return the triangular factor R of rows (m, c), at most (c, c): R'R is their information."""
    return np.asarray(np.linalg.qr(rows, mode="r"))


def divide_by_factor(rows: FloatArray, R: FloatArray) -> FloatArray:
    """Return X R^-1 for rows X (..., q) and a nonsingular triangular factor R (q, q)."""
    from scipy.linalg.blas import dtrsm  # pyright: ignore[reportAttributeAccessIssue]

    flat = rows.reshape(-1, rows.shape[-1])
    # R' is lower triangular, and both transposes are already in the order of BLAS
    return np.asarray(dtrsm(1.0, R.T, flat.T, lower=1).T, dtype=np.float64).reshape(rows.shape)


def is_allowed(rows: FloatArray) -> BoolArray:
    """Return for rows (N, r, c) of N groups which groups (N,) contain no NaN."""
    return np.asarray(np.isfinite(rows).all(axis=(1, 2)))


def find_observable_space(
    rows: FloatArray, prior: PriorInformation, tolerance: float = RANK_TOLERANCE
) -> ObservableSpace:
    """Return the directions that all groups and the prior determine together.

    The nuisance parameters are eliminated by `loopcal.numerics.column_elimination`. The remainder
    of the machine's columns is cut at `tolerance` times its largest singular value.

    Parameters
    ----------
    rows : (N, r, o + p); NaN where a group is not allowed.
    """
    allowed = rows[is_allowed(rows)].reshape(-1, rows.shape[-1])
    o = prior.n_nuisance
    R = _pad_factor(factor_rows(np.concatenate([prior.rows, allowed])))
    nuisance, rest = np.zeros((0, 0)), R
    if o:
        norm = np.linalg.norm(R[:o, :o], axis=0)
        length = np.where(norm > 0.0, norm, 1.0)
        done = eliminate_from_triangle(R[:o, :o], R[:o, o:], R[o:, o:], length)
        nuisance, rest = done.directions[done.is_observable].T / length[:, None], done.rest
    _, s, vt = np.linalg.svd(rest)
    observable = vt[: len(s)][are_nonzero(s, tolerance)]
    return ObservableSpace(observable.T, nuisance, s)


def factor_design(rows: FloatArray, prior: PriorInformation, space: ObservableSpace) -> FloatArray:
    """Return the factor (q, q) of a design in the machine's observable directions.

    The factor covers rows (n, r, o + p) and the prior; the nuisance parameters are eliminated.
    """
    stacked = np.concatenate([prior.rows, rows.reshape(-1, rows.shape[-1])])
    R = _pad_factor(factor_rows(space.project(stacked)))
    o = space.nuisance.shape[1]
    return R[o:, o:]


def require_enough(
    n: int, rows: FloatArray, prior: PriorInformation, space: ObservableSpace, repeats: bool = True
) -> None:
    """Refuse a number of groups that cannot determine all directions.

    Raises
    ------
    EstimationError
        No candidate is allowed; nothing is observable; n groups have fewer rows than the prior
        leaves unknowns; or, without repeats, fewer candidates are allowed than n.
    """
    count = int(is_allowed(rows).sum())
    if count == 0:
        raise EstimationError(report_finding("plan.no-candidate-allowed", total=len(rows)))
    if len(space) == 0:
        raise EstimationError(report_finding("plan.no-direction-observable"))
    if n > count and not repeats:
        raise EstimationError(
            report_finding("plan.too-few-candidates", requested=n, what="poses", available=count)
        )
    needed = count_groups_needed(rows.shape[1], prior, space)
    if n < needed:
        raise EstimationError(
            report_finding(
                "plan.design-too-small",
                requested=n,
                equations=n * rows.shape[1],
                unknowns=space.n_unknowns - _prior_rank(prior, space),
                needed=needed,
            )
        )


def count_groups_needed(equations: int, prior: PriorInformation, space: ObservableSpace) -> int:
    """Return the smallest number of groups, of `equations` rows each, that can determine all
    directions together with the prior.
    """
    return max(-(-(space.n_unknowns - _prior_rank(prior, space)) // equations), 1)


def _prior_rank(prior: PriorInformation, space: ObservableSpace) -> int:
    """Return how many directions, nuisance and machine together, the prior determines."""
    if not prior.rows.any():
        return 0
    s = np.linalg.svd(space.project(prior.rows), compute_uv=False)
    return int(are_nonzero(s).sum())


def _pad_factor(R: FloatArray) -> FloatArray:
    """Return a factor (m, c) of few rows with rows of zeros below, (c, c)."""
    return np.concatenate([R, np.zeros((max(R.shape[1] - len(R), 0), R.shape[1]))])
