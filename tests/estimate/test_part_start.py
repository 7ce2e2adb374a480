# SPDX-License-Identifier: Apache-2.0
"""Fits of very many poses that begin with a part of them end where the plain ones do."""

from dataclasses import replace

import numpy as np
import pytest

import loopcal.estimate.pose_rows as blocks_module
from loopcal.diagnose.fit_examination import check_start_values
from loopcal.errors import EstimationError
from loopcal.estimate import fit_descent as module
from loopcal.estimate import information
from loopcal.estimate.descent import StepControl
from loopcal.estimate.fit_descent import FEWEST_POSES, SHARE, select_part, spread_poses
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares, TruncatedSVD
from loopcal.estimate.pose_rows import BLOCK
from loopcal.estimate.prior import prior_from
from loopcal.estimate.problem import problem_of, problem_of_trials
from loopcal.estimate.result import Identification
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.distance import Separation
from loopcal.measure.kinds.joints import JointSensor
from loopcal.measure.kinds.kind import Kind
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace

DELTA = load_robot("linear-delta")
MANY = FEWEST_POSES // 8
"""Poses from which on a fit begins with a part; the tests change `FEWEST_POSES` to this."""
PART = MANY // SHARE
SIGMA = 1e-5  # [m]


def make_sensor(kind: Kind, rows: np.ndarray | None = None) -> Sensor:
    """Return a sensor with the same noise [m or rad] on each column."""
    return Sensor(kind, Gaussian(np.full(len(kind.noise_columns), SIGMA)), rows)


POINTS = make_sensor(Component(("x", "y", "z")))


def measure(
    poses: np.ndarray,
    sensors: tuple[Sensor, ...] = (POINTS,),
    seed: int = 0,
    truth: Mechanism | None = None,
) -> Measurements:
    """Return measurements at poses of a machine; default: one drawn from the spreads."""
    if truth is None:
        truth = DELTA.with_values(sample_truth(DELTA, 1, 0)[0])
    return simulate(truth, poses, Instrument(sensors), seed)


def list_poses(n: int = MANY) -> np.ndarray:
    """Return the coordinates of n poses, of which each 500 are the same."""
    return np.resize(sample_workspace(DELTA, 500, 1).coordinates, (n, len(DELTA.controlled)))


@pytest.fixture(autouse=True)
def _eight_times_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FEWEST_POSES", MANY)


@pytest.fixture(scope="module")
def data() -> Measurements:
    """Measured positions of a delta with 9 parameters."""
    return measure(list_poses())


def fit_both(
    monkeypatch: pytest.MonkeyPatch, data: Measurements, options: FitOptions
) -> tuple[Identification, Identification]:
    """Return the fit, and the one that begins with all poses."""
    fit = identify(DELTA, data, options=options)
    monkeypatch.setattr(module, "fit_part_first", lambda *_: None)
    return fit, identify(DELTA, data, options=options)


def check_same_bits(fit: Identification, plain: Identification) -> None:
    """Compare two fits, and their iterations, bit for bit."""
    assert np.array_equal(fit.robot.values, plain.robot.values)
    assert np.array_equal(fit.history.cost, plain.history.cost)
    assert fit.history.status == plain.history.status
    assert fit.history.iterations == plain.history.iterations


@pytest.mark.slow
@pytest.mark.parametrize("method", [LeastSquares(), MAP(), None], ids=repr)
def test_the_result_is_that_of_all_poses_from_the_beginning(monkeypatch, data, method):
    fit, plain = fit_both(monkeypatch, data, FitOptions(method=method))
    assert fit.converged
    assert plain.converged
    assert len(fit.history.cost) != len(plain.history.cost)  # it did begin with a part
    sigma = np.sqrt(np.diag(plain.covariance))
    # steps end where they change the residuals by less than 1e-6 of their norm, here 3e-4 standard
    # deviations; the error is the next one of a quadratic convergence
    assert (np.abs(fit.estimate - plain.estimate) < 1e-6 * sigma).all()
    difference = (fit.covariance - plain.covariance) / np.outer(sigma, sigma)
    np.testing.assert_allclose(difference, 0.0, atol=1e-7)  # linear in that error
    np.testing.assert_allclose(fit.history.cost[-1], plain.history.cost[-1], rtol=1e-10)
    np.testing.assert_allclose(
        fit.residuals[0].raw, plain.residuals[0].raw, rtol=0, atol=1e-6 * SIGMA
    )


