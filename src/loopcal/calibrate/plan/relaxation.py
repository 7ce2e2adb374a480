# SPDX-License-Identifier: Apache-2.0
"""The convex relaxation: units measured a fraction of a time, and from it the bound that no design of n units can beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.calibrate.plan.criteria import Criterion, D, I, efficiency, evaluate
from loopcal.calibrate.plan.design import Directions, Start, allowed, directions, require_enough, triangle
from loopcal.linalg import FloatArray


MOST = 2000
"""Iterations at most."""


@dataclass(frozen=True, eq=False)
class Relaxed:
    """The best design with fractional weights, and its certificate.

    Attributes
    ----------
    weights : (N,) sum n; at most 1 without repeats. value : of the criterion at these weights.
    bound : no design of n units is better than this. criterion, directions : what is counted, and in which space.
    iterations : made. converged : whether value and bound are within the gap asked for.
    """

    weights: FloatArray
    value: float
    bound: float
    criterion: Criterion
    directions: Directions
    iterations: int
    converged: bool

    def efficiency(self, value: float) -> float:
        """Return at least how much of the best possible a design of this value is, 0 to 1."""
        return efficiency(self.criterion, value, self.bound, len(self.directions))


def relaxed_design(
    rows: FloatArray, n: int, criterion: Criterion, start: Start, gap: float = 1e-3, repeats: bool = False
) -> Relaxed:
    """Return the best weights and the bound.

    Parameters
    ----------
    rows : (N, r, o + p) whitened and tolerance-scaled; NaN where a unit is not allowed. n : units of the design.
    criterion : D, I or A. start : what is known before. gap : of the efficiency at which to stop.
    repeats : whether a unit may be measured more than once; without, weights are at most one and the bound is tighter.

    Returns
    -------
    Relaxed

    Raises
    ------
    EstimationError
        n units cannot determine the unknowns.
    """
    space = directions(rows, start)
    require_enough(n, rows, start, space)
    good = allowed(rows)
    X = space.reduce(rows[good])
    o, q = space.own.shape[1], len(space)
    w = np.full(len(X), n / len(X))
    known = space.reduce(start.rows)
    value, bound, iterations = np.nan, np.nan, 0
    while iterations < MOST and not efficiency(criterion, value, bound, q) > 1.0 - gap:
        iterations += 1
        R = triangle(np.concatenate([known, (np.sqrt(w)[:, None, None] * X).reshape(-1, o + q)]))
        inverse = np.linalg.inv(R)
        value = evaluate(criterion, R[o:, o:], space.machine)
        Y, Y0 = (X @ inverse)[:, :, o:], (known @ inverse)[:, o:]
        if not isinstance(criterion, D):
            K = criterion.weights @ space.machine / np.sqrt(criterion.count) if isinstance(criterion, I) else np.eye(q)
            P = np.linalg.solve(R[o:, o:].T, K.T)
            Y, Y0 = Y @ P, Y0 @ P
        d = (Y**2).sum(axis=(1, 2))
        most = (Y0**2).sum() + n * d.max()
        bound = value + q * np.log(most / q) if isinstance(criterion, D) else value**2 / most
        w = w * (d if isinstance(criterion, D) else np.sqrt(d))
        w *= n / w.sum()
    weights = np.zeros(len(rows))
    weights[good] = w
    converged = efficiency(criterion, value, bound, q) > 1.0 - gap
    return Relaxed(weights, float(value), float(bound), criterion, space, iterations, bool(converged))
