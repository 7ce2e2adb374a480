# SPDX-License-Identifier: Apache-2.0
"""Targets fixed to the base: a tracker that moved between two sessions, beside a linear delta.

The reference is a dense least-squares fit by scipy with the closed form of the delta, in which the
nine parameters, both frames of the tracker and the places of the targets are plain unknowns.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, kstest

import loopcal as lc
from loopcal.apply.calibration_report import Verdict
from loopcal.diagnose.gauge_freedoms import interpret_fit
from loopcal.diagnose.measured_points import (
    compare_shapes,
    estimate_frame_drifts,
    report_base_targets,
)
from loopcal.diagnose.model_discrepancy import check_lack_of_fit
from loopcal.errors import DataError
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP
from loopcal.findings import Finding
from loopcal.measure.simulation import sample_truth
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import resolve_poses
from tests.estimate.dense_delta import NOMINAL, TOLERANCE, locate_nozzle

ROBOT = lc.load_robot("linear-delta")
SIGMA = 15e-6  # [m] of every coordinate
PLACES = np.array([[0.3, -0.25, 0.0], [0.2, 0.35, 0.05], [-0.35, 0.05, 0.02]])
NAMES = ("N1", "N2", "N3")
ARCSEC = np.pi / 180.0 / 3600.0
STATION = np.array([0.1, 0.2, -2.0, 1.5, -1.0, 0.8])  # rotation vector, position [m]
DRIFT = np.array([0.0, 0.0, 20.0 * ARCSEC, 1e-4, 0.0, 0.0])
AXES = ("rx", "ry", "rz", "x", "y", "z")
FRAMES = tuple(f"{session}.frame.{axis}" for session in ("am", "pm") for axis in AXES)
N = 20
POSES = resolve_poses(ROBOT, N, 2)
TRUTHS = sample_truth(ROBOT, 20, 5)


def make_base_kind(is_known=True, **settings):
    unknown = ("frame",) if is_known else ("frame", "targets")
    return lc.Position(targets=NAMES, places=PLACES, unknown=unknown, of="base", **settings)


def measure(number, drift=DRIFT, is_known=True, poses=POSES, reading_sigma=None):
    """Return the measurements of a machine in two sessions, and its parameters (9,)."""
    sessions = np.repeat(["am", "pm"], len(poses) // 2)
    tool = lc.Position(targets=("tool",), unknown=("frame",))
    base = make_base_kind(is_known)
    sensors = (
        lc.Sensor(tool, lc.Gaussian(np.full(3, SIGMA)), session=sessions),
        lc.Sensor(
            base, lc.Gaussian(np.full(9, SIGMA)), np.zeros(4, int), np.repeat(["am", "pm"], 2)
        ),
    )
    values = dict(zip(FRAMES, np.r_[STATION, STATION + drift].tolist(), strict=True))
    truth = ROBOT.with_values(TRUTHS[number])
    how = {"nuisance_values": values, "reading_sigma": reading_sigma}
    data = lc.simulate(truth, poses, lc.Instrument(sensors), number, **how)
    return data, TRUTHS[number][ROBOT.parameters.free]


def join_sessions(data):
    """Return the measurements as one session."""
    of_poses, of_base = (
        tuple(replace(rows, session=np.full(len(rows), "")) for rows in observations)
        for observations in (data.observations, data.base_observations)
    )
    return replace(data, observations=of_poses, base_observations=of_base)


def to_frame(points, frame):
    """Return points (n, 3) of the base in a frame of six numbers."""
    return (points - frame[3:]) @ Rotation.from_rotvec(frame[:3]).as_matrix()


def fit_densely(data, is_known):
    """Return the unknowns (9 + 12 + 9,) of the dense fit with spreads, and their covariance."""
    moving, base = data.observations[0], data.base_observations[0]

    def residual(x):
        z, frames, places = x[:9], x[9:21].reshape(2, 6), x[21:].reshape(-1, 3)
        places = PLACES if is_known else places
        points = locate_nozzle(NOMINAL + TOLERANCE * z, data.readings)
        rows = [z]
        for session, frame in zip(("am", "pm"), frames, strict=True):
            own, on_base = moving.session == session, base.session == session
            rows.append((to_frame(points[own], frame) - moving.measured[own]).ravel() / SIGMA)
            seen = to_frame(places, frame).ravel()
            rows.append((seen - base.measured[on_base]).ravel() / SIGMA)
        return np.concatenate(rows)

    begin = np.r_[np.zeros(9), STATION, STATION, np.zeros(0) if is_known else PLACES.ravel()]
    found = least_squares(
        residual, begin, "3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    return found.x, np.linalg.inv(found.jac.T @ found.jac)


def compare_frames(fit):
    """Return the estimated motion (6,) from the first to the second session, and its covariance."""
    setup = fit.nuisance
    places = [setup.names.index(name) for name in FRAMES]
    A = np.zeros((6, len(setup)))
    A[np.arange(6), places[6:]], A[np.arange(6), places[:6]] = 1.0, -1.0
    z = fit.covariance / np.outer(fit.tolerance, fit.tolerance)
    root = setup.root.fill(np.arange(len(setup)))
    return A @ setup.estimate, A @ (root @ root.T + setup.slope @ z @ setup.slope.T) @ A.T


@pytest.mark.parametrize("is_known", [True, False])
def test_machine_frames_and_targets_agree_with_a_dense_fit(is_known):
    data, _ = measure(0, is_known=is_known)
    fit = lc.identify(ROBOT, data, options=FitOptions(MAP(), sigma_uncertainty=0.0))
    expected, covariance = fit_densely(data, is_known)
    free = ROBOT.parameters.free
    z = (fit.robot.values[free] - NOMINAL) / TOLERANCE
    sd = np.sqrt(np.diag(covariance))
    # a thousandth of a standard deviation: differences of the two derivatives and stopping rules
    np.testing.assert_array_less(np.abs(z - expected[:9]), 1e-3 * sd[:9])
    names = FRAMES if is_known else (*FRAMES, *(f"{n}.{a}" for n in NAMES for a in "xyz"))
    places = [fit.nuisance.names.index(name) for name in names]
    error = np.abs(fit.nuisance.estimate[places] - expected[9:])
    np.testing.assert_array_less(error, 1e-3 * sd[9:])
    np.testing.assert_allclose(fit.nuisance.sd[places], sd[9:], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("machines", [4, pytest.param(10, marks=pytest.mark.evidence)])
def test_the_motion_of_the_tracker_is_recovered_within_its_uncertainty(machines):
    total, covariance = 0.0, np.eye(6)
    for number in range(machines):
        motion, covariance = compare_frames(lc.identify(ROBOT, measure(number)[0]))
        error = motion - DRIFT
        total += error @ np.linalg.solve(covariance, error)
    assert chi2.ppf(0.005, 6 * machines) < total < chi2.ppf(0.995, 6 * machines)
    # 0.1 mm and 20 arcsec are many standard deviations, so that a fit that ignores them fails
    sd = np.sqrt(np.diag(covariance))
    assert sd[2] < 0.3 * DRIFT[2]
    assert sd[3] < 0.4 * DRIFT[3]


@pytest.mark.slow
@pytest.mark.parametrize("machines", [2, pytest.param(4, marks=pytest.mark.evidence)])
def test_a_calibration_with_targets_on_the_base_does_not_suffer_from_the_motion(machines):
    q = lc.inverse(ROBOT, resolve_poses(ROBOT, 30, 9)).q
    errors = {"still": [], "moved": [], "unnoticed": [], "without": []}
    for number in range(machines):
        moved, still = measure(number)[0], measure(number, 0.0 * DRIFT)[0]
        data = {
            "still": join_sessions(still),
            "moved": moved,
            "unnoticed": join_sessions(replace(moved, base_observations=())),
            "without": replace(moved, base_observations=()),
        }
        expected = forward(ROBOT.with_values(TRUTHS[number]), q).T[:, :3, 3]
        for name, own in data.items():
            fit = lc.identify(ROBOT, own)
            errors[name].append(forward(fit.robot, q).T[:, :3, 3] - expected)
    rms = {name: np.sqrt(np.mean(np.square(e)) * 3.0) for name, e in errors.items()}
    assert rms["moved"] < 1.1 * rms["still"] < 25e-6
    # without the targets nothing determines the base frame
    assert min(rms["unnoticed"], rms["without"]) > 5.0 * rms["moved"]


@pytest.mark.slow
def test_an_unnoticed_motion_is_found_with_its_size_and_uncertainty():
    data = join_sessions(measure(1)[0])
    (drift,) = estimate_frame_drifts(data)
    center = PLACES.mean(axis=0)
    first, last = (to_frame(center, STATION + part * DRIFT) for part in (0.0, 1.0))
    assert drift.shift == pytest.approx(np.linalg.norm(last - first), abs=4.0 * drift.shift_sd)
    # the angle is a length of three noisy numbers, so that it is rather too large
    assert drift.angle == pytest.approx(20.0 * ARCSEC, abs=4.0 * drift.angle_sd)
    assert (drift.session, drift.rows, drift.degrees) == ("", 4, 18)
    assert drift.row in (3, 4)
    report = lc.calibrate(ROBOT, data)
    assert "residuals.frame-moved" in [finding.code for finding in report.findings]
    assert report.next_step.code == "workflow.next-check-base-targets"
    named = lc.calibrate(ROBOT, measure(1)[0], lc.CalibrationOptions(hold_out=0.3))
    assert "residuals.frame-moved" not in [finding.code for finding in named.findings]
    assert named.verdict is Verdict.CALIBRATED


def make_repeats(seed, *, targets=5, moved=None, step=None, sessions=("", "", "", "")):
    """Return four measurements of targets, with a noise that differs between the coordinates."""
    rng = np.random.default_rng(seed)
    names = tuple(f"N{i + 1}" for i in range(targets))
    places = rng.uniform(-0.5, 0.5, (targets, 3))
    sd = SIGMA * rng.uniform(0.5, 2.0, (4, 3 * targets))
    measured = np.empty((4, targets, 3))
    for i in range(4):
        at = places.copy()
        if moved is not None and i >= 2:
            at[moved] += [2e-4, 1e-4, 0.0] if step is None else step(places)
        other = sessions[i] != sessions[0]
        frame = np.r_[STATION[:3] + other * np.array([0.4, -1.0, 0.8]), STATION[3:] - other]
        measured[i] = to_frame(at, frame)
    measured = measured.reshape(4, -1) + sd * rng.standard_normal(sd.shape)
    kind = lc.Position(targets=names, unknown=("frame", "targets"), of="base")
    rows = lc.Observations.from_sigma(kind, [0] * 4, measured, sd, session=np.array(sessions))
    return lc.Measurements("any", np.zeros((1, 3)), (), base_observations=(rows,))


@pytest.mark.parametrize("sessions", [("",) * 4, ("am", "am", "pm", "pm")])
@pytest.mark.parametrize("count", [30, pytest.param(60, marks=pytest.mark.evidence)])
def test_p_values_without_motion_are_uniform(sessions, count):
    data = [make_repeats(seed, sessions=sessions) for seed in range(count)]
    moved = [drift.p_value for each in data for drift in estimate_frame_drifts(each)]
    shapes = [shape.p_value for each in data for shape in compare_shapes(each)]
    assert len(moved) == count * len(set(sessions))
    assert kstest(moved, "uniform").pvalue > 1e-3
    assert kstest(shapes, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("sessions", [("",) * 4, ("am", "am", "pm", "pm")])
def test_a_target_that_moved_is_named_and_is_no_motion_of_the_frame(sessions):
    (finding,) = report_base_targets(make_repeats(3, moved=1, sessions=sessions))
    assert finding.code == "residuals.base-targets-moved"
    assert finding.data["suspects"] == ("N2",)


def test_three_targets_of_which_one_moved_do_not_show_which():
    def keep_distance_to_first(places):
        normal = np.cross(places[1] - places[0], places[2] - places[0])
        across = np.cross(normal, places[1] - places[0])
        return 3e-4 * across / np.linalg.norm(across)

    data = make_repeats(4, targets=3, moved=1, step=keep_distance_to_first)
    (finding,) = report_base_targets(data)
    assert finding.code == "residuals.base-targets-moved"
    assert finding.data["suspects"] == ("N2", "N3")


def test_a_wrong_stated_place_and_interchanged_names_are_found():
    data, _ = measure(4)
    assert report_base_targets(data) == ()
    (rows,) = data.base_observations
    wrong = np.array(PLACES)
    wrong[1, 0] += 2e-4
    interchanged = PLACES[[1, 0, 2]]
    for places in (wrong, interchanged):
        kind = replace(make_base_kind(), places=places)
        changed = replace(data, base_observations=(replace(rows.take([0]), kind=kind),))
        (finding,) = report_base_targets(changed)
        assert finding.code == "residuals.base-targets-moved"
        assert finding.data["is_stated"]
    right = [report_base_targets(measure(number)[0]) for number in range(10)]
    assert sum(map(len, right)) == 0


@pytest.mark.parametrize(("order", "unit"), [([1, 0, 2], 1.0), ([0, 1, 2], 25.4)])
def test_targets_on_the_base_in_another_order_or_unit_are_refused(order, unit):
    """They ended in a robot that does not reach its poses, or in a fit without an end."""
    data, _ = measure(4)
    (rows,) = data.base_observations
    measured = (rows.measured.reshape(-1, 3, 3)[:, order] / unit).reshape(rows.measured.shape)
    wrong = replace(data, base_observations=(replace(rows, measured=measured),))
    with pytest.raises(DataError, match="distances in the file") as caught:
        lc.calibrate(ROBOT, wrong)
    assert caught.value.code == "residuals.base-targets-moved"


def test_rows_of_the_base_stay_when_poses_are_taken_held_out_weighted_or_excluded():
    data, _ = measure(2)
    fitted, held_out = data.split(hold_out=0.3, seed=1)
    lighter = data.with_weights(np.zeros(N))
    for part in (data.take([3, 1]), fitted, held_out, lighter):
        assert part.base_observations[0].n_residuals == 36
    assert data.n_rows == 3 * N
    fit = lc.identify(ROBOT, data, options=FitOptions(excluded_poses=("1", "11")))
    others = lc.identify(ROBOT, data.take([i for i in range(N) if i not in (0, 10)]))
    np.testing.assert_allclose(fit.estimate, others.estimate, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_rows_of_the_base_are_no_errors_of_poses():
    data, _ = measure(2)
    report = lc.calibrate(ROBOT, data, lc.CalibrationOptions(hold_out=0.25))
    assert report.validation is not None
    assert len(report.validation.after.position) == 5
    assert report.examination is not None
    assert report.examination.outliers.blocks == 15
    # the residuals of the fit name them by their body
    assert set(report.identification.residuals[-1].poses) == {"base"}


def test_repeated_targets_on_the_base_are_no_repeated_poses():
    data, _ = measure(2)
    lack = check_lack_of_fit(lc.identify(ROBOT, data), data)
    assert [finding.code for finding in lack.findings] == ["residuals.no-repeats"]


def test_uncertain_readings_and_targets_on_the_base_are_fitted_together():
    exact, _ = measure(3)
    data, values = measure(3, reading_sigma=5e-6)
    fit = lc.identify(ROBOT, data)
    assert fit.chi_square < chi2.ppf(0.9999, fit.residual_test.degrees)
    reference = lc.identify(ROBOT, exact)
    assert (np.diag(fit.covariance) > np.diag(reference.covariance)).all()
    error = (fit.estimate - values) / np.sqrt(np.diag(fit.covariance))
    assert np.abs(error).max() < 4.0


def test_two_targets_leave_one_rotation_of_the_base_open():
    hexapod = lc.load_robot("hexapod-octahedral")
    platform = lc.Position(
        targets=("A", "B", "C"),
        places=np.array([[0.1, 0, 0], [-0.05, 0.09, 0.02], [-0.05, -0.09, 0.0]]),
        unknown=("frame", "targets"),
    )
    open_base = []
    for count in (0, 1, 2, 3):
        sensors = [lc.Sensor(platform, lc.Gaussian(np.full(9, SIGMA)))]
        if count:
            base = lc.Position(
                targets=NAMES[:count], places=PLACES[:count], unknown=("frame",), of="base"
            )
            sensors.append(lc.Sensor(base, lc.Gaussian(np.full(3 * count, SIGMA))))
        data = lc.simulate(hexapod, resolve_poses(hexapod, 15, 1), lc.Instrument(tuple(sensors)), 1)
        fit = lc.identify(hexapod, data)
        open_base.append(len(fit.names) - fit.rank)
    # of the six motions of the base, a point leaves three, two points one, three points none;
    # the six of the platform stay open, since its targets are unknown
    assert open_base == [12, 9, 7, 6]


def test_the_rotation_that_two_targets_leave_open_is_named_by_its_axis():
    hexapod = lc.load_robot("hexapod-octahedral")
    places = np.array([[0.1, 0, 0], [-0.05, 0.09, 0.02], [-0.05, -0.09, 0.0]])
    platform = lc.Position(targets=("A", "B", "C"), places=places, unknown=("frame",))
    base = lc.Position(targets=NAMES[:2], places=PLACES[:2], unknown=("frame",), of="base")
    sensors = (
        lc.Sensor(platform, lc.Gaussian(np.full(9, SIGMA))),
        lc.Sensor(base, lc.Gaussian(np.full(6, SIGMA))),
    )
    data = lc.simulate(hexapod, resolve_poses(hexapod, 15, 1), lc.Instrument(sensors), 1)
    (combination,) = interpret_fit(lc.identify(hexapod, data)).unidentifiable
    motion = combination.meaning
    assert isinstance(motion, Finding)
    axis = np.array([float(x) for x in motion.data["axis"].strip("()").split(",")])
    line = (PLACES[1] - PLACES[0]) / np.linalg.norm(PLACES[1] - PLACES[0])
    assert (motion.data["frame"], motion.data["motion"]) == ("base", "rotation")
    # three digits are printed
    assert abs(axis @ line) == pytest.approx(1.0, abs=5e-3)


def test_any_kind_of_points_may_be_on_the_base():
    bearing = lc.Bearing(targets=NAMES, places=PLACES, unknown=("frame",), of="base")
    tool = lc.Position(unknown=("frame",))
    sensors = (
        lc.Sensor(tool, lc.Gaussian(np.full(3, SIGMA))),
        lc.Sensor(bearing, lc.Gaussian(np.full(6, 5e-6))),
    )
    values = {f"frame.{axis}": x for axis, x in zip(AXES, STATION.tolist(), strict=True)}
    truth = ROBOT.with_values(TRUTHS[0])
    data = lc.simulate(truth, POSES, lc.Instrument(sensors), 1, nuisance_values=values)
    fit = lc.identify(ROBOT, data)
    error = (fit.estimate - TRUTHS[0][ROBOT.parameters.free]) / np.sqrt(np.diag(fit.covariance))
    assert np.abs(error).max() < 4.0


@pytest.mark.slow
def test_a_validation_in_a_new_session_uses_its_targets_on_the_base():
    fit = lc.identify(ROBOT, measure(5)[0])
    other, _ = measure(5, 100.0 * DRIFT, poses=resolve_poses(ROBOT, 10, 8))
    (of_poses,), (on_base,) = other.observations, other.base_observations
    names = {"am": "tuesday", "pm": "wednesday"}
    renamed = (
        replace(rows, session=np.array([names[name] for name in rows.session.tolist()]))
        for rows in (of_poses, on_base)
    )
    moving, base = renamed
    data = replace(other, observations=(moving,), base_observations=(base,))
    validation = lc.validate(fit, data)
    assert validation.after.statistics("position").rms < 3.0 * SIGMA
    measured = np.array(base.measured)
    measured[1, 3] += 1e-3
    wrong = replace(data, base_observations=(replace(base, measured=measured),))
    codes = [finding.code for finding in lc.validate(fit, wrong).findings]
    assert "residuals.base-targets-moved" in codes


@pytest.mark.slow
def test_a_plan_counts_targets_on_the_base():
    def plan(with_base):
        sensors = [lc.Sensor(lc.Position(unknown=("frame",)), lc.Gaussian(np.full(3, SIGMA)))]
        if with_base:
            sensors.append(lc.Sensor(make_base_kind(), lc.Gaussian(np.full(9, SIGMA))))
        options = lc.PlanOptions(n_candidates=40, frame="base")
        return lc.plan(ROBOT, lc.Instrument(tuple(sensors)), 12, options=options)

    with_base, without = plan(True), plan(False)
    assert with_base.errors.after.position < 0.1 * without.errors.after.position


def test_python_users_are_told_where_the_rows_belong():
    data, _ = measure(0)
    with pytest.raises(DataError, match="base_observations"):
        replace(data, observations=data.all_observations, base_observations=())
    with pytest.raises(DataError, match='of="base"'):
        replace(data, observations=(), base_observations=data.all_observations)
    other = lc.Position(targets=("N2",), places=np.zeros((1, 3)))
    rows = lc.Observations.from_sigma(other, [0], np.zeros((1, 3)), SIGMA)
    with pytest.raises(DataError) as caught:
        replace(data, observations=(rows,))
    assert caught.value.code == "data.target-on-two-bodies"
    for kind in (lc.Plane, lc.Sphere, lc.Separation):
        with pytest.raises(DataError, match="of: base"):
            kind(of="base")
    with pytest.raises(DataError, match="neither given nor unknown"):
        lc.Position(targets=NAMES, of="base", unknown=("frame",))
