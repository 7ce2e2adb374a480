# SPDX-License-Identifier: Apache-2.0
"""One step towards the filtered solution, damped where the full step is too long.

In the coordinates y = V'z the target of the method is y*, and the curvature of direction i is
h_i = s_i^2 + penalty_i. Damping adds mu |dz|^2, z in tolerances, and so moves direction i by the
share h_i / (h_i + mu) of y*_i - y_i. It acts on the singular values, so that a damped step costs no
new decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class FilteredStep(TrialBatch):
    """A step of some trials towards the filtered solution.

    Attributes
    ----------
    deviation : (a, p) total deviation to which it leads. target : (a, p) that of the full step.
    length, full_length : (a,) of this step and of the full one, in tolerances.
    predicted : (a,) decrease of sum of squares plus penalty by the linear model.
    change : (a,) squared length of the full step measured in the whitened residuals and the
        penalty.
    """

    deviation: FloatArray
    target: FloatArray
    length: FloatArray
    full_length: FloatArray
    predicted: FloatArray
    change: FloatArray


def propose_step(
    deviation: FloatArray, decomposition: Decomposition, penalty: FloatArray, damping: FloatArray
) -> FilteredStep:
    """Return the step from `deviation` (a, p) to the filtered solution, damped by mu (a,)."""
    s, c = decomposition.singular_values, decomposition.projections
    current = decomposition.coordinates(deviation)
    solution = decomposition.solution(penalty)
    full = solution - current
    curvature = _curvature(s, penalty)
    new = current + curvature / (curvature + damping[:, None]) * full
    # differences of squares as products, so that a small decrease is not lost in a large sum
    data = s * (current - new) * (s * (current + new) - 2.0 * c)
    prior = _finite(penalty) * (current - new) * (current + new)
    reached = decomposition.deviation(new)
    return FilteredStep(
        deviation=reached,
        target=decomposition.deviation(solution),
        length=np.linalg.norm(reached - deviation, axis=1),
        full_length=np.linalg.norm(decomposition.deviation(full), axis=1),
        predicted=(data + prior).sum(axis=1),
        change=(curvature * full**2).sum(axis=1),
    )


def penalize(
    decomposition: Decomposition, penalty: FloatArray, deviation: FloatArray
) -> FloatArray:
    """Return what the penalty adds to the sum of squares at `deviation` (a, p).

    It is the sum of penalty_i (v_i'z)^2, (a,), without directions that are not used.
    """
    weight = _finite(penalty)
    if not weight.any():
        return np.zeros(len(deviation))
    return (weight * decomposition.coordinates(deviation) ** 2).sum(axis=1)


def _finite(penalty: FloatArray) -> FloatArray:
    """Return the penalty with zero for directions that are not used."""
    return np.where(np.isfinite(penalty), penalty, 0.0)


def _curvature(s: FloatArray, penalty: FloatArray) -> FloatArray:
    """Return the curvature h (a, p) of each direction.

    A direction that is not used is as stiff as the weakest one that is.
    """
    used = np.isfinite(penalty)
    h = s**2 + _finite(penalty)
    weakest = np.where(used, h, np.inf).min(axis=1, initial=np.inf)
    return np.where(used, h, np.where(np.isfinite(weakest), weakest, 1.0)[:, None])
