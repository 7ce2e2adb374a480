# SPDX-License-Identifier: Apache-2.0
"""Leave-one-block-out scores of many ridge parameters and truncations from one linearisation.

With the rows of block j in the coordinates of the decomposition, B_j = A_j V, the hat matrix of a
penalty is H_jj = B_j diag(1 / (s^2 + penalty)) B_j', and the residual that the block would have
without it r_(j) = (I - H_jj)^-1 r_j. No fit is repeated. To first order in the deviation from where
the rows are linearised; exact for a linear problem.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.methods.penalties import Method, Ridge, TruncatedSVD, adapt_method
from loopcal.estimate.observation_rows import linked_blocks
from loopcal.estimate.problem import problem_of
from loopcal.measure import Measurements
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition, decompose
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Scores of k methods.

    Attributes
    ----------
    methods : the methods. score : (k,) mean square of whitened leave-one-block-out residuals (1:
        noise alone), infinite
        where a block cannot be left out. dof : (k,) effective number of parameters.
    estimate : (k, p) their estimates [SI].
    """

    methods: tuple[Method, ...]
    score: FloatArray
    dof: FloatArray
    estimate: FloatArray

    @property
    def best(self) -> Method:
        """The method with the lowest score."""
        return self.methods[int(np.argmin(self.score))]


def score_leave_one_out(
    robot: Mechanism, data: Measurements, methods: tuple[Method, ...]
) -> LeaveOneOut:
    """Score methods that keep the columns as they are: ridge with one lam, truncation, least
    squares, MAP.

    Parameters
    ----------
    robot : where the rows are linearised; best the robot of a fit. data : the measurements. methods
        : at least one.

    Raises
    ------
    EstimationError
        The kinds have unknowns of their own.
    """
    free = select_free_parameters(robot)
    problem = problem_of(free, data)
    if problem.nuisance is not None:
        raise EstimationError(
            "leave-one-out of many methods needs known frames and targets; state them, or use "
            "cross_validate"
        )
    z = free.deviation(robot.values[None])
    at = problem.linearize(z, problem.start(z))
    d = decompose(at.factor, at.equations, z)
    used = tuple(
        adapt_method(method, np.zeros(len(free), dtype=bool), "given") for method in methods
    )
    penalty = np.concatenate([method.penalty(d) for method in used])
    weight, y = _solutions(d, penalty)
    member = np.unique(linked_blocks(data), return_inverse=True)[1]
    parts = [part for block in problem.leverage_rows(at) for part in block]
    of = np.concatenate([np.repeat(member[part.poses], part.rows.shape[1]) for part in parts])
    A = np.concatenate([part.rows.reshape(-1, part.rows.shape[2]) for part in parts])
    B, b = A[:, :-1] @ d.directions[0], A[:, :-1] @ z[0] - A[:, -1]
    residual = b - y @ B.T
    total = np.zeros(len(penalty))
    for places in _equal_blocks(of):
        own = B[places]  # (u, m, p)
        H = np.matmul(own[None] * weight[:, None, None, :], own.swapaxes(-1, -2)[None])
        left = np.eye(places.shape[1]) - H
        singular = np.linalg.det(left) <= 1e-12
        left = np.where(singular[..., None, None], np.eye(places.shape[1]), left)
        deleted = np.linalg.solve(left, residual[:, places][..., None])[..., 0]
        total += np.where(singular, np.inf, (deleted**2).sum(axis=2)).sum(axis=1)
    dof = np.stack([d.filter_factors(row[None])[0].sum() for row in penalty])
    estimate = free.nominal + free.tolerance * (y @ d.directions[0].T)
    return LeaveOneOut(tuple(methods), total / int(at.equations[0]), dof, estimate)


def build_regularization_path(data_scale: float, count: int, parameters: int) -> tuple[Method, ...]:
    """Return `count` ridges, lam from 1e-8 to 1e4 of `data_scale`, and every truncation from 0 to
    all parameters.
    """
    lam = data_scale * np.logspace(-8.0, 4.0, count)
    return (
        *(Ridge(float(value)) for value in lam),
        *(TruncatedSVD(k) for k in range(parameters + 1)),
    )


def _solutions(d: Decomposition, penalty: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return 1 / (s^2 + penalty) and the coordinates y, both (k, p); zero where a direction is not
    used.
    """
    s, c = d.singular_values[0], d.projections[0]
    total = s**2 + penalty
    weight = np.divide(
        1.0, total, out=np.zeros_like(total), where=(total > 0.0) & np.isfinite(total)
    )
    return weight, weight * (s * c)


def _equal_blocks(of: np.ndarray) -> list[np.ndarray]:
    """Return the places (u, m) of rows of blocks, those of equal size together."""
    order = np.argsort(of, kind="stable")
    _, first, sizes = np.unique(of[order], return_index=True, return_counts=True)
    return [order[first[sizes == size][:, None] + np.arange(size)] for size in np.unique(sizes)]
