# SPDX-License-Identifier: Apache-2.0
"""Refine the misfit of one interpretation by Gauss-Newton steps within the tolerances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal import engine
from loopcal.diagnose.conventions.misfit import Comparison, compute_misfit
from loopcal.estimate.linearization import Linearization
from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.typing import FloatArray

REFINEMENT = Halving(steps=3, attempts=1)
"""Gauss-Newton steps by which the stated convention and the best other one are compared finally; a
step that does not lower the cost ends them.
"""

LARGEST_STEP = 30.0
"""Tolerances that a parameter may leave its value in these steps."""


def refine_misfit(comparison: Comparison) -> tuple[float, FloatArray]:
    """Return the misfit of the first interpretation after Gauss-Newton steps within the tolerances,
    and its nuisance parameters (U,) there.

    The misfit to first order is returned where it is smaller.
    """
    linearization, first = comparison.linearization, np.arange(1)
    if linearization is None or not np.isfinite(comparison.misfit):
        return comparison.misfit, comparison.data.nuisance_parameters.values()
    problem, linearization = comparison.problem.take(first), linearization.take(first)
    z = linearization.deviation

    def propose(point: _Point) -> _Step:
        p = problem.parameters
        prior = np.concatenate([np.eye(p), point.step.T], axis=1)
        whole = engine.fold(point.linearization.factor, prior[None])[0]
        direction = -np.linalg.solve(whole[:p, :p], whole[:p, p])[None]
        largest = np.abs(point.step + direction).max(initial=0.0)
        share = np.full((1, 1), float(largest <= LARGEST_STEP))
        return _Step(direction, np.sum(whole[:p, p] ** 2, keepdims=True), share)

    def move(point: _Point, step: _Step, share: FloatArray) -> _Point:
        if not share.any():
            return point
        total = point.step + share * step.direction
        return _Point(total, problem.linearize(z + total, point.linearization.next_start))

    end, _ = minimize_by_halving(_Point(np.zeros_like(z), linearization), propose, move, REFINEMENT)
    values = (
        np.zeros(0) if end.linearization.nuisance is None else end.linearization.nuisance.values[0]
    )
    refined = float(compute_misfit(end.cost, end.linearization.equations)[0])
    return min(comparison.misfit, refined), values


@dataclass(frozen=True, eq=False)
class _Point:
    """A step (1, p) from the robot's values in tolerances, and the linearization there."""

    step: FloatArray
    linearization: Linearization

    @property
    def cost(self) -> FloatArray:
        return self.linearization.cost + (self.step**2).sum(axis=1)


class _Step(NamedTuple):
    """A full Gauss-Newton step (1, p); see `FullStep`."""

    direction: FloatArray
    change: FloatArray
    share: FloatArray
