# SPDX-License-Identifier: Apache-2.0
"""What makes a set of poses good: four figures of the covariance C that its rows leave of the
machine's unknowns.

    D = log det C^-1, larger is better      A = trace C      E = largest eigenvalue of C
    I = trace(L C L') / count: the mean variance of what is to be predicted, L its rows over the
    workspace

C has the unknowns of the instruments eliminated and is taken over the directions that can be known
at all, in units of the tolerances. D and I are optimised, and A is the I of L = 1. Formulas:
docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.typing import FloatArray


@dataclass(frozen=True)
class D:
    """Log determinant of the information on the machine: a small volume of uncertainty, whatever
    the scaling.
    """

    name: ClassVar[str] = "D"


@dataclass(frozen=True, eq=False)
class I:  # noqa: E742
    """Mean variance of what is to be predicted.

    Attributes
    ----------
    weights : (k, p) rows L: derivatives of all predicted quantities by the machine's unknowns [per
        tolerance].
    count : number of predictions (poses) that they belong to, by which the sum is divided.
    """

    weights: FloatArray
    count: int = 1
    name: ClassVar[str] = "I"


@dataclass(frozen=True)
class A:
    """Sum of the variances of the directions that can be known, in squared tolerances."""

    name: ClassVar[str] = "A"


@dataclass(frozen=True)
class E:
    """Variance of the worst direction that can be known, in squared tolerances: a figure, which no
    exchange optimises.
    """

    name: ClassVar[str] = "E"


Criterion = D | I | A | E


def evaluate(criterion: Criterion, factor: FloatArray, machine: FloatArray) -> float:
    """Return the value of a criterion.

    Parameters
    ----------
    factor : (q, q) upper triangular R, the information on the directions being R'R.
    machine : (p, q) the orthonormal directions in the machine's unknowns.

    Returns
    -------
    value : -inf for D and inf for the others where R is singular.
    """
    s = np.linalg.svd(factor, compute_uv=False)
    if s.size and not s[-1] > np.finfo(np.float64).eps * len(s) * s[0]:
        return -np.inf if isinstance(criterion, D) else np.inf
    match criterion:
        case D():
            return float(2.0 * np.log(s).sum())
        case A():
            return float((1.0 / s**2).sum())
        case E():
            return float(1.0 / s[-1] ** 2) if s.size else 0.0
        case I():
            spread = np.linalg.solve(factor.T, (criterion.weights @ machine).T)
            return float((spread**2).sum() / criterion.count)


def efficiency(criterion: Criterion, value: float, best: float, directions: int) -> float:
    """Return how much of the best possible a value is: (det ratio)^(1/q) for D, the ratio of
    variances for the others.
    """
    if isinstance(criterion, D):
        return float(np.exp((value - best) / directions))
    return float(best / value)