def test_the_history_has_the_steps_of_the_part_with_comparable_sums_of_squares(monkeypatch, data):
    said: list[str] = []
    fit = identify(DELTA, data, LeastSquares(), progress=lambda *parts: said.append(parts[2]))
    monkeypatch.setattr(module, "fit_part_first", lambda *_: None)
    plain = identify(DELTA, data, LeastSquares())
    history = fit.history
    assert history.iterations == len(history.cost) - 1 == len(history.estimate) - 1
    np.testing.assert_array_equal(history.estimate[0], plain.history.estimate[0])
    np.testing.assert_array_equal(history.estimate[-1], fit.estimate)
    # sums of the same squares, in another order
    np.testing.assert_allclose(history.cost[0], plain.history.cost[0], rtol=1e-10)
    # 1536 residuals of the part: 10 standard deviations of their mean square, sqrt(2 / 1536)
    np.testing.assert_allclose(history.cost[-3:], plain.history.cost[-1], rtol=0.36)
    assert any(f"({PART} of {MANY} poses)" in text for text in said)
    assert "poses)" not in said[-1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_the_truth_as_a_start_is_judged_as_without_a_part(monkeypatch, seed):
    measured = measure(list_poses(), seed=seed, truth=DELTA)
    fit, plain = fit_both(monkeypatch, measured, FitOptions(method=LeastSquares()))
    assert len(fit.history.cost) != len(plain.history.cost)
    # sums of the same squares, in another order
    np.testing.assert_allclose(fit.history.cost[0], plain.history.cost[0], rtol=1e-10)
    check, expected = check_start_values(fit), check_start_values(plain)
    assert check.verdict is expected.verdict
    # both ends of the gain are sums of 2e5 squares with rounding of 1e-10; the gain is about 10
    np.testing.assert_allclose(check.p_value, expected.p_value, atol=1e-4)


@pytest.mark.slow
def test_both_descents_together_take_the_steps_that_are_allowed(monkeypatch, data):
    def limit(iterations: int) -> FitOptions:
        return FitOptions(method=LeastSquares(), control=StepControl(iterations=iterations))

    fit = identify(DELTA, data, LeastSquares())
    steps = fit.history.iterations  # the last one is taken without another evaluation
    check_same_bits(identify(DELTA, data, options=limit(steps - 1)), fit)
    check_same_bits(*fit_both(monkeypatch, data, limit(steps - 2)))


@pytest.mark.parametrize("period", [2, 3, 10, 49, 50, 100, 160])
def test_spread_poses_take_all_phases_of_what_repeats(period):
    n = 100_000
    poses = spread_poses(n, BLOCK)
    assert len(np.unique(poses)) == BLOCK
    assert poses.min() >= 0
    assert poses.max() < n
    assert (np.diff(poses) > 0).all()
    count = np.bincount(poses % period, minlength=period)
    assert (count > 0.3 * BLOCK / period).all()  # an even stride of 49 takes one phase of 49


def test_poses_that_are_degenerate_at_even_strides_give_a_part_of_full_rank(monkeypatch):
    poses = list_poses()
    poses[::SHARE] = poses[0]
    fit, plain = fit_both(monkeypatch, measure(poses), FitOptions(method=LeastSquares()))
    assert len(fit.history.cost) != len(plain.history.cost)
    sigma = np.sqrt(np.diag(plain.covariance))
    assert (np.abs(fit.estimate - plain.estimate) < 1e-6 * sigma).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        FitOptions(method=LeastSquares(), loss=Huber()),
        FitOptions(method=TruncatedSVD(6)),
        FitOptions(method=LeastSquares(), control=StepControl(iterations=1)),
        FitOptions(method=LeastSquares(), begin="closure"),
    ],
    ids=["loss", "chosen-rank", "out-of-steps", "closure"],
)
def test_other_fits_begin_with_all_poses(monkeypatch, data, options):
    check_same_bits(*fit_both(monkeypatch, data, options))


def test_a_fit_with_an_earlier_calibration_begins_with_all_poses(monkeypatch, data):
    earlier = identify(DELTA, measure(list_poses(40), seed=1), LeastSquares())
    options = FitOptions(method=LeastSquares(), prior=prior_from(earlier.posterior))
    check_same_bits(*fit_both(monkeypatch, data, options))


def test_a_part_that_does_not_determine_all_parameters_is_not_used(monkeypatch):
    poses = list_poses()
    others = np.setdiff1d(np.arange(MANY), spread_poses(MANY, PART))
    poses[np.setdiff1d(np.arange(MANY), others[:300])] = poses[0]  # 300 poses that are no part
    fit, plain = fit_both(monkeypatch, measure(poses), FitOptions(method=LeastSquares()))
    assert plain.spectrum.rank == len(plain.free_parameters)
    check_same_bits(fit, plain)


def test_parts_are_only_of_many_poses_that_readings_determine(data):
    free = select_free_parameters(DELTA)
    part = select_part(problem_of(free, data))
    assert part is not None
    assert part.readings.shape[1] == PART
    assert (part.equations == 3 * PART).all()
    few = problem_of(free, measure(list_poses(MANY - 1)))
    position = make_sensor(Position(unknown=("frame",)))
    frame = problem_of(free, measure(list_poses(), (position,)))
    uncertain = problem_of(free, replace(data, reading_sigma=np.full_like(data.readings, 1e-6)))
    for problem in (few, frame, uncertain):
        assert select_part(problem) is None


