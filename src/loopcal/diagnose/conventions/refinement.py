# SPDX-License-Identifier: Apache-2.0
"""Refine the misfit of one interpretation by Gauss-Newton steps within the tolerances, or far
beyond them.
"""

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

FAR_AWAY, FIT = 30.0, Halving(steps=12, attempts=5)
"""Factor by which the deviations of a robot far from nominal may exceed its tolerances, and the
steps of its fit.
"""


def refine_misfit(comparison: Comparison) -> tuple[float, FloatArray]:
    """Return the misfit of the first interpretation after Gauss-Newton steps within the tolerances,
    and its nuisance parameters (U,) there.

    The misfit to first order is returned where it is smaller.
    """
    if comparison.linearization is None or not np.isfinite(comparison.misfit):
        return comparison.misfit, comparison.data.nuisance_parameters.values()
    end = _minimize(comparison, 1.0, REFINEMENT)
    values = (
        np.zeros(0) if end.linearization.nuisance is None else end.linearization.nuisance.values[0]
    )
    refined = float(compute_misfit(end.cost, end.linearization.equations)[0])
    return min(comparison.misfit, refined), values


def explains_after_fit(comparison: Comparison, allowed: float) -> bool:
    """Return whether a robot far from nominal explains the first interpretation: whether its misfit
    after a fit with tolerances `FAR_AWAY` times as large is at most `allowed`.
    """
    if comparison.linearization is None or not np.isfinite(comparison.misfit):
        return False
    end = _minimize(comparison, FAR_AWAY, FIT)
    return float(compute_misfit(end.cost, end.linearization.equations)[0]) <= allowed


def _minimize(comparison: Comparison, scale: float, control: Halving) -> _Point:
    """Minimize the cost of the first interpretation with tolerances `scale` times as large."""
    assert comparison.linearization is not None
    first = np.arange(1)
    problem, linearization = comparison.problem.take(first), comparison.linearization.take(first)
    z = linearization.deviation

    def propose(point: _Point) -> _Step:
        p = problem.parameters
        prior = np.concatenate([np.eye(p), point.step.T], axis=1) / scale
        whole = engine.fold(point.linearization.factor, prior[None])[0]
        direction = -np.linalg.solve(whole[:p, :p], whole[:p, p])[None]
        largest = np.abs(point.step + direction).max(initial=0.0)
        share = np.full((1, 1), float(largest <= LARGEST_STEP * scale))
        return _Step(direction, np.sum(whole[:p, p] ** 2, keepdims=True), share)

    def move(point: _Point, step: _Step, share: FloatArray) -> _Point:
        if not share.any():
            return point
        total = point.step + share * step.direction
        return _Point(total, problem.linearize(z + total, point.linearization.next_start), scale)

    end, _ = minimize_by_halving(
        _Point(np.zeros_like(z), linearization, scale), propose, move, control
    )
    return end


@dataclass(frozen=True, eq=False)
class _Point:
    """A step (1, p) from the robot's values in tolerances, the linearization there, and the factor
    by which tolerances are larger.
    """

    step: FloatArray
    linearization: Linearization
    scale: float

    @property
    def cost(self) -> FloatArray:
        return self.linearization.cost + ((self.step / self.scale) ** 2).sum(axis=1)


class _Step(NamedTuple):
    """A full Gauss-Newton step (1, p); see `FullStep`."""

    direction: FloatArray
    change: FloatArray
    share: FloatArray
