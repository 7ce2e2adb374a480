# SPDX-License-Identifier: Apache-2.0
"""The noise scale, its degrees of freedom, pose uncertainties and the test of a moved machine
against dense scipy code that shares only the measured values with loopcal.
"""

import numpy as np
import pytest
from scipy import stats

from evidence.assumptions.cases import SETUPS, Case
from evidence.assumptions.simulation import simulate_case
from loopcal import load_robot
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.bootstrap import bootstrap
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.recalibration import compare_information, recalibrate
from loopcal.mechanism.solutions import forward
from tests.estimate.dense_delta import TOLERANCE, differentiate, fit_delta, locate_nozzle

SETUP, ROBOT = SETUPS["linear-delta"], load_robot("linear-delta")
PLACES = np.flatnonzero(ROBOT.parameters.free)
FINE, COARSE = SETUP.sigma[0], SETUP.coarse[0]
STATED = 0.5 / 0.25**2
"""Degrees of freedom of a sigma that is known to a quarter (JCGM 100, G.4.2)."""


def measure(case, fits=1):
    """Return the measurements of machines of a case."""
    return simulate_case(SETUP, case, fits)


def fit_densely(data, sigma, penalty=0.0):
    """Fit the measured positions with scipy."""
    return fit_delta(data.readings, data.observations[0].measured, sigma, penalty)


def estimate_noise(dense, is_estimated=False):
    """Return the noise over the stated sigma and its degrees of freedom."""
    Q = np.linalg.qr(dense.A)[0]
    square, dof = float(((dense.data - Q @ (Q.T @ dense.data)) ** 2).sum()), len(dense.b) - 9
    if is_estimated or stats.chi2.sf(square, dof) < 1e-3:
        return np.sqrt(square / dof), dof
    return np.sqrt((STATED + square) / (STATED + dof)), STATED + dof


@pytest.mark.parametrize("noise", ["given", "estimated"])
@pytest.mark.parametrize("case", [Case("", is_few=True), Case("", noise=1.15), Case("", noise=2.0)])
def test_intervals_of_least_squares_are_those_of_students_t(case, noise):
    data = measure(case).measurements[0]
    fit = identify(ROBOT, data, options=FitOptions(method=LeastSquares(), noise=noise))
    dense = fit_densely(data, FINE)
    scale, degrees = estimate_noise(dense, noise == "estimated")
    sd = scale * TOLERANCE * np.sqrt(np.diag(np.linalg.inv(dense.A.T @ dense.A)))
    assert fit.residual_test.sigma_scale == pytest.approx(scale, rel=1e-5)
    np.testing.assert_allclose(fit.standard_deviations, sd, rtol=1e-5)
    np.testing.assert_allclose(fit.interval(), stats.t.ppf(0.975, degrees) * sd, rtol=1e-5)


def test_only_the_part_of_the_variance_that_is_noise_has_its_degrees_of_freedom():
    data = measure(Case("", is_few=True, is_coarse=True)).measurements[0]
    fit = identify(ROBOT, data, MAP())
    dense = fit_densely(data, COARSE, 1.0)
    scale, degrees = estimate_noise(dense)
    inverse = np.linalg.inv(dense.A.T @ dense.A + np.eye(9))
    by_noise = scale**2 * np.diag(inverse @ dense.A.T @ dense.A @ inverse)
    by_tolerances = np.diag(inverse @ inverse)
    total = by_noise + by_tolerances
    # Welch-Satterthwaite: the spreads are known
    effective = degrees * (total / by_noise) ** 2
    half = stats.t.ppf(0.975, effective) * np.sqrt(total) * TOLERANCE
    np.testing.assert_allclose(fit.standard_deviations, TOLERANCE * np.sqrt(total), rtol=1e-4)
    np.testing.assert_allclose(fit.interval(), half, rtol=1e-4)
    assert (by_tolerances > 0.2 * total).any()
    assert (by_tolerances < 0.05 * total).any()


def expand(dense, q, scale, degrees):
    """Return the length (n,) of position errors at readings q that 95 % do not exceed."""
    D = differentiate(dense.estimate, q)[1]
    C = D @ np.linalg.inv(dense.A.T @ dense.A) @ D.swapaxes(1, 2) * scale**2
    trace = np.trace(C, axis1=1, axis2=2)
    h = trace**2 / np.trace(C @ C, axis1=1, axis2=2)
    return np.sqrt(trace * stats.f.ppf(0.95, h, degrees))


