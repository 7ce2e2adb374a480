# SPDX-License-Identifier: Apache-2.0
"""Calibration of chains of stages with targets and sensors on any stage."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from loopcal.errors import DataError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.io.data.measurement_file import load_measurements, save_measurements
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from tests.denavit_hartenberg import ARM_6R, join, multiply_denavit_hartenberg
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]
PLACES = np.array([[1.0, 0.2, 0.1], [4.0, -0.2, 0.1]])
FRAME = {"tracker.x": 0.3, "tracker.rz": 0.2}


def make_kinds() -> tuple[Position, ...]:
    """Return two targets on the bucket, the boom and the stick, seen by one tracker."""
    return tuple(
        Position(
            targets=(f"{label}1", f"{label}2"),
            places=share * PLACES,
            of=stage,
            unknown=("frame",),
            frame="tracker",
        )
        for label, stage, share in (("t", "", 0.4), ("b", "boom", 1.0), ("s", "stick", 0.5))
    )


def measure_stages(robot: Mechanism) -> tuple[Mechanism, Measurements]:
    """Return a machine with errors, and measured positions of targets on three of its stages."""
    sensors = tuple(Sensor(kind, Gaussian(np.full(6, 1e-4))) for kind in make_kinds())
    true = robot.with_values(sample_truth(robot, 1, 5)[0])
    poses = sample_workspace(robot, 20, seed=1).coordinates
    return true, simulate(true, poses, Instrument(sensors), 6, nuisance_values=FRAME)


def test_targets_on_any_stage_calibrate_a_chain_in_an_unknown_frame() -> None:
    robot = load_cached_robot("excavator")
    true, data = measure_stages(robot)
    fit = identify(robot, data)
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high
    sd = fit.standard_deviations
    error = (fit.robot.values - true.values)[fit.free_parameters.places] / sd
    assert np.abs(error).max() < 4.5  # of 26 values


def test_targets_on_a_stage_do_not_depend_on_the_joints_behind_it() -> None:
    robot = load_cached_robot("excavator")
    _, data = measure_stages(robot)
    alone = replace(data, observations=(data.observations[1],))
    moved = data.readings.copy()
    moved[:, 2:] += 0.05  # [m] of the cylinders of stick and bucket
    fits = [
        identify(robot, replace(alone, readings=readings)) for readings in (data.readings, moved)
    ]
    np.testing.assert_allclose(fits[0].robot.values, fits[1].robot.values, atol=1e-9)
    behind = [n.startswith(("stick.", "bucket.")) for n in robot.parameters.names]
    np.testing.assert_array_equal(fits[0].robot.values[behind], robot.parameters.nominal[behind])


def test_targets_on_a_stage_are_written_and_read(tmp_path: Path) -> None:
    robot = load_cached_robot("excavator")
    _, data = measure_stages(robot)
    save_measurements(data, tmp_path / "targets.csv", robot)
    read = load_measurements(tmp_path / "targets.csv", robot)
    assert [rows.kind.of for rows in read.observations] == ["", "boom", "stick"]
    assert identify(robot, read).chi_square == pytest.approx(identify(robot, data).chi_square)


def test_sensor_on_a_joint_of_a_stage_is_named_with_the_stage() -> None:
    robot = load_cached_robot("excavator")
    kind = JointSensor(joints=("boom.serial.joint", "stick.serial.joint"), measures="angle")
    instrument = Instrument((Sensor(kind, Gaussian(np.full(2, 1e-5))),))
    true = robot.with_values(sample_truth(robot, 1, 7)[0])
    data = simulate(true, sample_workspace(robot, 20, seed=2).coordinates, instrument, 8)
    fit = identify(robot, data)
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high


def test_targets_on_an_unknown_stage_are_refused() -> None:
    robot = load_cached_robot("excavator")
    poses = sample_workspace(robot, 2, seed=1).coordinates
    instrument = Instrument((Sensor(Position(of="bom"), Gaussian(np.full(3, 1e-4))),))
    with pytest.raises(DataError, match="no stage or body 'bom'"):
        simulate(robot, poses, instrument, 1)
    with pytest.raises(DataError, match="it has none beside the platform"):
        simulate(load_cached_robot("3-prs"), np.array([[0.7, 0.0, 0.0]]), instrument, 1)


def test_a_kind_that_compares_poses_has_no_stage() -> None:
    with pytest.raises(DataError, match="compares poses"):
        Separation(of="boom")


TARGETS = np.array([[0.05, 0.0, 0.0], [0.0, 0.08, 0.02], [0.0, -0.04, 0.07]])
TRACKER = {"tracker.x": 2.0, "tracker.rz": 0.7}


def locate_targets(base: Array, T: Array, places: Array) -> Array:
    """Return targets (n, k, 3) in the tracker, at whose frame the base is (rotation, place)."""
    seen = join(Rotation.from_rotvec(base[:3]).as_matrix(), base[3:]) @ T
    return np.einsum("nij,kj->nki", seen[:, :3, :3], places) + seen[:, None, :3, 3]


def predict_densely(x: Array, q: Array) -> Array:
    """Return the targets of 24 errors of links, one angle, the base (6) and the targets (9)."""
    T = multiply_denavit_hartenberg(q, ARM_6R + x[:24].reshape(6, 4), x[24])
    return locate_targets(x[25:31], T, TARGETS + x[31:].reshape(3, 3))


@pytest.mark.slow
def test_an_arm_is_calibrated_as_accurately_as_by_a_dense_fit() -> None:
    """Frame of the tracker and places of the targets are unknown; scipy fits all 40 numbers."""
    robot = load_cached_robot("arm-6r")
    kind = Position(
        targets=("t1", "t2", "t3"), places=TARGETS, unknown=("frame", "targets"), frame="tracker"
    )
    sigma = 3e-5
    instrument = Instrument((Sensor(kind, Gaussian(np.full(9, sigma))),))
    true = robot.with_values(sample_truth(robot, 1, 5)[0])
    poses = sample_workspace(robot, 60, seed=1).coordinates
    data = simulate(true, poses, instrument, 6, nuisance_values=TRACKER)
    fit = identify(robot, data, LeastSquares())

    measured = data.observations[0].measured.reshape(-1, 3, 3)
    start = np.zeros(40)
    start[27:29] = -TRACKER["tracker.rz"], -np.cos(0.7) * 2.0
    start[29] = np.sin(0.7) * 2.0
    dense = least_squares(
        lambda x: ((predict_densely(x, data.readings) - measured) / sigma).ravel(),
        start,
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-12,
    )
    assert fit.chi_square == pytest.approx(2.0 * dense.cost, rel=1e-9)
    low, high = chi2.ppf([0.005, 0.995], fit.residual_test.dof)
    assert low < fit.chi_square < high

    later = sample_workspace(robot, 30, seed=9).solution.q
    values = dict(zip(fit.nuisance.names, fit.nuisance.estimate, strict=True))
    seen_from = [values[f"tracker.{name}"] for name in ("rx", "ry", "rz", "x", "y", "z")]
    R = Rotation.from_rotvec(seen_from[:3]).as_matrix()
    base = np.r_[Rotation.from_matrix(R.T).as_rotvec(), -R.T @ seen_from[3:]]
    places = np.array([[values[f"t{i}.{axis}"] for axis in "xyz"] for i in (1, 2, 3)])
    mine = locate_targets(base, forward(fit.robot, later).T, places)
    # [m] a hundredth of a micron; the noise is 30 um
    np.testing.assert_allclose(mine, predict_densely(dense.x, later), rtol=0, atol=1e-8)