def test_parts_are_only_of_rows_that_each_pose_and_the_parameters_determine(monkeypatch):
    monkeypatch.setattr(module, "SHARE", 2)
    monkeypatch.setattr(module, "FEWEST_POSES", 2 * BLOCK)
    poses, free = list_poses(2 * BLOCK), select_free_parameters(DELTA)
    linked = make_sensor(Separation(), np.array([[0, 1], [5, BLOCK]]))
    assert select_part(problem_of(free, measure(poses))) is not None
    assert select_part(problem_of(free, measure(poses, (POINTS, linked)))) is None
    truths = np.repeat(DELTA.values[None], 2, axis=0)
    trials = simulate_trials(DELTA, truths, poses, Instrument((POINTS,)), 0)
    problem = problem_of_trials(free, trials)
    assert select_part(problem) is None
    assert select_part(problem.take(np.array([0]))) is not None


def test_parts_are_not_of_measured_passive_joints(monkeypatch):
    monkeypatch.setattr(module, "SHARE", 2)
    monkeypatch.setattr(module, "FEWEST_POSES", 2 * BLOCK)
    robot = load_robot("3-prs")
    poses = np.resize(
        sample_workspace(robot, 50, 1).coordinates, (2 * BLOCK, len(robot.controlled))
    )
    passive = inverse(robot, poses[:1]).passive_names[0]
    full, joint = make_sensor(Pose()), JointSensor(joints=(passive,), measures="angle")
    free = select_free_parameters(robot)
    assert select_part(problem_of(free, measure(poses, (full,), truth=robot))) is not None
    sensed = measure(poses, (full, make_sensor(joint)), truth=robot)
    assert select_part(problem_of(free, sensed)) is None


@pytest.mark.parametrize("name", ["arm-6r", "pulley-3"])
def test_parts_are_not_of_chains_of_stages_or_open_sums(monkeypatch, name):
    monkeypatch.setattr(module, "SHARE", 2)
    monkeypatch.setattr(module, "FEWEST_POSES", 2 * BLOCK)
    robot = load_robot(name)
    assert robot.stages or robot.has_open_sums
    poses = np.resize(
        sample_workspace(robot, 50, 1).coordinates, (2 * BLOCK, len(robot.controlled))
    )
    measured = measure(poses, (make_sensor(Component(("x", "y"))),), truth=robot)
    assert select_part(problem_of(select_free_parameters(robot), measured)) is None


@pytest.mark.parametrize(
    ("robot", "kind", "count"), [(DELTA, Position(), 6), (load_robot("hexapod-42"), Pose(), 0)]
)
def test_motions_of_frames_are_those_that_all_rows_leave_open(monkeypatch, robot, kind, count):
    monkeypatch.setattr(blocks_module, "EXACT_BLOCK", BLOCK)  # two blocks of poses
    poses = np.resize(sample_workspace(robot, 500, 1).coordinates, (3000, len(robot.controlled)))
    noise = Gaussian(np.full(len(kind.noise_columns), SIGMA))
    measured = simulate(robot, poses, Instrument((Sensor(kind, noise),)), 0)
    folded: list[int] = []
    fold = information.FrameRows.add_rows
    monkeypatch.setattr(
        information.FrameRows, "add_rows", lambda *parts: (folded.append(1), fold(*parts))
    )
    fit = identify(robot, measured, LeastSquares())
    assert fit.posterior.frames is not None
    assert len(folded) == (2 if count else 1)  # where all motions are fixed, no more rows are
    monkeypatch.setattr(information, "FIXED", np.inf)
    plain = identify(robot, measured, LeastSquares())
    assert plain.posterior.frames is not None
    unfixed, expected = fit.posterior.frames.unfixed, plain.posterior.frames.unfixed
    assert expected.shape[1] == count
    np.testing.assert_allclose(unfixed @ unfixed.T, expected @ expected.T, atol=1e-12)


@pytest.mark.slow
def test_a_start_out_of_reach_is_refused_as_without_a_part(monkeypatch):
    measured = measure(list_poses())
    options = FitOptions(method=LeastSquares(), start=3.0 * DELTA.values)
    with pytest.raises(EstimationError, match="poses"):
        identify(DELTA, measured, options=options)


@pytest.mark.slow
def test_poses_out_of_reach_that_are_not_in_the_part_are_refused_as_without_it(monkeypatch):
    poses, values = sample_workspace(DELTA, 500, 1).coordinates, DELTA.values.copy()
    lengths = [i for i, name in enumerate(DELTA.parameters.names) if "length" in name]
    readings, reached = measure(poses, truth=DELTA).readings, np.ones(len(poses), dtype=bool)
    while reached.all():  # shorter rods until some poses are out of reach
        values[lengths] *= 0.99
        reached = forward(DELTA.with_values(values), readings).converged
    assert reached.any()
    others = np.setdiff1d(np.arange(MANY), spread_poses(MANY, PART))[:5]
    mixed = np.resize(poses[reached], (MANY, 3))
    mixed[others] = np.resize(poses[~reached], (5, 3))
    measured, options = measure(mixed, truth=DELTA), FitOptions(LeastSquares(), start=values)
    with pytest.raises(EstimationError, match="5 of") as refused:
        identify(DELTA, measured, options=options)
    monkeypatch.setattr(module, "fit_part_first", lambda *_: None)
    with pytest.raises(EstimationError) as expected:
        identify(DELTA, measured, options=options)
    assert str(refused.value) == str(expected.value)
