# SPDX-License-Identifier: Apache-2.0
"""The linear model at a point of a descent: it proposes steps, and is decomposed when asked.

Two kinds exist. `TriangularModel` is that of methods whose penalty is known before anything is
decomposed (`FixedPenalty`). Its penalty is appended to the rows, and where every direction of
these certainly counts, the full step is a back substitution with their triangular factor. Steps of
the other trials, damped steps, and what is asked of the last point come from its decomposition.
`SpectralModel` is that of all other methods, which choose their penalty from the singular values.
Both lead to the same estimate. See docs/theory/identification.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from loopcal.engine import fold
from loopcal.estimate.linearization import Linearization
from loopcal.estimate.methods.fixed_penalty import FixedPenalty
from loopcal.estimate.methods.penalties import Method, decompose_for
from loopcal.estimate.minimization.filtered_step import FilteredStep, penalize, propose_step
from loopcal.numerics.decomposition import Decomposition, empty_factor
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.numerics.triangular_systems import solve_regular
from loopcal.typing import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class SpectralModel(TrialBatch):
    """The decomposition of the rows, and the penalty (t, p) that the method chose from it."""

    decomposition: Decomposition
    penalty: FloatArray

    def propose(self, deviation: FloatArray, damping: FloatArray) -> FilteredStep:
        """Return the steps from deviations (t, p), damped by (t,)."""
        return propose_step(deviation, self.decomposition, self.penalty, damping)

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares (t,) at deviations (t, p)."""
        return penalize(self.decomposition, self.penalty, deviation)


@dataclass(frozen=True, eq=False)
class TriangularModel(TrialBatch):
    """The triangular factor of the rows, for a penalty that does not depend on them.

    Attributes
    ----------
    factor : (t, p + 1, p + 1) of rows [A | r]. deviation : (t, p) where they were linearized.
    equations : (t,) that were folded.
    step : (t, p) the full step. gain : (t,) decrease by it of the sum of squares with penalties, as
        the linear model predicts it. is_regular : (t,) where these are known; elsewhere a direction
        might not count, and the decomposition decides.
    method, tolerance, fixed : the method, its rank tolerance and its penalty.
    """

    shared: ClassVar[tuple[str, ...]] = ("method", "tolerance", "fixed")

    factor: FloatArray
    deviation: FloatArray
    equations: IntArray
    step: FloatArray
    gain: FloatArray
    is_regular: BoolArray
    method: Method
    tolerance: float
    fixed: FixedPenalty

    @cached_property
    def decomposition(self) -> Decomposition:
        """The decomposition of the rows for the total deviation."""
        of_rows = self.factor, self.equations, self.deviation
        return decompose_for(self.method, *of_rows, self.tolerance)

    @cached_property
    def penalty(self) -> FloatArray:
        """(t, p) of each direction of the decomposition."""
        return np.array(self.method.penalty(self.decomposition), dtype=np.float64)

    def propose(self, deviation: FloatArray, damping: FloatArray) -> FilteredStep:
        """Return the steps from deviations (t, p), damped by (t,)."""
        is_simple = self.is_regular & (damping == 0.0)
        if not is_simple.any():
            return propose_step(deviation, self.decomposition, self.penalty, damping)
        target = deviation + self.step
        length = np.linalg.norm(self.step, axis=1)
        full = FilteredStep(target, target, length, length, self.gain, self.gain)
        if is_simple.all():
            return full
        others = np.flatnonzero(~is_simple)
        return full.put(others, self.take(others).propose(deviation[others], damping[others]))

    def penalize(self, deviation: FloatArray) -> FloatArray:
        """Return what the penalty adds to the sum of squares (t,) at deviations (t, p)."""
        if not len(self.fixed.rows):
            return np.zeros(len(deviation))
        return (self.fixed.evaluate(deviation) ** 2).sum(axis=1)


LinearModel = SpectralModel | TriangularModel
"""The linear model at the points of t trials."""


def make_linear_model(
    linearized: Linearization, method: Method, tolerance: float, fixed: FixedPenalty | None
) -> LinearModel:
    """Return the linear model of linearized rows; `fixed` is that of `fix_penalty`."""
    factor, equations, z = linearized.factor, linearized.equations, linearized.deviation
    if fixed is None:
        decomposition = decompose_for(method, factor, equations, z, tolerance)
        penalty = np.array(method.penalty(decomposition), dtype=np.float64)
        return SpectralModel(decomposition, penalty)
    p = z.shape[1]
    triangle, residual = fixed.scale_columns(factor[:, :p, :p]), factor[:, :p, p]
    if len(fixed.rows) or not fixed.is_triangular:
        triangle, residual = _append_penalty(triangle, residual, fixed, z)
    u, is_regular = solve_regular(triangle, -residual, tolerance)
    gain = (residual**2).sum(axis=1)
    step = fixed.to_deviation(u)
    return TriangularModel(factor, z, equations, step, gain, is_regular, method, tolerance, fixed)


def _append_penalty(
    triangle: FloatArray, residual: FloatArray, fixed: FixedPenalty, deviation: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the triangular factor (t, p, p) and the residual (t, p) of rows and penalty."""
    t, p = residual.shape
    factor = empty_factor(t, p)
    factor[:, :p, :p], factor[:, :p, p] = triangle, residual
    rows = np.empty((t, len(fixed.rows), p + 1))
    rows[:, :, :p], rows[:, :, p] = fixed.rows, fixed.evaluate(deviation)
    if fixed.is_triangular:
        factor = fold(factor, rows)
    else:
        factor = fold(empty_factor(t, p), np.concatenate([factor[:, :p], rows], axis=1))
    return factor[:, :p, :p], factor[:, :p, p]
