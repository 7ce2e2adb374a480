# SPDX-License-Identifier: Apache-2.0
"""Calibration from actuator readings alone: the planar belt robot, whose four belts hold a point.

The reference is the closed form |x - a_k| = q_k + c_k, solved for all positions, anchors a_k and
zeros c_k together by scipy, with the three motions of the plane fixed by prescribed coordinates.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import loopcal as lc
from loopcal.apply.calibration_report import Verdict
from loopcal.apply.inspection import analyze_identifiability
from loopcal.diagnose.gauge_freedoms import find_gauge_freedoms
from loopcal.errors import DataError, FileError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.measure.data_checks import check_duplicates

ANCHORS = 1e-3 * np.array([[-1800, -1200], [1800, -1200], [1800, 1200], [-1800, 1200.0]])
SIGMA = 2e-4  # [m] of a reading, as the robot file states
READINGS = lc.Instrument((lc.Sensor(lc.Closure(), lc.Gaussian(np.zeros(0))),))


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("belt-4")


def measure(anchors, zeros, n, seed):
    """Return positions (n, 2) and readings (n, 4) with noise [m] of a machine."""
    rng = np.random.default_rng(seed)
    x = rng.uniform([-1.1, -0.7], [1.1, 0.7], (n, 2))
    length = np.linalg.norm(x[:, None] - anchors, axis=2)
    return x, length - zeros + SIGMA * rng.standard_normal((n, 4))


def draw_machine(seed, share=0.01):
    """Return anchors and zeros that differ from the file by a share of the anchors."""
    rng = np.random.default_rng(seed)
    anchors = ANCHORS * (1.0 + share * rng.standard_normal((4, 2)))
    return anchors, 0.01 * rng.standard_normal(4)


def make_data(robot, readings):
    rows = lc.Observations.from_sigma(lc.Closure(), range(len(readings)), readings[:, :0], [])
    return lc.Measurements(robot.name, readings, (rows,))


def solve_reference(x, readings):
    """Return distances (4, 4) between anchors, zeros (4,) [m] and chi-square of the closed form."""
    n = len(x)

    def residual(p):
        anchors, zeros, points = p[:8].reshape(4, 2), p[8:12], p[12:].reshape(n, 2)
        shown = np.linalg.norm(points[:, None] - anchors, axis=2) - zeros
        # three equations that the readings do not contradict choose a frame of the plane
        frame = [p[0] - ANCHORS[0, 0], p[1] - ANCHORS[0, 1], p[3] - ANCHORS[1, 1]]
        return np.concatenate([((shown - readings) / SIGMA).ravel(), np.array(frame) / SIGMA])

    start = np.concatenate([ANCHORS.ravel(), np.zeros(4), x.ravel()])
    done = least_squares(residual, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    anchors = done.x[:8].reshape(4, 2)
    sides = np.linalg.norm(anchors[:, None] - anchors, axis=2)
    return sides, done.x[8:12], float(done.fun @ done.fun)


def place_truth(robot, anchors, zeros):
    """Return the values (12,) of a machine, moved as a whole to where the robot's anchors are: a
    motion by a tenth of a radian is not linear.
    """
    found = robot.values.reshape(4, 3)[:, :2]
    centered, target = anchors - anchors.mean(axis=0), found - found.mean(axis=0)
    left, _, right = np.linalg.svd(centered.T @ target)
    turn = left @ np.diag([1.0, np.linalg.det(left @ right)]) @ right
    return np.column_stack([centered @ turn + found.mean(axis=0), zeros]).ravel()


def split_values(robot):
    """Return distances between the anchors (4, 4) and zeros (4,) [m] of a robot."""
    values = robot.values.reshape(4, 3)
    sides = np.linalg.norm(values[:, None, :2] - values[None, :, :2], axis=2)
    return sides, values[:, 2]


def test_fit_equals_the_closed_form_with_all_positions_as_unknowns(robot):
    anchors, zeros = draw_machine(1)
    x, readings = measure(anchors, zeros, 40, 2)
    fit = identify(robot, make_data(robot, readings), LeastSquares())
    sides, lengths, chi_square = solve_reference(x, readings)
    found = split_values(fit.robot)
    assert fit.rank == 9
    assert fit.chi_square == pytest.approx(chi_square, rel=1e-6)
    # [m] a thousandth of the standard deviation of the best known side
    np.testing.assert_allclose(found[0], sides, atol=1e-7)
    np.testing.assert_allclose(found[1], lengths, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.evidence)])
def test_starting_values_ten_percent_off_converge(robot, seed):
    anchors, zeros = draw_machine(10 + seed, 0.1)
    _, readings = measure(anchors, zeros, 40, seed)
    data = make_data(robot, readings)
    fit = identify(robot, data, LeastSquares())
    assert fit.converged
    truth = lc.compare_with_truth(fit, place_truth(fit.robot, anchors, zeros))
    assert truth.compared == 9
    assert truth.p_value > 1e-4
    report = lc.calibrate(robot, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.verdict is not Verdict.NOT_CALIBRATED
    assert report.validation is not None
    of_readings = report.validation.kinds[0]
    assert of_readings.count == 20
    assert of_readings.before > 50 * of_readings.after
    assert of_readings.after == pytest.approx(1.0, abs=0.6)  # 3.8 sd of 20 values


def test_gauge_is_found_by_computation(robot):
    """Three motions of the plane; spools of unknown radius add the size of the machine."""
    _, readings = measure(*draw_machine(1), 40, 2)
    fit = identify(robot, make_data(robot, readings), LeastSquares())
    motions = find_gauge_freedoms(
        fit.posterior.robot, fit.posterior.places, fit.posterior.unit, fit.posterior.undetermined
    )
    assert (motions.count, motions.has_scale) == (3, False)
    cable = lc.load_robot("cable-4")
    poses = lc.sample_workspace(cable, 30, 1).coordinates
    report = analyze_identifiability(cable, lc.simulate(cable, poses, READINGS, 1))
    (gauge,) = [f for f in report.summary if f.code == "identifiability.readings-gauge"]
    assert [(part["what"], part["count"]) for part in gauge.data["parts"]] == [
        ("frames", 6),
        ("scale", 1),
    ]


def test_wrong_reading_is_named_by_its_pose(robot):
    _, readings = measure(*draw_machine(1), 30, 2)
    readings[11, 2] += 5e-3
    report = lc.calibrate(robot, make_data(robot, readings), lc.CalibrationOptions())
    (outlier,) = [f for f in report.findings if f.code == "outliers.pose"]
    assert "Pose 12" in str(outlier)


def test_ls_covariance_is_that_of_repeats(robot):
    """Small form of evidence/readings_alone.py: 12 machines, 9 directions each."""
    anchors, zeros = draw_machine(1)
    scores, chi_squares = [], []
    for seed in range(12):
        _, readings = measure(anchors, zeros, 30, 100 + seed)
        fit = identify(robot, make_data(robot, readings), LeastSquares())
        check = lc.compare_with_truth(fit, place_truth(fit.robot, anchors, zeros))
        scores.append(check.chi_square / check.compared)
        chi_squares.append(fit.chi_square)
    # 108 squares of standard normal values: four standard deviations are 0.54
    assert np.mean(scores) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 108))
    # 12 x 51 degrees of freedom
    assert np.mean(chi_squares) / 51 == pytest.approx(1.0, abs=4 * np.sqrt(2 / 612))


def test_three_fixed_coordinates_choose_the_frame_and_leave_nothing_open(tmp_path):
    path = tmp_path / "robot.yaml"
    fixed = "fixed: [belt1.anchor.x, belt1.anchor.y, belt2.anchor.y]\n"
    shipped = Path(lc.__file__).parent / "robots" / "belt-4.yaml"
    path.write_text(shipped.read_text("utf-8") + fixed)
    robot = lc.load_robot(path)
    _, readings = measure(*draw_machine(1), 40, 2)
    fit = identify(robot, make_data(robot, readings), LeastSquares())
    assert (fit.rank, len(fit.names)) == (9, 9)
    assert np.isfinite(fit.standard_deviations).all()


def test_measurements_are_read_as_saved(robot, tmp_path):
    _, readings = measure(*draw_machine(1), 5, 2)
    data = make_data(robot, readings)
    lc.save_measurements(data, tmp_path / "data.csv", robot)
    read = lc.load_measurements(tmp_path / "data.csv", robot)
    np.testing.assert_allclose(read.readings, readings, rtol=1e-15)
    assert [rows.kind.name for rows in read.observations] == ["closure"]
    twice = make_data(robot, readings[[0, 1, 1]])
    with pytest.raises(DataError, match="have equal closure values"):
        check_duplicates(twice)


def test_readings_alone_without_redundancy_are_refused_in_one_sentence(tmp_path):
    hexapod = lc.load_robot("hexapod-42")
    poses = lc.sample_workspace(hexapod, 3, 1).coordinates
    with pytest.raises(DataError) as error:
        lc.simulate(hexapod, poses, READINGS, 1)
    assert error.value.code == "data.closure-without-redundancy"
    path = tmp_path / "data.csv"
    header = ",".join(f"q{i} [mm]" for i in range(1, 7))
    path.write_text(f"# kind: closure\npose,{header}\n1{',200' * 6}\n")
    with pytest.raises(FileError, match=r"data\.csv:1: .*6 actuators for 6 degrees of freedom"):
        lc.load_measurements(path, hexapod)


def test_readings_alone_need_a_stated_noise(robot, tmp_path):
    path = tmp_path / "exact.yaml"
    shipped = Path(lc.__file__).parent / "robots" / "belt-4.yaml"
    path.write_text(shipped.read_text("utf-8").replace(", sigma: 0.2", ""))
    silent = lc.load_robot(path)
    poses = lc.sample_workspace(silent, 3, 1).coordinates
    with pytest.raises(DataError) as error:
        lc.simulate(silent, poses, READINGS, 1)
    assert error.value.code == "data.closure-without-sigma"
    data = lc.simulate(silent, poses, READINGS, 1, reading_sigma=SIGMA)
    assert data.n_rows == 0


@pytest.mark.evidence
def test_published_repeats_scatter_as_their_standard_deviations_say(root):
    """100 poses, 200 repeats: 15 % are three standard deviations of the spread of one direction."""
    path = root / "docs" / "evidence" / "readings_alone.json"
    if not path.exists():
        pytest.skip("docs/evidence/readings_alone.json is made by `make evidence`")
    one, sets, squares, band, share = json.loads(path.read_text())["tables"]["spread"]["rows"]
    assert 0.85 < one[1] < one[2] < 1.15
    assert 0.85 < sets[1] < sets[2] < 1.15
    assert band[1] < squares[1] < squares[2] < band[2]
    assert share[1] > 0.95  # 198 of 200 are expected; a sd of 1.4
