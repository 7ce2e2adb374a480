# SPDX-License-Identifier: Apache-2.0
"""Least squares from several starts at once, for problems whose good start is not known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.numerics.damping import FixedFactors
from loopcal.numerics.gauss_newton import DescentStatus, minimize
from loopcal.numerics.trial_batch import TrialBatch
from loopcal.typing import BoolArray, FloatArray, IntArray

STEPS = 60
"""Steps of damped Gauss-Newton [1]; starts in the right basin need fewer than ten."""

FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e4
"""Damping of the first step [1], in columns of length one, and that at which a descent ends."""

NEGLIGIBLE_STEP = 1e-6
"""Step, in standard deviations or as a share of the residuals, that is as good as none."""

SMALLEST = 1e-12
"""Singular value of columns of length one that counts as zero."""

Linearize = Callable[[FloatArray, IntArray], tuple[FloatArray, FloatArray]]
"""From values (c, u) of starts, whose numbers are (c,), to residuals (c, M), in units of their
standard deviation or of order one, and their Jacobians (c, M, u)."""


def minimize_from_starts(
    linearize: Linearize, x: FloatArray, steps: int = STEPS
) -> tuple[FloatArray, FloatArray]:
    """Minimize sums of squares from several starts at once, by damped Gauss-Newton.

    Parameters
    ----------
    linearize : see `Linearize`. x : (c, u) starts. steps : at most.

    Returns
    -------
    x : (c, u). cost : (c,) sums of squares; infinite where a start cannot be evaluated.
    """
    residual, jacobian = linearize(x, np.arange(len(x)))
    start = _Point(x, residual, jacobian, sum_squares(residual))
    damping = FixedFactors(np.full(len(x), FIRST_DAMPING))
    point = minimize(_Descent(linearize), start, damping, steps).point
    return point.x, point.cost


def sum_squares(residual: FloatArray) -> FloatArray:
    """Return sums of squares (c,) of residuals (c, M); infinite where they are not finite."""
    total = np.sum(residual * residual, axis=1)
    return np.where(np.isfinite(total), total, np.inf)


@dataclass(frozen=True, eq=False)
class _Point(TrialBatch):
    """Values x (c, u), residuals (c, M), Jacobians (c, M, u), sums of squares (c,)."""

    x: FloatArray
    residual: FloatArray
    jacobian: FloatArray
    cost: FloatArray


@dataclass(frozen=True, eq=False)
class _Step(TrialBatch):
    """A damped step (c, u), its length (c,) in the residuals, and its damping (c,)."""

    x: FloatArray
    length: FloatArray
    damping: FloatArray


class _Descent(NamedTuple):
    """The rules of the descent for `loopcal.numerics.gauss_newton.minimize`."""

    linearize: Linearize

    def propose(self, point: _Point, damping: FloatArray) -> _Step:
        """Return the damped steps, from a decomposition of columns of length one."""
        norm = np.linalg.norm(point.jacobian, axis=1)
        scale = np.where(norm > 0.0, norm, 1.0)
        # one triangular factor, so that the decomposition does not grow with the rows
        columns = point.jacobian / scale[:, None, :]
        stack = np.nan_to_num(np.concatenate([columns, point.residual[..., None]], axis=-1))
        R = np.asarray(np.linalg.qr(stack, mode="r"), dtype=float)
        U, s, V = np.linalg.svd(R[..., :-1], full_matrices=False)
        right = np.einsum("cmk,cm->ck", U, R[..., -1])
        total = s * s + damping[:, None] ** 2 + SMALLEST**2
        gain = np.where(s > SMALLEST, s / total, 0.0)
        step = np.where(norm > 0.0, -np.einsum("cku,ck->cu", V, gain * right) / scale, 0.0)
        return _Step(step, np.linalg.norm(step * scale, axis=1), damping)

    def is_negligible(self, point: _Point, step: _Step) -> BoolArray:
        """Return no step: all are evaluated."""
        del point
        return np.zeros(len(step.x), dtype=bool)

    def finish(self, point: _Point, step: _Step, trials: IntArray) -> _Point:
        """Return the points as they are."""
        del step, trials
        return point

    def evaluate(self, point: _Point, step: _Step, trials: IntArray) -> _Point:
        """Return the points to which steps lead."""
        x = point.x + step.x
        residual, jacobian = self.linearize(x, trials)
        return _Point(x, residual, jacobian, sum_squares(residual))

    def judge(self, point: _Point, step: _Step, candidate: _Point) -> tuple[BoolArray, FloatArray]:
        """Accept every decrease."""
        del step
        return candidate.cost < point.cost, np.ones(len(point.cost))

    def objective(self, point: _Point) -> FloatArray:
        """Return the sum of squares."""
        return point.cost

    def ending(
        self, point: _Point, step: _Step, candidate: _Point, accepted: BoolArray
    ) -> IntArray:
        """End where a step moves the residuals by a millionth of their sigma, or of themselves."""
        del point, accepted
        is_small = step.length <= NEGLIGIBLE_STEP * (1.0 + np.sqrt(candidate.cost))
        stuck = np.where(
            step.damping > LARGEST_DAMPING, DescentStatus.NO_DESCENT, DescentStatus.RUNNING
        )
        return np.where(is_small, DescentStatus.CONVERGED, stuck)
