# SPDX-License-Identifier: Apache-2.0
"""Expected errors by source, against true errors of simulated machines with one source active."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import loopcal as lc
from loopcal import geometry
from loopcal.apply.accuracy import pose_uncertainty
from loopcal.apply.error_budget import ErrorBudget, compute_error_budget
from loopcal.diagnose.error_frames import solve_home
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify, identify_trials
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.result import Identification
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.poses import Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.kinematics import forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import ParameterTable
from tests.estimate.problems import UM, URAD, noise

MACHINES = 240
AGREEMENT = 0.06
"""Relative difference of the rms over 240 machines of some 5 independent directions: three standard
deviations are 3 / sqrt(2 * 240 * 5)."""

THREE = np.array([[0.03, -0.02, 0.05], [-0.04, 0.02, 0.05], [0.0, 0.05, 0.06]])


@cache
def robot() -> Mechanism:
    """Return the hexapod of the library, which states its workspace and spreads."""
    return lc.load_robot("hexapod-42")


def measured_poses(count: int) -> np.ndarray:
    """Return coordinates of measured poses."""
    return sample_workspace(robot(), count, 7).coordinates


def true_errors(values: np.ndarray, truth: np.ndarray, readings: np.ndarray) -> np.ndarray:
    """Return the errors (t, n, 6) of machines at readings: a rotation, and a motion of the tool."""
    states = [forward_trials(robot(), v, readings[None]) for v in (values, truth)]
    estimated, true = (state.T @ robot().tool for state in states)
    rotation = geometry.log_so3(estimated[..., :3, :3] @ true[..., :3, :3].swapaxes(-1, -2))
    return np.concatenate([rotation, estimated[..., :3, 3] - true[..., :3, 3]], axis=-1)


def rms(errors: np.ndarray) -> tuple[float, float]:
    """Return the root mean square of position and orientation of errors (t, n, 6)."""
    squares = (errors**2).mean(axis=(0, 1))
    return float(np.sqrt(squares[3:].sum())), float(np.sqrt(squares[:3].sum()))


def workspace_readings() -> np.ndarray:
    """Return the readings of the poses that a budget of the nominal robot uses."""
    return sample_workspace(robot(), 200, 0).solution.q


def measure_trials(sensor: Sensor, machine: Mechanism | None = None, **options):
    """Return the truth and the measurements of the machines."""
    machine = machine or robot()
    truth = sample_truth(machine, MACHINES, 5)
    return truth, simulate_trials(
        machine, truth, measured_poses(30), Instrument((sensor,)), 5, **options
    )


@pytest.mark.parametrize("frame", ["fitted", "base", "relative", "frame"])
def test_total_is_the_pose_uncertainty_and_the_variances_add_up(frame):
    sensor = Sensor(
        Position(targets=("a", "b", "c"), places=THREE, unknown=("frame", "targets")),
        noise(*[10 * UM] * 9),
    )
    data = simulate(robot(), measured_poses(30), Instrument((sensor,)), 1)
    fit = identify(robot(), data)
    budget = find_budget(fit, data, frame)
    uncertainty = pose_uncertainty(
        fit, sample_workspace(fit.robot, 200, 0).solution, frame=frame, origin=solve_home(fit.robot)
    )
    for sources, expected in (
        (budget.position, uncertainty.position),
        (budget.orientation, uncertainty.orientation),
    ):
        assert min(sources) >= 0.0
        assert sources.rms**2 == pytest.approx(sum(sources), rel=1e-12)
        assert sources.rms == pytest.approx(np.sqrt((expected**2).mean()), rel=1e-9)
        assert min(sources.instrument, sources.setup, sources.tolerances) > 0.0
    assert budget.is_workspace
    if frame == "base":  # the unknown frame leaves the place of the base to its spreads
        assert budget.position.setup > 0.9 * sum(budget.position)


def test_with_known_frames_and_accurate_data_the_instrument_is_the_only_source():
    sensor = Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
    truth, trials = measure_trials(sensor)
    fits = identify_trials(robot(), trials, LeastSquares())
    assert fits.converged.all()
    data = trials.trial(0)
    budget = find_budget(identify(robot(), data, LeastSquares()), data)
    errors = rms(true_errors(fits.values, truth, workspace_readings()))
    for sources, true in zip((budget.position, budget.orientation), errors, strict=True):
        assert sources.rms == pytest.approx(true, rel=AGREEMENT)
        assert sources.instrument == pytest.approx(sum(sources), rel=1e-9)


def test_a_stated_scale_of_the_instrument_is_as_large_as_the_true_errors_that_it_causes():
    """A gantry takes all its lengths from the instrument: radii of belts and the gain of its lift
    are unknown.
    """
    gantry = lc.load_robot("core-xy")
    sensor = Sensor(Position(unknown=("scale",)), noise(*[1 * UM] * 3))
    tracker = Instrument((sensor,), (lc.StatedValue("position.scale", 50e-6),))
    truth = sample_truth(gantry, MACHINES, 5)
    poses = sample_workspace(gantry, 30, 7).coordinates
    trials = simulate_trials(gantry, truth, poses, tracker, 5)
    fits = identify_trials(gantry, trials, MAP())
    assert fits.converged.all()
    data = trials.trial(0)
    fit = identify(gantry, data, MAP())
    budget = find_budget(fit, data)
    solution = sample_workspace(gantry, 200, 0).solution
    estimated, true = (
        forward_trials(gantry, values, solution.q[None]).T[..., :3, 3]
        for values in (fits.values, truth)
    )
    errors = np.linalg.norm(estimated - true, axis=2)
    size = float(np.sqrt((errors**2).mean()))
    # one error of each machine: three standard deviations of its rms over 240 machines
    assert budget.position.rms == pytest.approx(size, rel=3.0 / np.sqrt(2.0 * MACHINES))
    assert budget.position.common > 0.95 * sum(budget.position)
    U = pose_uncertainty(fit, forward(fit.robot, solution.q)).expanded_position
    assert (errors <= U).mean() >= 0.93
    # a noise that is stated twice too large says nothing of the scale
    (rows,) = data.observations
    coarse = replace(data, observations=(replace(rows, covariance=4.0 * rows.covariance),))
    fit = identify(gantry, coarse, MAP())
    assert fit.residual_test.sigma_scale < 0.7
    U = pose_uncertainty(fit, forward(fit.robot, solution.q)).expanded_position
    assert (errors <= U).mean() >= 0.93
    wide = find_budget(fit, coarse).position.rms
    assert wide == pytest.approx(size, rel=3.0 / np.sqrt(2.0 * MACHINES))
    # without the statement nothing contains them
    unstated = replace(data, observations=(replace(rows, kind=rows.kind.without_shared_errors()),))
    plain = identify(gantry, unstated, MAP())
    assert find_budget(plain, unstated).position.rms < 0.1 * size


def find_budget(fit: Identification, data: Measurements, frame: str = "fitted") -> ErrorBudget:
    """Return the error budget of a fit that has one."""
    budget = compute_error_budget(fit, data, frame)
    assert budget is not None
    return budget


def fit_rigid_motion(errors: np.ndarray, reference: np.ndarray, T: np.ndarray, T_ref: np.ndarray):
    """Return errors at poses T after the best rigid motions of base and platform, fitted to those
    at T_ref; rotations count times the robot's size.
    """

    def motions(poses: np.ndarray) -> np.ndarray:
        tool, R = (poses @ robot().tool)[:, :3, 3], poses[:, :3, :3]
        eye, zero = np.broadcast_to(np.eye(3), R.shape), np.zeros(R.shape)
        arm = R @ robot().tool[:3, 3]
        return np.block(
            [[eye, zero, R, zero], [-geometry.hat(tool), eye, -geometry.hat(arm) @ R, R]]
        )

    weight = np.r_[[robot().size] * 3, [1.0] * 3]
    A = (motions(T_ref) * weight[:, None]).reshape(-1, 12)
    b = (reference * weight).reshape(len(reference), -1)
    motion = np.linalg.lstsq(A, b.T)[0]
    return errors - (motions(T) @ motion).transpose(2, 0, 1)


def test_unknown_targets_and_frame_add_what_fits_with_known_ones_lack():
    """The same measurements, fitted with the setup unknown and stated; errors are those after the
    best rigid fit over the measured poses.
    """
    unknown = Position(targets=("a",), places=THREE[:1], unknown=("frame", "targets"))
    known = Position(targets=("a",), places=THREE[:1])
    errors, budgets, readings = {}, {}, workspace_readings()
    for name, kind in (("unknown", unknown), ("known", known)):
        truth, trials = measure_trials(Sensor(kind, noise(*[10 * UM] * 3)))
        fits = identify_trials(robot(), trials, MAP())
        assert fits.converged.all()
        poses, places = (
            forward_trials(robot(), robot().values[None], q[None]).T[0]
            for q in (readings, trials.readings)
        )
        errors[name] = rms(
            fit_rigid_motion(
                true_errors(fits.values, truth, readings),
                true_errors(fits.values, truth, trials.readings),
                poses,
                places,
            )
        )
        budgets[name] = find_budget(identify(robot(), trials.trial(0), MAP()), trials.trial(0))
    budget = budgets["unknown"]
    for i, sources in enumerate((budget.position, budget.orientation)):
        without = sum(sources) - sources.setup
        assert sources.rms == pytest.approx(errors["unknown"][i], rel=AGREEMENT)
        assert np.sqrt(without) == pytest.approx(errors["known"][i], rel=AGREEMENT)
        assert sources.setup > 0.1 * without


@pytest.mark.parametrize("method", [MAP(), LeastSquares()], ids=["MAP", "least squares"])
def test_without_noise_what_few_poses_do_not_determine_keeps_its_tolerance(method):
    """Four poses of six values leave 18 of 42 combinations open; noise is 1 nm."""
    sensor = Sensor(Pose(), Gaussian(np.full(6, 1e-9)))
    truth = sample_truth(robot(), MACHINES, 5)
    trials = simulate_trials(robot(), truth, measured_poses(4), Instrument((sensor,)), 5)
    options = FitOptions(method=method, allow_fewer_equations=True)
    fits = identify_trials(robot(), trials, options=options)
    assert fits.converged.all()
    data = trials.trial(0)
    fit = identify(robot(), data, options=options)
    assert fit.rank == 24
    budget = find_budget(fit, data)
    true = rms(true_errors(fits.values, truth, workspace_readings()))
    for sources, error in zip((budget.position, budget.orientation), true, strict=True):
        assert sources.rms == pytest.approx(error, rel=AGREEMENT)
        assert sources.tolerances > 0.999 * sum(sources)


def test_start_values_that_rows_do_not_change_have_no_part_in_the_budget():
    """Of a position of 3.5 um, the instrument had 1.9 or 2.1 um; without start values it is 3.0."""
    machine = lc.load_robot("five-bar")
    places = np.array([[0.1, 0.0, 0.02], [-0.05, 0.08, 0.02]])
    station = geometry.make_pose(geometry.exp_so3(np.array([0.1, -0.2, 0.7])), np.ones(3))
    unknown = ("frame", "targets")
    kind = Position(targets=("a", "b"), places=places, T_base_frame=station, unknown=unknown)
    session = np.repeat(["first", "second"], 12)
    sensor = Sensor(kind, Gaussian(np.full(6, 10 * UM)), session=session)
    commanded = sample_workspace(machine, 24, 0).coordinates
    data = simulate(machine, commanded, Instrument((sensor,)), 0)
    fit = identify(machine, data)
    setup = linearize_fit(fit, data).linearization.nuisance
    assert setup is not None
    null, first = setup.elimination.null_directions(), find_budget(fit, data)
    assert null.shape[1] == 6  # both frames may move with their targets along any axis
    for change in np.random.default_rng(5).normal(0.0, 0.1, (2, 6)):
        moved = replace(fit.nuisance, estimate=fit.nuisance.estimate + null @ change)
        other = find_budget(replace(fit, nuisance=moved), data)
        np.testing.assert_allclose(other.position, first.position, rtol=1e-5)


def test_readings_of_a_known_machine_leave_their_repeatability():
    entries = tuple(replace(p, tolerance=1e-12) for p in robot().parameters.entries)
    actuators = tuple(replace(a, sigma=5 * UM) for a in robot().actuators)
    assembly = replace(robot().assembly, actuators=actuators)
    machine = replace(robot(), parameters=ParameterTable(entries), assembly=assembly)
    sensor = Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
    data = simulate(machine, measured_poses(30), Instrument((sensor,)), 1)
    budget = find_budget(identify(machine, data, MAP()), data)
    readings = workspace_readings()
    drawn = readings + 5 * UM * np.random.default_rng(0).standard_normal((40, *readings.shape))
    states = forward_trials(machine, machine.values[None], drawn.reshape(1, -1, 6))
    exact = forward_trials(machine, machine.values[None], readings[None])
    poses = states.T[0].reshape(*drawn.shape[:2], 4, 4) @ machine.tool
    errors = poses[..., :3, 3] - (exact.T[0] @ machine.tool)[:, :3, 3]
    true = np.sqrt((errors**2).sum(axis=-1).mean())
    assert budget.position.rms == pytest.approx(true, rel=0.03)  # 8000 draws
    assert budget.position.repeatability > 0.999 * sum(budget.position)


def test_fits_that_contradict_the_noise_or_have_no_intervals_state_no_expected_error():
    sensor = Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
    data = simulate(robot(), measured_poses(30), Instrument((sensor,)), 1)
    (rows,) = data.observations
    optimistic = replace(data, observations=(replace(rows, covariance=rows.covariance / 25.0),))
    report = lc.calibrate(robot(), optimistic)
    assert report.identification.residual_test.failed
    assert report.budget is not None  # the parts of intervals that the residuals made wider
    assert not report.states_expected_error
    assert "Expected error" not in str(report)
    few = data.take(np.arange(8))
    fit = identify(robot(), few, LeastSquares(), options=FitOptions(noise="estimated"))
    assert (compute_error_budget(fit, few) is None) is not fit.residual_test.intervals


def test_without_a_workspace_the_errors_are_those_at_the_measured_poses():
    assembly = replace(robot().assembly, workspace={})
    sensor = Sensor(Pose(), noise(*[50 * URAD] * 3, *[10 * UM] * 3))
    data: Measurements = simulate(robot(), measured_poses(30), Instrument((sensor,)), 1)
    machine = replace(robot(), assembly=assembly)
    budget = find_budget(identify(machine, data), data)
    assert (budget.is_workspace, budget.poses) == (False, 30)
    assert "at the measured poses" in str(budget)
    assert "over the workspace" in str(compute_error_budget(identify(robot(), data), data))
