# SPDX-License-Identifier: Apache-2.0
"""The triangular factor and its decomposition: identities that hold to rounding."""

import numpy as np
import pytest

from loopcal.engine import fold
from loopcal.numerics.decomposition import decompose, empty_factor

P, M, T = 7, 40, 3


def folded(rows: np.ndarray) -> np.ndarray:
    return fold(empty_factor(len(rows), P), rows)


@pytest.fixture
def rows() -> np.ndarray:
    """Random rows [A | b] of three trials, columns of very different size."""
    rng = np.random.default_rng(3)
    return rng.standard_normal((T, M, P + 1)) * np.array([1.0, 10.0, 1e-2, 1.0, 1.0, 3.0, 1e2, 1.0])


def deficient(rank: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (1, M, P + 1) whose A has this rank, and an orthonormal basis of its null space."""  # noqa: E501
    q, _ = np.linalg.qr(rng.standard_normal((P, P)))
    a = rng.standard_normal((M, rank)) @ q[:, :rank].T
    return np.concatenate([a, rng.standard_normal((M, 1))], axis=1)[None], q[:, rank:]


def counts(t: int = T) -> np.ndarray:
    return np.full(t, M)


def none(d) -> np.ndarray:
    return np.zeros_like(d.singular_values)


def test_folding_in_blocks_of_any_size_gives_the_same_triangle_up_to_signs(rows):
    whole = np.abs(folded(rows))
    for cuts in ([1, 3, 20], [10], list(range(1, M))):
        factor = empty_factor(T, P)
        for block in np.split(rows, cuts, axis=1):
            factor = fold(factor, block)
        np.testing.assert_allclose(np.abs(factor), whole, rtol=0, atol=1e-12 * whole.max())


def test_the_order_of_rows_changes_the_triangle_by_rounding_only(rows):
    shuffled = rows[:, np.random.default_rng(1).permutation(M)]
    a, b = np.abs(folded(rows)), np.abs(folded(shuffled))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * a.max())


def test_a_row_of_weight_zero_equals_no_row(rows):
    zeroed = rows.copy()
    zeroed[:, 5:9] = 0.0
    d = decompose(folded(zeroed), counts() - 4)
    e = decompose(folded(np.delete(rows, slice(5, 9), axis=1)), counts() - 4)
    scale = d.solution(none(d))
    np.testing.assert_allclose(d.deviation(scale), e.deviation(e.solution(none(e))), rtol=1e-12)


def test_the_solution_and_what_it_leaves_equal_those_of_lapack(rows):
    d = decompose(folded(rows), counts())
    z = d.deviation(d.solution(none(d)))
    for i in range(T):
        expected, left, rank, s = np.linalg.lstsq(rows[i, :, :P], rows[i, :, P], rcond=None)
        np.testing.assert_allclose(z[i], expected, rtol=1e-11)  # rounding times a condition of 1e4
        np.testing.assert_allclose(d.remaining(none(d))[i], left[0], rtol=1e-12)
        np.testing.assert_allclose(d.singular_values[i], s, rtol=1e-12)
        assert d.rank[i] == rank == P


def test_trials_stacked_equal_trials_alone_bit_for_bit(rows):
    stacked = decompose(folded(rows), counts())
    for i in range(T):
        alone = decompose(folded(rows[i : i + 1]), counts(1))
        for name in ("singular_values", "directions", "projections", "outside"):
            assert np.array_equal(getattr(stacked, name)[i], getattr(alone, name)[0]), name
        assert np.array_equal(
            stacked.covariance(none(stacked))[i], alone.covariance(none(alone))[0]
        )


def test_rows_read_about_a_deviation_solve_for_the_total_deviation(rows):
    z0 = np.random.default_rng(2).standard_normal((T, P))
    residual = rows.copy()  # predicted - measured at z0, so A (z - z0) = -residual
    d = decompose(folded(residual), counts(), about=z0)
    total = d.deviation(d.solution(none(d)))
    for i in range(T):
        step = np.linalg.lstsq(rows[i, :, :P], -rows[i, :, P], rcond=None)[0]
        np.testing.assert_allclose(total[i], z0[i] + step, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("rank", [P - 1, P - 3])
def test_null_directions_come_out_at_1e_13_and_not_at_1e_7(rank):
    rows, null = deficient(rank, np.random.default_rng(rank))
    d = decompose(folded(rows), counts(1))
    assert d.rank[0] == rank
    assert d.singular_values[0, rank] < 1e-13 * d.singular_values[0, 0]
    assert d.gap[0] > 1e10
    np.testing.assert_allclose(null @ null.T @ d.null_space(), d.null_space(), atol=1e-13)


def test_infinite_variance_falls_on_exactly_the_parameters_of_the_null_directions():
    rows = np.random.default_rng(5).standard_normal((1, M, P + 1))
    rows[..., 2] = 3.0 * rows[..., 4]  # parameters 2 and 4 act as one
    d = decompose(folded(rows), counts(1))
    penalty = np.where(d.used, 0.0, np.inf)
    sd = d.standard_deviations(penalty)[0]
    assert np.flatnonzero(np.isinf(sd)).tolist() == [2, 4]
    covariance = d.covariance(penalty)[0]
    np.testing.assert_array_equal(
        np.sqrt(np.diag(covariance)), np.where(np.isinf(sd), np.inf, np.sqrt(np.diag(covariance)))
    )
    assert np.isnan(covariance[2, [0, 1, 3, 4]]).all()
    known = [0, 1, 3, 5, 6]
    reduced = np.delete(rows[0, :, :P], 2, axis=1)
    expected = np.linalg.pinv(reduced) @ np.linalg.pinv(reduced).T
    keep = [0, 1, 2, 4, 5]
    np.testing.assert_allclose(
        covariance[np.ix_(known, known)], expected[np.ix_(keep, keep)], rtol=1e-11
    )
    np.testing.assert_allclose(sd[known] ** 2, np.diag(covariance)[known], rtol=1e-12)


def test_a_matrix_of_zeros_has_rank_zero_and_infinite_condition():
    d = decompose(empty_factor(1, P), np.zeros(1, dtype=np.int64))
    assert d.rank[0] == 0
    assert np.isinf(d.condition[0])
    assert not d.solution(none(d)).any()


def test_the_scale_of_columns_leaves_the_least_squares_solution_alone(rows):
    scale = np.array([1.0, 5.0, 0.1, 2.0, 1e3, 1.0, 1e-2])
    a, b = decompose(folded(rows), counts()), decompose(folded(rows), counts(), scale=scale)
    # rounding times the condition numbers of 1e4 and 1e6
    np.testing.assert_allclose(
        a.deviation(a.solution(none(a))), b.deviation(b.solution(none(b))), rtol=1e-8
    )
    np.testing.assert_allclose(a.covariance(none(a)), b.covariance(none(b)), rtol=1e-8, atol=1e-12)


def test_taking_and_putting_trials_keeps_each_trial(rows):
    d = decompose(folded(rows), counts())
    some = d.take(np.array([2, 0]))
    back = d.put(np.array([2, 0]), some)
    assert np.array_equal(back.directions, d.directions)
    assert np.array_equal(some.projections[0], d.projections[2])
