# SPDX-License-Identifier: Apache-2.0
"""Quadratic forms of a rotation are minimized over the whole rotation group."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from loopcal.geometry import minimize_over_rotations

SEEDS = range(3)


def cost(R, A, b):
    return float(np.sum((A @ R.ravel() - b) ** 2))


def minimize_from_random_rotations(A, b, rng):
    """Return the lowest cost that scipy reaches from 12 random rotations."""

    def evaluate(vector):
        return cost(Rotation.from_rotvec(vector).as_matrix(), A, b)

    starts = Rotation.from_quat(rng.normal(size=(12, 4))).as_rotvec()
    return min(minimize(evaluate, start, tol=1e-14).fun for start in starts)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_lowest_minimum_is_the_one_that_scipy_reaches_from_many_starts(seed):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(12, 9)), rng.normal(size=12)
    lowest = minimize_from_random_rotations(A, b, rng)
    for scale in (1e-3, 1.0, 1e3):
        R = minimize_over_rotations((scale**2 * A.T @ A)[None], (scale**2 * A.T @ b)[None])[0][0]
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert cost(R, A, b) <= lowest * (1.0 + 1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_rotation_of_points_in_a_plane_is_recovered(seed):
    rng = np.random.default_rng(seed)
    truth = Rotation.from_quat(rng.normal(size=4)).as_matrix()
    points = np.column_stack([rng.normal(size=(8, 2)), np.zeros(8)])
    A = np.concatenate([np.kron(np.eye(3), point) for point in points])
    b = (points @ truth.T).ravel()
    R = minimize_over_rotations((A.T @ A)[None], (A.T @ b)[None])[0][0]
    assert np.abs(R - truth).max() < 1e-9