@pytest.mark.slow
@pytest.mark.parametrize("noise", [pytest.param("given", marks=pytest.mark.evidence), "estimated"])
def test_expanded_uncertainty_of_poses_and_its_coverage_with_6_degrees_of_freedom(noise):
    fits = 60
    simulation = measure(Case("", is_few=True), fits)
    options = FitOptions(method=LeastSquares(), noise=noise)
    inside = []
    for i, data in enumerate(simulation.measurements):
        dense = fit_densely(data, FINE)
        U = expand(dense, simulation.q, *estimate_noise(dense, noise == "estimated"))
        predicted = locate_nozzle(dense.estimate, simulation.q)
        inside.append(np.linalg.norm(predicted - simulation.position[i], axis=1) <= U)
        if i < 3:
            fit = identify(ROBOT, data, options=options)
            stated = pose_uncertainty(fit, forward(fit.robot, simulation.q), frame="base")
            np.testing.assert_allclose(stated.expanded_position, U, rtol=1e-4)
    # poses of one fit agree with each other: as if each fit were one draw
    assert np.mean(inside) == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / fits))


def test_change_of_a_machine_is_tested_with_the_noise_of_both_calibrations():
    for i, ratio in enumerate((1.0, 2.0)):
        case = Case("", noise=ratio)
        data = measure(case, 2).measurements[i]
        later = measure(Case("", noise=ratio, is_few=False), 2).trials
        rng = np.random.default_rng(i)
        true = locate_nozzle(later.truth[i][PLACES], data.readings)
        observed = true + ratio * FINE * rng.standard_normal(true.shape)
        (rows,) = data.observations
        again = type(data)(
            data.robot_name,
            data.readings,
            (type(rows).from_sigma(rows.kind, rows.rows, observed, np.full(3, FINE)),),
        )
        first = identify(ROBOT, data, LeastSquares())
        change = recalibrate(ROBOT, again, first.posterior)[1]
        fits = [fit_densely(each, FINE) for each in (data, again)]
        noises = [estimate_noise(fit, is_estimated=True) for fit in fits]
        covariances = [np.linalg.inv(fit.A.T @ fit.A) for fit in fits]
        d = (fits[1].estimate - fits[0].estimate) / TOLERANCE
        P = sum(s**2 * C for (s, _), C in zip(noises, covariances, strict=True))
        statistic = d @ np.linalg.solve(P, d)
        assert change.chi_square == pytest.approx(statistic, rel=0.02)
        assert change.degrees == pytest.approx(9.0)
        # what unmoved machines with unknown noise give
        draws = 20_000
        roots = [np.linalg.cholesky(C) for C in covariances]
        moved = sum(
            (rng.standard_normal((draws, 9)) @ root.T for root in roots), np.zeros((draws, 9))
        )
        shown = [rng.chisquare(dof, draws) / dof for _, dof in noises]
        P = sum(s[:, None, None] * C for s, C in zip(shown, covariances, strict=True))
        solved = np.linalg.solve(P, moved[..., None])[..., 0]
        tail = float(((moved * solved).sum(axis=1) >= statistic).mean())
        changes = compare_information(first.posterior, identify(ROBOT, again).posterior)
        assert changes.compute_p_value(float(statistic), 9) == pytest.approx(tail, abs=0.03)
        assert change.moved == (change.p_value < 0.05)


def test_bootstrap_of_poses_agrees_with_dense_resamples():
    data = measure(Case("", degrees=3.0)).measurements[0]
    fit = identify(ROBOT, data, LeastSquares())
    count = 600
    drawn = bootstrap(fit, data, count, scheme="pairs", unit="pose", seed=3)
    dense, n = fit_densely(data, FINE), len(data.readings)
    A, b = dense.A.reshape(n, 3, 9), dense.data.reshape(n, 3)
    rng = np.random.default_rng(4)
    resamples = []
    for _ in range(count):
        kept = rng.integers(n, size=n)
        rows = A[kept].reshape(-1, 9)
        resamples.append(np.linalg.lstsq(rows, b[kept].ravel(), rcond=None)[0])
    ratio = drawn.standard_deviations / (np.std(resamples, axis=0, ddof=1) * TOLERANCE)
    # each of the two standard deviations is known to 1 / sqrt(2 count)
    np.testing.assert_allclose(ratio, 1.0, atol=5.0 / np.sqrt(count))
    assert ratio.mean() == pytest.approx(1.0, abs=2.5 / np.sqrt(count))
