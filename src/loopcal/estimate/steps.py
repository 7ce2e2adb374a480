# SPDX-License-Identifier: Apache-2.0
"""One step of the descent: to the filtered solution, damped where that is too far.

In the coordinates y = V'z the method's target is y* and the curvature of direction i is h_i = s_i^2
+ penalty_i. Levenberg-Marquardt damping adds mu |dz|^2, z in tolerances, and so moves direction i
by the share h_i / (h_i + mu) of y*_i - y_i. Because it acts on the singular values, a damped step
costs no new decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray


@dataclass(frozen=True)
class Step:
    """A proposed step of some trials.

    Attributes
    ----------
    deviation : (a, p) total deviation to which it leads. target : (a, p) that to which the undamped
        step leads.
    length, full_length : (a,) of this step and of the undamped one, in tolerances.
    predicted : (a,) decrease of sum of squares plus penalty that the linear model promises.
    offset : (a,) squared length of the undamped step measured in the whitened residuals and the
        penalty.
    """

    deviation: FloatArray
    target: FloatArray
    length: FloatArray
    full_length: FloatArray
    predicted: FloatArray
    offset: FloatArray

    def take(self, trials: np.ndarray) -> Step:
        """Only these trials."""
        return Step(*(array[trials] for array in vars(self).values()))


def propose(
    deviation: FloatArray, decomposition: Decomposition, penalty: FloatArray, damping: FloatArray
) -> Step:
    """Return the step from `deviation` (a, p) to the filtered solution, damped by mu = `damping`
    (a,).
    """
    s, c = decomposition.singular_values, decomposition.projections
    now = decomposition.coordinates(deviation)
    solution = decomposition.solution(penalty)
    full = solution - now
    curvature = _curvature(s, penalty)
    new = now + curvature / (curvature + damping[:, None]) * full
    # differences of squares as products, so that a small decrease is not lost in a large sum
    data = s * (now - new) * (s * (now + new) - 2.0 * c)
    prior = finite(penalty) * (now - new) * (now + new)
    reached = decomposition.deviation(new)
    return Step(
        deviation=reached,
        target=decomposition.deviation(solution),
        length=np.linalg.norm(reached - deviation, axis=1),
        full_length=np.linalg.norm(decomposition.deviation(full), axis=1),
        predicted=(data + prior).sum(axis=1),
        offset=(curvature * full**2).sum(axis=1),
    )


def penalised(
    decomposition: Decomposition, penalty: FloatArray, deviation: FloatArray
) -> FloatArray:
    """Return what the penalty adds to the sum of squares at `deviation` (a, p): sum of penalty_i
    (v_i'z)^2, (a,).
    """
    weight = finite(penalty)
    if not weight.any():
        return np.zeros(len(deviation))
    return (weight * decomposition.coordinates(deviation) ** 2).sum(axis=1)


def finite(penalty: FloatArray) -> FloatArray:
    """Return the penalty with zero for directions that are not used: they add nothing to the sum
    that is lowered.
    """
    return np.where(np.isfinite(penalty), penalty, 0.0)


def _curvature(s: FloatArray, penalty: FloatArray) -> FloatArray:
    """Curvature h (a, p) of each direction; a direction that is not used is as stiff as the weakest
    one that is.
    """
    used = np.isfinite(penalty)
    h = s**2 + finite(penalty)
    weakest = np.where(used, h, np.inf).min(axis=1, initial=np.inf)
    return np.where(used, h, np.where(np.isfinite(weakest), weakest, 1.0)[:, None])
