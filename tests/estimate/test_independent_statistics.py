# SPDX-License-Identifier: Apache-2.0
"""Statistics of fits against dense scipy code that shares only the measured values with loopcal."""

import numpy as np
import pytest
from scipy import optimize, stats

from evidence.assumptions.cases import SETUPS, Case
from evidence.assumptions.simulation import simulate_case
from loopcal import load_robot
from loopcal.diagnose.adjusted_uncertainty import adjust_uncertainty
from loopcal.diagnose.residual_patterns import (
    RHO,
    SHARE,
    collect_residual_rows,
    estimate_correlated_errors,
)
from loopcal.diagnose.residual_patterns import test_correlation as measure_correlation
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.tolerance_components import InflatedTolerances
from loopcal.mechanism.solutions import forward
from tests.estimate.dense_delta import NOMINAL, TOLERANCE, fit_delta, locate_nozzle

SETUP, ROBOT = SETUPS["linear-delta"], load_robot("linear-delta")
PLACES = np.flatnonzero(ROBOT.parameters.free)
FINE, COARSE = SETUP.sigma[0], SETUP.coarse[0]


def measure(case, fits=1):
    """Return the simulation of a case with the delta."""
    return simulate_case(SETUP, case, fits)


def fit_densely(data, sigma, penalty=0.0):
    """Fit the measured positions with scipy."""
    return fit_delta(data.readings, data.observations[0].measured, sigma, penalty)


