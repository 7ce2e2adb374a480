# SPDX-License-Identifier: Apache-2.0
"""Triangular systems are solved to rounding, and what counts as regular certainly is. Triangular
systems agree with LAPACK's routine for triangles, also ill-conditioned ones.
"""

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from loopcal.numerics.decomposition import (
    MARGIN,
    RANK_TOLERANCE,
    ROUNDING,
    solve_regular,
    solve_triangles,
    substitute_backward,
    substitute_transposed,
)

T = 5


def make_triangles(p: int, weakest: float = 1.0, seed: int = 0) -> np.ndarray:
    """Return triangular factors (T, p, p) whose smallest singular value is `weakest` times the
    largest.
    """
    rng = np.random.default_rng(seed)
    u, v = (np.linalg.qr(rng.standard_normal((T, p, p)))[0] for _ in range(2))
    s = np.geomspace(1.0, weakest, p)
    return np.array(np.linalg.qr(u * s @ v, mode="r"))


@pytest.mark.parametrize("p", [1, 3, 12, 13, 24, 42])
def test_back_substitution_in_parts_solves_the_systems(p):
    triangle, right = make_triangles(p, 1e-3), np.random.default_rng(1).standard_normal((T, p))
    x = solve_triangles(triangle, right)
    # [1] rounding of p products, relative to the sizes of the terms
    np.testing.assert_allclose(
        (triangle @ x[:, :, None])[:, :, 0], right, rtol=0, atol=1e-15 * p * np.abs(x).max()
    )


@pytest.mark.parametrize("weakest", [1.0, 1e-3, 1e-6, 1e-9, 1e-10, 3e-11, 1e-11, 1e-12, 1e-15])
@pytest.mark.parametrize("p", [2, 12, 42])
def test_no_matrix_within_the_tolerance_counts_as_regular(p, weakest):
    for seed in range(5):
        triangle = make_triangles(p, weakest, seed)
        _, is_regular = solve_regular(triangle, np.ones((T, p)), RANK_TOLERANCE)
        s = np.linalg.svd(triangle, compute_uv=False)
        assert (s[is_regular, -1] > MARGIN * RANK_TOLERANCE * s[is_regular, 0]).all()
        if weakest >= 1e-9:  # far above the tolerance the second bound always says so
            assert is_regular.all()


def test_no_matrix_is_regular_by_rounding_alone():
    _, is_regular = solve_regular(make_triangles(6, 0.5 * ROUNDING), np.ones((T, 6)), 1e-300)
    assert not is_regular.any()


def test_matrices_that_are_singular_or_not_finite_do_not_disturb_others():
    triangle, right = make_triangles(14, 1e-2), np.random.default_rng(2).standard_normal((T, 14))
    x, _ = solve_regular(triangle, right, RANK_TOLERANCE)
    damaged, other = triangle.copy(), right.copy()
    damaged[0, 3, 3] = 0.0
    damaged[1, 2, 5] = np.nan
    other[2, 1] = np.inf
    mixed, is_regular = solve_regular(damaged, other, RANK_TOLERANCE)
    assert is_regular.tolist() == [False, False, False, True, True]
    assert np.array_equal(mixed[3:], x[3:])
    assert not mixed[:3].any()


def test_systems_do_not_depend_on_those_beside_them_bit_for_bit():
    triangle, right = make_triangles(42, 1e-8), np.random.default_rng(3).standard_normal((T, 42))
    together, is_regular = solve_regular(triangle, right, RANK_TOLERANCE)
    assert is_regular.all()
    for i in range(T):
        alone, _ = solve_regular(triangle[i : i + 1], right[i : i + 1], RANK_TOLERANCE)
        assert np.array_equal(alone[0], together[i])


@pytest.mark.parametrize("p", [9, 42])
def test_a_system_beside_an_unusable_one_has_the_bits_and_the_verdict_of_one_alone(p):
    rng = np.random.default_rng(4)
    for seed in range(20):
        factor = np.zeros((T, p + 1, p + 1))  # of which the triangles are views
        factor[:, :p, :p] = make_triangles(p, 0.9 * MARGIN * RANK_TOLERANCE, seed)
        right, damaged = rng.standard_normal((T, p)), factor.copy()
        damaged[0, 0, 0] = 0.0
        whole = solve_regular(damaged[:, :p, :p], right, RANK_TOLERANCE)
        for i in range(T):
            alone = solve_regular(damaged[i : i + 1, :p, :p], right[i : i + 1], RANK_TOLERANCE)
            for mine, ours in zip(alone, whole, strict=True):
                assert np.array_equal(mine[0], ours[i])


SYSTEMS = ((substitute_backward, 0), (substitute_transposed, 1))


@pytest.fixture(params=[1.0, 1e-4, 1e-9])
def system(request):
    """A triangle whose diagonal falls by the factor from its first to its last entry."""
    rng = np.random.default_rng(5)
    R = np.linalg.qr(rng.normal(size=(60, 40)), mode="r")
    return R * np.geomspace(1.0, request.param, 40)[:, None], rng.normal(size=(40, 7))


@pytest.mark.parametrize(("substitute", "trans"), SYSTEMS)
def test_the_solution_is_that_of_lapack(system, substitute, trans) -> None:
    R, b = system
    expected = solve_triangular(R, b, trans=trans)
    error = np.abs(substitute(R, b) - expected).max(axis=0)
    assert (error <= 1e-12 * np.abs(expected).max(axis=0)).all()  # 40 rounded sums, condition 50


@pytest.mark.parametrize("substitute", [substitute for substitute, _ in SYSTEMS])
def test_a_zero_on_the_diagonal_is_refused(substitute) -> None:
    R = np.triu(np.ones((3, 3)))
    R[1, 1] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        substitute(R, np.ones((3, 1)))


def test_a_large_triangle_is_solved_by_parts(monkeypatch):
    """No part that is factorized has more unknowns than a leaf, and a zero is refused."""
    rng = np.random.default_rng(0)
    R = np.triu(rng.standard_normal((300, 300))) + 20.0 * np.eye(300)
    b = rng.standard_normal((300, 4))
    sizes, solve = [], np.linalg.solve
    monkeypatch.setattr(np.linalg, "solve", lambda a, c: (sizes.append(len(a)), solve(a, c))[1])
    for right in (b, b[:, 0]):
        np.testing.assert_allclose(R @ substitute_backward(R, right), right, atol=1e-12)
        np.testing.assert_allclose(R.T @ substitute_transposed(R, right), right, atol=1e-12)
    assert max(sizes) <= 64
    R[280, 280] = 0.0
    with pytest.raises(np.linalg.LinAlgError):
        substitute_backward(R, b)
