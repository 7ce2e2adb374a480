# SPDX-License-Identifier: Apache-2.0
"""Errors of the drives at single poses; readings of a hexapod are computed without loopcal."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

import loopcal as lc
from evidence.assumptions.machines import (
    SETUPS,
    Effects,
    draw_repeatability,
    make_backlash,
    measure_machine,
)
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.error_causes import (
    explain_residuals,
    list_drive_effects,
    list_units,
    measure_drive_errors,
)
from loopcal.diagnose.residual_patterns import collect_residual_rows
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.mechanism.solutions import forward
from loopcal.numerics.statistics import EVIDENT

SIGMA = (5e-6, 25e-6)  # [m, rad] of the instrument
ROBOT = lc.load_robot("hexapod-42")
REPEATABILITY, PLAY = draw_repeatability(6e-6), make_backlash(10e-6)


def measure_hexapod(seed, sigma, poses=60, noise=1.0, error=None):
    """Return a measured hexapod of which the drives have errors."""
    setup = replace(SETUPS["hexapod, pose probe"], sigma=sigma, poses=poses)
    return measure_machine(setup, seed, Effects(noise=noise, drives=error))


def find_spectrum(linear):
    """Return the residual rows of a fit, and what errors of single readings change of them."""
    rows = collect_residual_rows(linear)
    assert rows is not None
    drives, *_ = list_drive_effects(linear, rows)
    return rows, drives, rows.remainder.find_spectrum(drives.scaled)


def linearize(data):
    return linearize_fit(identify(ROBOT, data), data)


def find_drive_errors(linear):
    """Return the errors of the drives that a fit shows; None without any."""
    return measure_drive_errors(linear, explain_residuals(linear))


def test_probability_is_uniform_without_errors_of_the_drives() -> None:
    p_values = []
    for seed in range(30):
        *_, spectrum = find_spectrum(linearize(measure_hexapod(seed, SIGMA, 25).data))
        p_values.append(spectrum.compute_tail(np.inf))
    assert kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.parametrize("known", [0.0, 8.0, np.inf])
def test_size_maximizes_the_restricted_likelihood_of_a_dense_covariance(known: float) -> None:
    data = measure_hexapod(3, SIGMA, 12, error=REPEATABILITY).data
    rows, drives, spectrum = find_spectrum(linearize(data))
    Z = drives.scaled
    basis = rows.basis.toarray()
    noise = np.linalg.qr(np.c_[basis, np.eye(len(Z))])[0][:, basis.shape[1] : len(Z)]
    y, A = noise.T @ rows.residual, noise.T @ Z  # what nothing estimated explains

    def compute_likelihood(tau: float) -> float:
        V = np.eye(len(y)) + tau**2 * A @ A.T
        square, count = y @ np.linalg.solve(V, y), len(y) + known
        scale = 1.0 if np.isinf(known) else (square + known) / count
        by_size = square if np.isinf(known) else count * np.log(scale)
        return float(-0.5 * (np.linalg.slogdet(V)[1] + by_size))

    sizes = np.geomspace(0.05, 40.0, 400)
    logs = np.array([compute_likelihood(tau) for tau in sizes]) - compute_likelihood(0.0)
    found = spectrum.estimate(known)
    # steps of the two grids: 1.5 and 4 %
    assert np.sqrt(found.ratio) == pytest.approx(sizes[np.argmax(logs)], rel=0.05)
    grid = np.linspace(np.log(EVIDENT[0]), np.log(EVIDENT[1]), 400)
    mean = np.exp(np.interp(grid, np.log(sizes), logs)).mean()
    assert found.evidence == pytest.approx(np.log(mean), abs=0.05)


def test_errors_of_the_drives_are_found_with_their_size() -> None:
    sizes = []
    for seed in range(8):
        drives = find_drive_errors(
            linearize(measure_hexapod(seed, SIGMA, error=REPEATABILITY).data)
        )
        assert drives is not None
        assert drives.findings[-1].code == "residuals.drive-errors"
        sizes.append(float(drives.sigma.mean()))
    # 8 x 318 degrees of freedom, of which the noise hides half: 10 % allow for three sigmas
    assert np.mean(sizes) == pytest.approx(6e-6, rel=0.15)


def test_backlash_is_named_with_its_size() -> None:
    drives = find_drive_errors(linearize(measure_hexapod(1, SIGMA, error=PLAY).data))
    assert drives is not None
    finding = drives.findings[0]
    assert finding.code == "residuals.backlash"
    assert finding.data["size"].value == pytest.approx(0.01, rel=0.4)  # [mm], of the largest
    assert drives.sigma == pytest.approx(np.full(6, 5e-6), rel=0.5)


def test_errors_of_the_instrument_are_no_errors_of_the_drives() -> None:
    found = [
        find_drive_errors(linearize(measure_hexapod(seed, SIGMA, noise=1.6).data))
        for seed in range(8)
    ]
    # where residuals contradict the stated noise, their most probable cause is named
    assert sum(drives is not None for drives in found) <= 2


def test_uncertainty_of_poses_contains_errors_of_the_drives() -> None:
    covered, old = [], []
    for seed in range(6):
        hexapod = measure_hexapod(seed, SIGMA, error=REPEATABILITY)
        data = hexapod.data
        drives = find_drive_errors(linearize(data))
        assert drives is not None
        sigma = np.broadcast_to(drives.sigma, data.readings.shape)
        fit = drives.add_to(identify(ROBOT, replace(data, reading_sigma=sigma)))
        predicted = forward(fit.robot, hexapod.readings)
        gap = np.linalg.norm(predicted.T[:, :3, 3] - hexapod.positions, axis=1)
        without = replace(fit.posterior, reading_sigma=None)
        covered += list(gap <= pose_uncertainty(fit, predicted, frame="base").expanded_position)
        old += list(gap <= pose_uncertainty(without, predicted, frame="base").expanded_position)
    # 72 poses of 6 machines; without these errors the coverage is 40 %
    assert np.mean(covered) > 0.88
    assert np.mean(old) < 0.6


def test_calibration_and_its_run_folder_state_the_errors_of_the_drives(tmp_path) -> None:
    report = lc.calibrate(ROBOT, measure_hexapod(2, SIGMA, error=REPEATABILITY).data)
    assert "residuals.drive-errors" in {finding.code for finding in report.findings}
    assert report.identification.residual_test.p_value > 1e-3
    lc.save_run(report, tmp_path / "run")
    kept = lc.load_run(tmp_path / "run").load_posterior().repeatability
    assert kept.tolist() == report.identification.posterior.repeatability.tolist()
    assert kept.min() > 3e-6


def test_sensed_joints_and_uncertain_readings_are_not_tested() -> None:
    data = measure_hexapod(2, SIGMA, error=REPEATABILITY).data
    uncertain = replace(data, reading_sigma=np.full(data.readings.shape, 1e-5))
    assert find_drive_errors(linearize(uncertain)) is None
    assert (list_units(linearize(data)) == 1.0).all()  # lengths count in meters
