# SPDX-License-Identifier: Apache-2.0
"""The triangular factor and its decomposition satisfy their identities to rounding."""

import numpy as np
import pytest

from loopcal.engine import fold
from loopcal.numerics.decomposition import decompose, empty_factor

P, M, T = 7, 40, 3


def fold_rows(rows: np.ndarray) -> np.ndarray:
    return fold(empty_factor(len(rows), P), rows)


@pytest.fixture
def rows() -> np.ndarray:
    """Random rows [A | b] of three trials, columns of very different size."""
    rng = np.random.default_rng(3)
    return rng.standard_normal((T, M, P + 1)) * np.array([1.0, 10.0, 1e-2, 1.0, 1.0, 3.0, 1e2, 1.0])


def make_deficient_rows(rank: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (1, M, P + 1) whose A has this rank, and an orthonormal basis of its null space."""  # noqa: E501
    q, _ = np.linalg.qr(rng.standard_normal((P, P)))
    a = rng.standard_normal((M, rank)) @ q[:, :rank].T
    return np.concatenate([a, rng.standard_normal((M, 1))], axis=1)[None], q[:, rank:]


def row_counts(t: int = T) -> np.ndarray:
    return np.full(t, M)


def no_penalty(d) -> np.ndarray:
    return np.zeros_like(d.singular_values)


def test_triangular_factor_does_not_depend_on_row_order(rows):
    shuffled = rows[:, np.random.default_rng(1).permutation(M)]
    a, b = np.abs(fold_rows(rows)), np.abs(fold_rows(shuffled))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * a.max())


def test_row_of_weight_zero_equals_a_deleted_row(rows):
    zeroed = rows.copy()
    zeroed[:, 5:9] = 0.0
    d = decompose(fold_rows(zeroed), row_counts() - 4)
    e = decompose(fold_rows(np.delete(rows, slice(5, 9), axis=1)), row_counts() - 4)
    scale = d.solution(no_penalty(d))
    np.testing.assert_allclose(
        d.deviation(scale), e.deviation(e.solution(no_penalty(e))), rtol=1e-12
    )


def test_solution_residual_rank_and_singular_values_equal_lapack(rows):
    d = decompose(fold_rows(rows), row_counts())
    z = d.deviation(d.solution(no_penalty(d)))
    for i in range(T):
        expected, left, rank, s = np.linalg.lstsq(rows[i, :, :P], rows[i, :, P], rcond=None)
        np.testing.assert_allclose(z[i], expected, rtol=1e-11)  # rounding times a condition of 1e4
        np.testing.assert_allclose(d.remaining(no_penalty(d))[i], left[0], rtol=1e-12)
        np.testing.assert_allclose(d.singular_values[i], s, rtol=1e-12)
        assert d.rank[i] == rank == P


def test_stacked_trials_equal_single_trials_bit_for_bit(rows):
    stacked = decompose(fold_rows(rows), row_counts())
    for i in range(T):
        alone = decompose(fold_rows(rows[i : i + 1]), row_counts(1))
        for name in ("singular_values", "directions", "projections", "outside"):
            assert np.array_equal(getattr(stacked, name)[i], getattr(alone, name)[0]), name
        assert np.array_equal(
            stacked.covariance(no_penalty(stacked))[i], alone.covariance(no_penalty(alone))[0]
        )


def test_rows_linearized_about_a_deviation_give_the_total_deviation(rows):
    z0 = np.random.default_rng(2).standard_normal((T, P))
    residual = rows.copy()  # predicted - measured at z0, so A (z - z0) = -residual
    d = decompose(fold_rows(residual), row_counts(), about=z0)
    total = d.deviation(d.solution(no_penalty(d)))
    for i in range(T):
        step = np.linalg.lstsq(rows[i, :, :P], -rows[i, :, P], rcond=None)[0]
        np.testing.assert_allclose(total[i], z0[i] + step, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("rank", [P - 1, P - 3])
def test_null_directions_have_singular_values_below_1e_13(rank):
    rows, null = make_deficient_rows(rank, np.random.default_rng(rank))
    d = decompose(fold_rows(rows), row_counts(1))
    assert d.rank[0] == rank
    assert d.singular_values[0, rank] < 1e-13 * d.singular_values[0, 0]
    assert d.gap[0] > 1e10
    np.testing.assert_allclose(null @ null.T @ d.null_space(), d.null_space(), atol=1e-13)


def test_exactly_the_parameters_of_null_directions_have_infinite_variance():
    rows = np.random.default_rng(5).standard_normal((1, M, P + 1))
    rows[..., 2] = 3.0 * rows[..., 4]  # parameters 2 and 4 act as one
    d = decompose(fold_rows(rows), row_counts(1))
    penalty = np.where(d.used, 0.0, np.inf)
    sd = d.standard_deviations(penalty)[0]
    assert np.flatnonzero(np.isinf(sd)).tolist() == [2, 4]
    covariance = d.covariance(penalty)[0]
    assert np.flatnonzero(np.isinf(np.diag(covariance))).tolist() == [2, 4]
    assert np.isnan(covariance[2, [0, 1, 3, 4]]).all()
    known = [0, 1, 3, 5, 6]
    reduced = np.delete(rows[0, :, :P], 2, axis=1)
    expected = np.linalg.pinv(reduced) @ np.linalg.pinv(reduced).T
    keep = [0, 1, 2, 4, 5]
    np.testing.assert_allclose(
        covariance[np.ix_(known, known)], expected[np.ix_(keep, keep)], rtol=1e-11
    )
    np.testing.assert_allclose(sd[known] ** 2, np.diag(covariance)[known], rtol=1e-12)


def test_penalty_whose_square_is_zero_counts_as_none():
    d = decompose(np.zeros((1, P + 1, P + 1)), row_counts(1))
    penalty = np.full((1, P), 2.6e-320)
    assert np.isinf(d.variances(penalty, 1.0, np.ones((1, P)))).all()


def test_zero_matrix_has_rank_zero_and_infinite_condition():
    d = decompose(empty_factor(1, P), np.zeros(1, dtype=np.int64))
    assert d.rank[0] == 0
    assert np.isinf(d.condition[0])
    assert not d.solution(no_penalty(d)).any()


def test_column_scale_does_not_change_the_least_squares_solution(rows):
    scale = np.array([1.0, 5.0, 0.1, 2.0, 1e3, 1.0, 1e-2])
    a, b = (
        decompose(fold_rows(rows), row_counts()),
        decompose(fold_rows(rows), row_counts(), root=np.diag(scale)),
    )
    # rounding times the condition numbers of 1e4 and 1e6
    np.testing.assert_allclose(
        a.deviation(a.solution(no_penalty(a))), b.deviation(b.solution(no_penalty(b))), rtol=1e-8
    )
    np.testing.assert_allclose(
        a.covariance(no_penalty(a)), b.covariance(no_penalty(b)), rtol=1e-8, atol=1e-12
    )


def test_take_and_put_keep_each_trial(rows):
    d = decompose(fold_rows(rows), row_counts())
    some = d.take(np.array([2, 0]))
    back = d.put(np.array([2, 0]), some)
    assert np.array_equal(back.directions, d.directions)
    assert np.array_equal(some.projections[0], d.projections[2])
