# SPDX-License-Identifier: Apache-2.0
"""Triangular systems are solved to rounding, and the bound of their inverses is one."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from tests.engine.conftest import list_engines_with


@pytest.fixture(scope="module", params=list_engines_with("solve_triangles"), ids=str)
def solve(request) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return the function of an engine that has it."""
    return request.param.solve_triangles


def make_systems(t: int, p: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return triangular matrices (t, p, p) of condition 1e3 or so, and right sides (t, p)."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(t, 3 * p, p)) * np.geomspace(1.0, 1e-3, p)
    return np.array(np.linalg.qr(rows, mode="r")), rng.normal(size=(t, p))


@pytest.mark.parametrize("p", [1, 3, 12, 13, 24, 42])
@pytest.mark.parametrize("t", [1, 5])
def test_systems_are_solved_and_inverses_bounded(solve, t, p):
    triangle, right = make_systems(t, p)
    x, growth = solve(triangle, right)
    # [1] rounding of p products, relative to the sizes of the terms
    terms = (np.abs(triangle) @ np.abs(x)[:, :, None]).max()
    assert_allclose((triangle @ x[:, :, None])[:, :, 0], right, rtol=0, atol=1e-15 * p * terms)
    comparison = -np.abs(triangle)
    comparison[:, range(p), range(p)] *= -1.0
    expected = np.linalg.solve(comparison, np.ones((t, p, 1)))[:, :, 0].max(axis=1)
    assert_allclose(growth, expected, rtol=1e-12)  # [1] all of its terms are positive
    largest = np.linalg.norm(np.linalg.inv(triangle), 2, axis=(1, 2))
    assert (largest <= np.sqrt(p) * growth * (1.0 + 1e-12)).all()


def test_systems_do_not_depend_on_those_beside_them_bit_for_bit(solve):
    triangle, right = make_systems(9, 42)
    together = solve(triangle, right)
    for i in range(9):
        alone = solve(triangle[[i]], right[[i]])
        for mine, ours in zip(alone, together, strict=True):
            assert_array_equal(mine[0], ours[i])


def test_no_systems_and_no_unknowns_have_empty_solutions(solve):
    for t, p in ((0, 3), (2, 0)):
        x, growth = solve(np.zeros((t, p, p)), np.zeros((t, p)))
        assert x.shape == (t, p)
        assert_array_equal(growth, np.zeros(t))