def test_closed_form_of_the_delta_agrees_with_the_forward_kinematics():
    q = measure(Case("clean")).q
    values = ROBOT.values.copy()
    values[PLACES] += TOLERANCE * np.random.default_rng(0).standard_normal(9)
    np.testing.assert_array_equal(ROBOT.values[PLACES], NOMINAL)
    np.testing.assert_allclose(ROBOT.parameters.tolerance[PLACES], TOLERANCE, rtol=1e-12)
    expected = forward(ROBOT.with_values(values), q).T[:, :3, 3]
    np.testing.assert_allclose(locate_nozzle(values[PLACES], q), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("penalty", [0.0, 1.0])
def test_estimate_and_covariance_agree_with_dense_least_squares(penalty):
    data = measure(Case("clean")).measurements[0]
    fit = identify(ROBOT, data, MAP() if penalty else LeastSquares())
    dense = fit_densely(data, FINE, penalty)
    difference = (fit.estimate - dense.estimate) / TOLERANCE
    np.testing.assert_allclose(difference, 0.0, atol=1e-5)
    if not penalty:
        assert fit.chi_square == pytest.approx((dense.b**2).sum(), rel=1e-9)


@pytest.mark.parametrize("tolerance", [1.0, 1.7, 3.0])
def test_most_probable_factor_on_the_tolerances_maximizes_the_density_of_the_data(tolerance):
    for data in measure(Case("", tolerance=tolerance, is_coarse=True), 2).measurements:
        fit = identify(ROBOT, data, MAP(InflatedTolerances(by="global")))
        assert fit.prior_conflict is not None
        factor = fit.prior_conflict.inflation
        dense = fit_densely(data, COARSE, 1.0 / factor**2)
        identity = np.eye(len(dense.b))

        def minus_log_density(log_factor, dense=dense, identity=identity):
            covariance = identity + np.exp(2.0 * log_factor) * dense.A @ dense.A.T
            return -stats.multivariate_normal(cov=covariance).logpdf(dense.data)

        best = optimize.minimize_scalar(
            minus_log_density, bounds=(0.0, 3.0), method="bounded", options={"xatol": 1e-8}
        )
        at_one = minus_log_density(0.0) <= best.fun + 1e-9
        assert factor == pytest.approx(1.0 if at_one else np.exp(best.x), rel=2e-3)


def test_inflated_tolerances_have_the_degrees_of_freedom_of_their_factor():
    """Of the covariance B (A'A + I / factor^2) B the part of the spreads has 1 / (2 spread^2)
    degrees of freedom; the estimate moves by the error of the factor, too.
    """
    case = Case("", tolerance=3.0, is_coarse=True)
    data = measure(case, 1).measurements[0]
    options = FitOptions(method=MAP(InflatedTolerances(by="global")), sigma_uncertainty=0.0)
    fit = identify(ROBOT, data, options=options)
    assert fit.prior_conflict is not None
    factor = fit.prior_conflict.inflation
    assert factor > 1.5
    dense = fit_densely(data, COARSE, 1.0 / factor**2)
    A, identity = dense.A, np.eye(9)
    log_factor = np.linspace(0.0, np.log(30.0 * factor), 400)
    score = [
        stats.multivariate_normal(cov=np.eye(len(A)) + np.exp(2.0 * x) * A @ A.T).logpdf(dense.data)
        for x in log_factor
    ]
    weight = np.exp(np.array(score) - max(score))
    square = (weight * (log_factor - np.log(factor)) ** 2).sum() / weight.sum()
    B = np.linalg.inv(A.T @ A + identity / factor**2)
    by_noise = (B @ A.T) ** 2
    by_tolerances = (B / factor) ** 2
    z = (dense.estimate - NOMINAL) / TOLERANCE
    moved = 2.0 * B @ z / factor**2 * np.sqrt(square)
    variance = by_noise.sum(axis=1) + by_tolerances.sum(axis=1) + moved**2
    degrees = variance**2 / (by_tolerances.sum(axis=1) ** 2 * 2.0 * square)
    np.testing.assert_allclose(fit.standard_deviations, TOLERANCE * np.sqrt(variance), rtol=1e-3)
    np.testing.assert_allclose(fit.degrees, np.maximum(degrees, 0.5 / square), rtol=0.01)


@pytest.mark.parametrize("off", [0.0, 6.0])
def test_prior_predictive_tests_agree_with_draws_from_the_prior(off):
    case = Case("", single=off, is_coarse=True)
    data = measure(case, 2).measurements[1]
    fit = identify(ROBOT, data, MAP())
    dense = fit_densely(data, COARSE, 1.0)
    conflict = fit.prior_conflict
    assert conflict is not None
    draws = 40_000
    rng = np.random.default_rng(1)
    A, p = dense.A, 9
    u, s, vt = np.linalg.svd(A, full_matrices=False)
    c = rng.standard_normal((draws, p)) * np.sqrt(1.0 + s**2)  # what tolerances and noise predict
    c = np.vstack([u.T @ dense.data, c])
    z = (c * s / (1.0 + s**2)) @ vt
    share = np.diag(vt.T @ np.diag(s**2 / (1.0 + s**2)) @ vt)  # of the variance the data explain
    for name, statistic in {
        "all": (z**2).sum(axis=1),
        "direction": np.abs(c / np.sqrt(1.0 + s**2)).max(axis=1),
        "parameter": np.abs(z / np.sqrt(share)).max(axis=1),
    }.items():
        tail = float((statistic[1:] >= statistic[0]).mean())
        error = 4.0 * np.sqrt(tail * (1.0 - tail) / draws) + 1e-4
        test = conflict if name == "all" else getattr(conflict, name)
        # the sum is approximately, the largest of correlated parameters at most as stated
        slack = 0.25 * tail if name == "all" else 0.0
        assert test.p_value >= tail - error - slack, name
        assert name == "parameter" or test.p_value <= tail + error + slack, name
        if name != "all":
            assert test.statistic == pytest.approx(statistic[0], rel=1e-5)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_correlation_of_neighbors_agrees_with_draws_of_independent_errors(correlation):
    data = measure(Case("", correlation=correlation), 3).measurements[2]
    fit = identify(ROBOT, data, LeastSquares())
    dense = fit_densely(data, FINE)
    n = len(data.readings)
    Q = np.linalg.qr(dense.A)[0]

    def correlate(errors):  # (k, 3 n) -> (k,)
        r = errors - errors @ Q @ Q.T
        r = r.reshape(-1, n, 3)
        return (r[:, 1:] * r[:, :-1]).sum(axis=(1, 2)) / (r**2).sum(axis=(1, 2))

    draws = correlate(np.random.default_rng(2).standard_normal((20_000, 3 * n)))
    observed = correlate(dense.b[None])[0]
    rows = collect_residual_rows(linearize_fit(fit, data))
    assert rows is not None
    excess, p_value = measure_correlation(rows)
    tail = float((draws >= observed).mean())
    assert excess == pytest.approx(observed - draws.mean(), abs=5e-3)
    assert p_value == pytest.approx(tail, abs=4.0 * np.sqrt(tail * (1.0 - tail) / 2e4) + 2e-3)
    assert (p_value < 1e-3) == (correlation > 0.0)


def test_covariance_by_correlated_errors_agrees_with_dense_generalized_least_squares():
    data = measure(Case("", correlation=0.6)).measurements[0]
    fit = identify(ROBOT, data, LeastSquares())
    rows = collect_residual_rows(linearize_fit(fit, data))
    assert rows is not None
    errors = estimate_correlated_errors(rows, 8.0)
    dense, n = fit_densely(data, FINE), len(data.readings)
    A, b = dense.A, dense.b
    gain = np.linalg.pinv(A)  # estimate = gain @ errors
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    logs, covariances = [], []
    for rho in RHO:
        for share in SHARE if rho else (1.0,):
            K = np.kron(share * rho**lag + (1.0 - share) * np.eye(n), np.eye(3))
            inverse = np.linalg.inv(K)
            information = A.T @ inverse @ A
            left = b - A @ np.linalg.solve(information, A.T @ inverse @ b)
            total = 8.0 + left @ inverse @ left
            nu = 8.0 + len(b) - 9
            determinants = np.linalg.slogdet(K)[1] + np.linalg.slogdet(information)[1]
            logs.append(-0.5 * (determinants + nu * np.log(total)))
            covariances.append(total / nu * gain @ K @ gain.T)
    weight = np.exp(np.array(logs) - max(logs))
    expected = np.einsum("i,ijk->jk", weight / weight.sum(), np.array(covariances))
    root = rows.root.machine / TOLERANCE[:, None]
    np.testing.assert_allclose(
        root @ errors.covariance @ root.T, expected, rtol=1e-4, atol=1e-6 * np.diag(expected).min()
    )
    # never less than with independent errors, and at least this in every parameter
    adjusted = adjust_uncertainty(fit, data).standard_deviations / TOLERANCE
    assert (adjusted > 0.999 * np.sqrt(np.diag(expected))).all()
