# SPDX-License-Identifier: Apache-2.0
"""Methods as filter factors on one decomposition: identities to 1e-12, and rules that choose
lambda or the rank.
"""

import numpy as np
import pytest

from loopcal.errors import DataError, EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import (
    GCV,
    MAP,
    LeastSquares,
    MarginalLikelihood,
    Ridge,
    TruncatedSVD,
    TruncationGCV,
)
from loopcal.numerics.decomposition import decompose
from tests.estimate.problems import fold_rows, hexapod, hexapod_data

P, M, T = 6, 50, 4


@pytest.fixture
def rows() -> np.ndarray:
    return np.random.default_rng(11).standard_normal((T, M, P + 1)) * np.array(
        [3.0, 1.0, 0.3, 1.0, 0.1, 1.0, 1.0]
    )


def estimate(rows: np.ndarray, method) -> np.ndarray:
    """Deviation (t, p) that the method finds for linear rows [A | b]."""
    d = decompose(
        fold_rows(rows),
        np.full(len(rows), rows.shape[1]),
        root=method.root(P),
        unpenalized=method.unpenalized(P),
    )
    return d.deviation(d.solution(method.penalty(d)))


def solve_with_penalty_rows(rows: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Solve the least-squares problem with the penalty written as extra rows."""
    return np.stack(
        [
            np.linalg.lstsq(
                np.vstack([r[:, :P], np.diag(np.sqrt(weights))]),
                np.append(r[:, P], np.zeros(P)),
                rcond=None,
            )[0]
            for r in rows
        ]
    )


def test_ridge_equals_least_squares_with_penalty_rows(rows):
    np.testing.assert_allclose(
        estimate(rows, Ridge(2.5)), solve_with_penalty_rows(rows, np.full(P, 2.5)), rtol=1e-12
    )


def test_ridge_with_lambda_per_parameter_equals_penalty_rows(rows):
    lam = np.array([1.0, 0.1, 20.0, 3.0, 1e-3, 5.0])
    np.testing.assert_allclose(
        estimate(rows, Ridge(tuple(lam))), solve_with_penalty_rows(rows, lam), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("lam", "expected"),
    [
        ({"*": 0.01, "*.length": 1.0}, [0.01, 1.0, 0.01, 1.0]),
        ({"*.length": 1.0, "*": 0.01}, [0.01, 1.0, 0.01, 1.0]),  # in any order
        ({"leg1.*": 2.0, "leg2.length": 3.0}, [2.0, 2.0, 0.0, 3.0]),
        ({"leg[12].length": 4.0, "leg?.length": 5.0}, [0.0, 5.0, 0.0, 5.0]),  # the last of equals
    ],
)
def test_lambda_by_pattern_is_that_of_the_most_exact_pattern_and_zero_without_one(lam, expected):
    names = ["leg1.base.x", "leg1.length", "leg2.base.x", "leg2.length"]
    assert Ridge(lam).resolve(names) == Ridge(tuple(expected))
    with pytest.raises(DataError, match=r"no parameter has the name 'leg3\.\*'"):
        Ridge({**lam, "leg3.*": 1.0}).resolve(names)
    with pytest.raises(EstimationError, match="a finite number >= 0"):
        Ridge({**lam, "*": -1.0})
    with pytest.raises(EstimationError, match=r"Call resolve\(names\)"):
        Ridge(lam).required_equations(4)


def test_a_fit_with_lambda_by_pattern_equals_one_with_a_vector_and_keeps_its_options():
    robot, data = hexapod(), hexapod_data(12)
    named = FitOptions(Ridge({"*.length": 10.0, "*": 0.1}))
    lam = [10.0 if name.endswith(".length") else 0.1 for name in robot.parameters.names]
    by_name = identify(robot, data, options=FitOptions.from_dict(named.to_dict()))
    by_array = identify(robot, data, Ridge(tuple(np.array(lam).tolist())))
    assert np.array_equal(by_name.estimate, by_array.estimate)
    assert by_name.options.method == by_array.options.method == Ridge(tuple(lam))
    alike = identify(robot, data, Ridge(0.1))
    assert np.abs(by_name.estimate - alike.estimate).max() > 1e-6  # [m]


def test_parameter_with_lambda_zero_is_unpenalized(rows):
    lam = np.array([1.0, 0.0, 20.0, 3.0, 0.0, 5.0])
    method = Ridge(tuple(lam))
    d = decompose(
        fold_rows(rows), np.full(T, M), root=method.root(P), unpenalized=method.unpenalized(P)
    )
    penalty = method.penalty(d)
    np.testing.assert_allclose(
        d.deviation(d.solution(penalty)), solve_with_penalty_rows(rows, lam), rtol=1e-12
    )
    for r, c in zip(rows, d.covariance(penalty), strict=True):
        np.testing.assert_allclose(
            c @ (r[:, :P].T @ r[:, :P] + np.diag(lam)), np.eye(P), atol=1e-12
        )
    assert method.required_equations(P) == 2
    # all alike: the plain method
    assert np.array_equal(estimate(rows, Ridge((0.0,) * P)), estimate(rows, LeastSquares()))
    plain = decompose(fold_rows(rows), np.full(T, M))
    np.testing.assert_allclose(
        decompose(fold_rows(rows), np.full(T, M), unpenalized=method.unpenalized(P))
        .plain()
        .singular_values,
        plain.singular_values,
        rtol=1e-12,
    )


def test_unobservable_unpenalized_parameters_have_infinite_uncertainty(rows):
    rows = rows.copy()
    rows[:, :, 4] = rows[:, :, 1]
    flat = np.array([False, True, False, False, True, False])
    d = decompose(fold_rows(rows), np.full(T, M), unpenalized=flat)
    assert d.unpenalized is not None
    penalty = np.where(d.unpenalized, np.where(d.used, 0.0, np.inf), 1.0)
    sd = d.standard_deviations(penalty)
    assert np.isinf(sd[:, flat]).all()
    assert np.isfinite(sd[:, ~flat]).all()
    np.testing.assert_allclose(
        d.deviation(d.solution(penalty)), solve_with_penalty_rows(rows, 1.0 - flat), rtol=1e-10
    )
    V, variance, seen = d.knowledge(penalty)
    np.testing.assert_allclose(V.T @ V, np.eye(P), atol=1e-12)
    assert np.isinf(variance).sum() == 1
    assert seen.sum() == 5
    known = np.isfinite(variance)
    finite = (V[:, known] * variance[known]) @ V[:, known].T
    np.testing.assert_allclose(np.diag(finite)[~flat], sd[0, ~flat] ** 2, rtol=1e-10)


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_iterated_ridge_has_the_filter_of_the_formula(rows, steps):
    lam = 3.0
    A, b = rows[0, :, :P], rows[0, :, P]
    z = np.zeros(P)
    for _ in range(steps):
        z = z + np.linalg.solve(A.T @ A + lam * np.eye(P), A.T @ (b - A @ z))
    d = decompose(fold_rows(rows[:1]), np.array([M]))
    f = 1.0 - (lam / (d.singular_values**2 + lam)) ** steps
    np.testing.assert_allclose(
        z, d.deviation(f * d.projections / d.singular_values)[0], rtol=1e-12, atol=1e-14
    )


def test_map_on_scaled_columns_equals_ridge_with_inverse_squares(rows):
    spread = np.array([0.5, 2.0, 1.0, 3.0, 0.1, 1.0])
    scaled = rows.copy()
    scaled[:, :, :P] *= spread
    lam = tuple(1.0 / spread**2)
    np.testing.assert_allclose(
        spread * estimate(scaled, MAP()), estimate(rows, Ridge(lam)), rtol=1e-12
    )


def test_map_equals_ridge_with_lambda_one(rows):
    np.testing.assert_allclose(estimate(rows, MAP()), estimate(rows, Ridge(1.0)), rtol=1e-15)


def test_full_truncation_and_ridge_zero_equal_least_squares(rows):
    expected = estimate(rows, LeastSquares())
    np.testing.assert_array_equal(estimate(rows, TruncatedSVD(P)), expected)
    np.testing.assert_allclose(estimate(rows, Ridge(0.0)), expected, rtol=1e-15)


def test_truncation_projects_the_least_squares_solution_onto_the_strongest_directions(rows):
    d = decompose(fold_rows(rows), np.full(T, M))
    strongest = d.directions[:, :, :3]
    expected = strongest @ (strongest.swapaxes(-1, -2) @ estimate(rows, LeastSquares())[:, :, None])
    np.testing.assert_allclose(estimate(rows, TruncatedSVD(3)), expected[:, :, 0], rtol=1e-12)


def test_filter_factors_equal_their_formulas(rows):
    d = decompose(fold_rows(rows), np.full(T, M))
    s2 = d.singular_values**2
    np.testing.assert_allclose(d.filter_factors(Ridge(0.7).penalty(d)), s2 / (s2 + 0.7), rtol=1e-15)
    np.testing.assert_array_equal(
        d.filter_factors(TruncatedSVD(2).penalty(d)), np.arange(P) < np.array([2] * T)[:, None]
    )
    np.testing.assert_array_equal(d.filter_factors(LeastSquares().penalty(d)), np.ones((T, P)))


def test_posterior_covariance_of_map_is_the_inverse_information(rows):
    d = decompose(fold_rows(rows), np.full(T, M))
    covariance = d.covariance(MAP().penalty(d))
    for r, c in zip(rows, covariance, strict=True):
        np.testing.assert_allclose(c @ (r[:, :P].T @ r[:, :P] + np.eye(P)), np.eye(P), atol=1e-12)


def test_elimination_by_projection_equals_the_joint_solution(rows):
    joint = estimate(rows, LeastSquares())[:, :4]
    local, rest = rows[:, :, 4:P], np.concatenate([rows[:, :, :4], rows[:, :, P:]], axis=2)
    q = np.linalg.qr(local).Q
    projected = rest - q @ (q.swapaxes(-1, -2) @ rest)
    d = decompose(fold_rows(projected), np.full(T, M - 2))
    np.testing.assert_allclose(d.deviation(d.solution(np.zeros((T, 4)))), joint, rtol=1e-12)


def test_gcv_lambda_minimizes_the_criterion(rows):
    rows = rows.copy()
    rows[:, :, P] += rows[:, :, :P] @ np.full(
        P, 0.3
    )  # a signal, so that the minimum is in the interior
    d = decompose(fold_rows(rows), np.full(T, M))

    def criterion(lam):
        penalty = np.broadcast_to(lam[:, None], (T, P))
        return d.remaining(penalty) / (M - d.filter_factors(penalty).sum(axis=1)) ** 2

    lam = GCV()(d)
    for factor in (0.8, 1.25):
        assert np.all(criterion(lam) <= criterion(lam * factor) * (1 + 1e-9))


def test_marginal_likelihood_recovers_the_prior_variance():
    rng = np.random.default_rng(8)
    a = rng.standard_normal((1, 4000, 400))
    b = a @ (0.05 * rng.standard_normal((400, 1))) + rng.standard_normal((1, 4000, 1))
    d = decompose(fold_rows(np.concatenate([a, b], axis=2)), np.array([4000]))
    # lam = 1 / 0.05^2 = 400; its standard error from 400 unknowns is about 400 sqrt(2 / 400) = 28
    assert MarginalLikelihood()(d)[0] == pytest.approx(400.0, abs=4 * 28)


def test_rules_choose_for_each_trial_separately(rows):
    together = estimate(rows, Ridge(GCV()))
    alone = np.concatenate([estimate(rows[i : i + 1], Ridge(GCV())) for i in range(T)])
    np.testing.assert_array_equal(together, alone)
    assert estimate(rows, TruncatedSVD(TruncationGCV())).shape == (T, P)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Ridge(-1.0), "finite number >= 0"),
        (lambda: Ridge((1.0, -1.0)), "finite number >= 0"),
        (lambda: MAP(0.0), "finite factor above 0"),
        (lambda: Ridge(float("nan")), "finite number >= 0"),
        (lambda: TruncatedSVD(-1), "integer >= 0"),
        (lambda: Ridge((1.0, 2.0)).root(3), "2 values of lam for 3"),
    ],
)
def test_invalid_method_settings_are_refused(make, words):
    with pytest.raises(EstimationError, match=words):
        make()


def test_a_fit_with_one_lambda_per_parameter_says_so():
    fit = identify(hexapod(), hexapod_data(15), Ridge({"*": 0.01, "*.length": 1.0}))
    assert fit.regularization is not None
    assert "lam = up to 1 " in str(fit.regularization.finding)
    assert "given for each parameter" in str(fit.regularization.finding)
