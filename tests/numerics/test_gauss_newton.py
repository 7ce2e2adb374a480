# SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton with halved steps along a curved valley."""

from dataclasses import dataclass

import numpy as np
import pytest

from loopcal.numerics.gauss_newton import Halving, minimize_by_halving
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class Point:
    """Places (t, 2) in the valley y = x^2 with the minimum (1, 1)."""

    at: FloatArray
    steepness: float

    @property
    def residuals(self) -> FloatArray:
        x, y = self.at.T
        return np.stack([self.steepness * (y - x**2), 1.0 - x], axis=1)

    @property
    def cost(self) -> FloatArray:
        return (self.residuals**2).sum(axis=1)


@dataclass(frozen=True, eq=False)
class Step:
    """Full steps (t, 2) and the squared change of the residuals that they promise."""

    by: FloatArray
    change: FloatArray
    share: FloatArray


@pytest.mark.parametrize("steepness", [10.0, 100.0])
def test_a_curved_valley_takes_two_trials_a_step(steepness):
    tried = []

    def propose(point: Point) -> Step:
        x, jacobian = point.at[:, 0], np.zeros((len(point.at), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0] = -2 * steepness * x, steepness, -1
        by = -np.matmul(np.linalg.inv(jacobian), point.residuals[..., None])[..., 0]
        tried.append(0)
        return Step(by, point.cost, np.ones((len(x), 1)))  # two residuals, two unknowns

    def move(point: Point, step: Step, share: FloatArray) -> Point:
        tried[-1] += 1
        return Point(point.at + share * step.by, steepness)

    starts = Point(np.array([[-1.2, 1.44], [-3.0, 9.0], [1.0, 1.0]]), steepness)
    found, converged = minimize_by_halving(
        starts, propose, move, Halving(steps=5000, attempts=30, relative=0.0, absolute=1e-9)
    )
    assert converged.all()
    np.testing.assert_allclose(found.at, 1.0, atol=1e-8)
    assert np.mean(tried[1:]) < 2.5
