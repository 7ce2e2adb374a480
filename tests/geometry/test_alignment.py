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


@pytest.mark.parametrize("worth", [1.5, 4.0, 100.0])
def test_minimum_that_is_returned_alone_is_the_lowest_and_all_others_cost_more(worth):
    rng = np.random.default_rng(5)
    A = rng.normal(size=(100, 12, 9)) * np.linspace(0.2, 1.0, 9)
    truth = Rotation.from_quat(rng.normal(size=(100, 4))).as_matrix()
    b = (A @ truth.reshape(100, 9, 1))[..., 0]
    b += rng.normal(size=b.shape) * np.geomspace(1e-6, 1.0, 100)[:, None]
    forms = np.swapaxes(A, 1, 2) @ A, (np.swapaxes(A, 1, 2) @ b[..., None])[..., 0], 24
    certain, number = minimize_over_rotations(*forms, (b * b).sum(axis=1), worth), [0, 0]
    whole = minimize_over_rotations(*forms)
    for rows, wanted, some, others in zip(A, b, certain, whole, strict=True):
        costs = [cost(R, rows, wanted) for R in others]
        assert cost(some[0], rows, wanted) == pytest.approx(costs[0], rel=1e-6)
        if len(some) < len(costs):
            assert len(some) == 1
            assert costs[1] > worth * costs[0]
        number[len(some) == len(costs)] += len(costs) > 1
    assert min(number) > 5  # forms with several minima of which one, or all, were returned
