# SPDX-License-Identifier: Apache-2.0
"""Criteria of optimal design: scalar figures of the covariance C of the machine's unknowns.

    D = log det C^-1, larger is better      A = trace C      E = largest eigenvalue of C
    I = trace(L C L') / count: mean variance of a prediction, L its derivatives over the workspace

C is in units of the tolerances. The nuisance parameters of the instruments are eliminated, and C is
restricted to the observable directions. Designs are optimized for D, I or A; A is I with L = 1.
Formulas: docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from loopcal.planning.design.design_space import divide_by_factor
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class D:
    """Log determinant of the information on the machine.

    A large value means a small volume of uncertainty. The best design does not depend on scaling.
    """

    name: ClassVar[str] = "D"


@dataclass(frozen=True, eq=False)
class I:  # noqa: E742
    """Mean variance of a prediction.

    Attributes
    ----------
    weights : (k, p) rows L: derivatives of all predicted quantities by the machine's unknowns [per
        tolerance].
    count : number of predictions (poses) in `weights`; the sum of the variances is divided by it.
    """

    weights: FloatArray
    count: int = 1
    name: ClassVar[str] = "I"


@dataclass(frozen=True)
class A:
    """Sum of the variances of the observable directions, in squared tolerances."""

    name: ClassVar[str] = "A"


@dataclass(frozen=True)
class E:
    """Variance of the worst observable direction, in squared tolerances; never optimized."""

    name: ClassVar[str] = "E"


Criterion = D | I | A | E


def is_full_rank(singular_values: np.ndarray) -> bool:
    """Return whether a triangular factor with these descending singular values can be inverted.

    The threshold is the rounding of the decomposition: a design that determines a direction barely
    is poor, and the criterion says so, but it is not singular.
    """
    s = singular_values
    return not s.size or bool(s[-1] > np.finfo(np.float64).eps * len(s) * s[0])


def evaluate_criterion(criterion: Criterion, factor: FloatArray, machine: FloatArray) -> float:
    """Return the value of a criterion.

    Parameters
    ----------
    factor : (q, q) upper triangular R; R'R is the information on the observable directions.
    machine : (p, q) these directions, orthonormal in the machine's unknowns.

    Returns
    -------
    value : -inf for D and inf for the others where R is singular.
    """
    s = np.linalg.svd(factor, compute_uv=False)
    if not is_full_rank(s):
        return -np.inf if isinstance(criterion, D) else np.inf
    match criterion:
        case D():
            return float(2.0 * np.log(s).sum())
        case A():
            return float((1.0 / s**2).sum())
        case E():
            return float(1.0 / s[-1] ** 2) if s.size else 0.0
        case I():
            projected = divide_by_factor(criterion.weights @ machine, factor)
            return float((projected**2).sum() / criterion.count)


def compute_efficiency(criterion: Criterion, value: float, best: float, n_directions: int) -> float:
    """Return the efficiency of a value relative to the best possible one, 0 to 1.

    It is (ratio of determinants)^(1 / n_directions) for D, the ratio of variances for the others.
    """
    if isinstance(criterion, D):
        return float(np.exp((value - best) / n_directions))
    return float(best / value)
