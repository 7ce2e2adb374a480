# SPDX-License-Identifier: Apache-2.0
"""Errors of the drives at single poses; readings of a hexapod are computed without loopcal."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

import loopcal as lc
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.diagnose.drive_errors import (
    differentiate_by_readings,
    estimate_size,
    find_drive_errors,
    list_units,
    test_independent_errors,
)
from loopcal.diagnose.residual_patterns import collect_residual_rows
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.observations import Observations
from loopcal.mechanism.solutions import forward

test_independent_errors.__test__ = False  # type: ignore[attr-defined] - no test of pytest
ROBOT = lc.load_robot("hexapod-42")
SIGMA = np.array([25e-6] * 3 + [5e-6] * 3)  # [rad, m] of the instrument
PLACES = [
    np.array([[ROBOT.parameters.index(f"leg{i}.{end}.{a}") for a in "xyz"] for i in range(1, 7)])
    for end in ("base", "platform")
]
LENGTHS = np.array([ROBOT.parameters.index(f"leg{i}.length") for i in range(1, 7)])


def simulate(seed: int, error, n: int = 60, sigma=SIGMA):
    """Return n measured poses of a drawn machine, and 12 poses (readings, positions) that are not
    measured; error(q, rng) are errors of the readings [m].
    """
    rng = np.random.default_rng([31, seed])
    table, workspace = ROBOT.parameters, ROBOT.assembly.workspace
    truth = table.nominal + np.asarray(table.tolerance) * rng.standard_normal(len(table))
    low, high = np.array([workspace[c] for c in ("x", "y", "z", "roll", "pitch", "yaw")]).T
    x = rng.uniform(low, high, (n + 12, 6))
    R = Rotation.from_euler("xyz", x[:, 3:])
    base, platform = (truth[places] for places in PLACES)
    legs = x[:, None, :3] + np.einsum("nij,kj->nki", R.as_matrix(), platform) - base
    q = np.linalg.norm(legs, axis=2) - truth[LENGTHS]
    q = q - error(q, rng)
    noise = rng.standard_normal((n, 6)) * sigma
    turned = (Rotation.from_rotvec(noise[:, :3]) * R[:n]).as_rotvec()
    measured = np.hstack([turned, x[:n, :3] + noise[:, 3:]])
    kind = Pose().with_tool(ROBOT.tool)
    rows = Observations.from_sigma(kind, np.arange(n), measured, SIGMA)
    labels = tuple(str(i + 1) for i in range(n))
    data = lc.Measurements(ROBOT.name, q[:n], (rows,), labels=labels)
    return data, q[n:], x[n:, :3]


def no_error(q, _):
    return np.zeros_like(q)


def drift_of_drives(q, rng):
    return 6e-6 * rng.standard_normal(q.shape)


def play(q, rng):
    """Half of a backlash of 10 um, in the direction of travel."""
    return 5e-6 * np.sign(np.diff(np.vstack([q[0] - rng.standard_normal(6), q]), axis=0))


def linearize(data):
    return linearize_fit(identify(ROBOT, data), data)


def test_probability_is_uniform_without_errors_of_the_drives() -> None:
    p_values = []
    for seed in range(60):
        linear = linearize(simulate(seed, no_error, 25)[0])
        rows = collect_residual_rows(linear)
        columns = differentiate_by_readings(linear, rows)
        p_values.append(test_independent_errors(rows, columns, np.inf))
    assert kstest(p_values, "uniform").pvalue > 0.01


@pytest.mark.parametrize("known", [0.0, 8.0, np.inf])
def test_size_maximizes_the_restricted_likelihood_of_a_dense_covariance(known: float) -> None:
    linear = linearize(simulate(3, drift_of_drives, 12)[0])
    rows = collect_residual_rows(linear)
    columns = differentiate_by_readings(linear, rows)
    n, a = columns.count, 6
    Z = np.zeros((len(rows.residual), n * a))
    for i, pose in enumerate(columns.poses[:, 0]):
        Z[i, pose * a : pose * a + a] = columns.values[i, 0]
    noise = np.linalg.qr(np.c_[rows.basis, np.eye(len(Z))])[0][:, rows.basis.shape[1] : len(Z)]
    y, A = noise.T @ rows.residual, noise.T @ Z  # what nothing estimated explains

    def compute_likelihood(tau: float) -> tuple[float, float]:
        V = np.eye(len(y)) + tau**2 * A @ A.T
        square, count = y @ np.linalg.solve(V, y), len(y) + known
        scale = 1.0 if np.isinf(known) else (square + known) / count
        by_size = square if np.isinf(known) else count * np.log(scale)
        return -0.5 * (np.linalg.slogdet(V)[1] + by_size), tau * np.sqrt(scale)

    sizes = np.geomspace(1e-7, 1e-4, 400)
    likelihoods, scaled = np.array([compute_likelihood(tau) for tau in sizes]).T
    expected = scaled[np.argmax(likelihoods)]
    assert estimate_size(rows, columns, known) == pytest.approx(expected, rel=0.13)  # of the grid


def test_errors_of_the_drives_are_found_with_their_size() -> None:
    sizes = []
    for seed in range(8):
        drives = find_drive_errors(linearize(simulate(seed, drift_of_drives)[0]))
        assert drives is not None
        assert drives.findings[-1].code == "residuals.drive-errors"
        sizes.append(float(drives.sigma.mean()))
    # 8 x 318 degrees of freedom, of which the noise hides half: 10 % allow for three sigmas
    assert np.mean(sizes) == pytest.approx(6e-6, rel=0.15)


def test_backlash_is_named_with_its_size() -> None:
    drives = find_drive_errors(linearize(simulate(1, play)[0]))
    assert drives is not None
    finding = drives.findings[0]
    assert finding.code == "residuals.backlash"
    assert finding.data["size"].value == pytest.approx(0.01, rel=0.4)  # [mm], of the largest
    assert drives.sigma == pytest.approx(np.full(6, 5e-6), rel=0.5)


def test_errors_of_the_instrument_are_no_errors_of_the_drives() -> None:
    wrong = SIGMA * 1.6  # the stated noise is too small
    found = [
        find_drive_errors(linearize(simulate(seed, no_error, sigma=wrong)[0])) for seed in range(15)
    ]
    # the test has a level of 10 % where residuals contradict the stated noise
    assert sum(drives is not None for drives in found) <= 5


def test_uncertainty_of_poses_contains_errors_of_the_drives() -> None:
    covered, old = [], []
    for seed in range(10):
        data, q, true = simulate(seed, drift_of_drives)
        drives = find_drive_errors(linearize(data))
        assert drives is not None
        sigma = np.broadcast_to(drives.sigma, data.readings.shape)
        fit = drives.add_to(identify(ROBOT, replace(data, reading_sigma=sigma)))
        predicted = forward(fit.robot, q)
        gap = np.linalg.norm(predicted.T[:, :3, 3] - true, axis=1)
        without = replace(fit.posterior, reading_sigma=None)
        covered += list(gap <= pose_uncertainty(fit, predicted, frame="base").expanded_position)
        old += list(gap <= pose_uncertainty(without, predicted, frame="base").expanded_position)
    # 120 poses of 10 machines; without these errors the coverage is 40 %
    assert np.mean(covered) > 0.88
    assert np.mean(old) < 0.6


def test_calibration_and_its_run_folder_state_the_errors_of_the_drives(tmp_path) -> None:
    report = lc.calibrate(ROBOT, simulate(2, drift_of_drives)[0])
    assert "residuals.drive-errors" in {finding.code for finding in report.findings}
    assert report.identification.residual_test.p_value > 1e-3
    lc.save_run(tmp_path / "run", report)
    kept = lc.load_run(tmp_path / "run").load_posterior().repeatability
    np.testing.assert_allclose(kept, report.identification.posterior.reading_sigma, rtol=1e-12)
    assert kept.min() > 3e-6


def test_sensed_joints_and_uncertain_readings_are_not_tested() -> None:
    data = simulate(2, drift_of_drives)[0]
    uncertain = replace(data, reading_sigma=np.full(data.readings.shape, 1e-5))
    assert find_drive_errors(linearize(uncertain)) is None
    assert (list_units(linearize(data)) == 1.0).all()  # lengths count in meters
