# SPDX-License-Identifier: Apache-2.0
"""The block bootstrap: resamples against fits one by one and dense algebra, and what it finds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.optimize import least_squares

import loopcal as lc
from loopcal.diagnose.bootstrap import Clusters, compute_block_errors
from loopcal.errors import EstimationError
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.prior import prior_from
from loopcal.estimate.resampling import Resamples, fit_resamples
from loopcal.measure.readings import fill_in_reading_sigma
from tests.diagnose.test_cluster_covariance import (
    EIGHT_TARGETS,
    KNOWN_POSE,
    THREE_TARGETS,
    measure,
    stack_rows,
)
from tests.estimate.problems import UM, hexapod, hexapod_data
from tests.estimate.uncertain_reading_problems import simulate_hexapod

CASES = {
    "targets": lambda: measure(THREE_TARGETS, 20, 3),
    "sessions with a frame each": lambda: measure(THREE_TARGETS, 20, 3, sessions=5),
    "uncertain readings": lambda: simulate_hexapod(16, 2 * UM),
}


def linear_delta(poses: int = 14, seed: int = 0) -> tuple[lc.Mechanism, lc.Measurements]:
    """Return the shipped delta and positions of a machine drawn from its spreads."""
    robot = lc.load_robot("linear-delta")
    truth = robot.with_values(lc.sample_truth(robot, 1, seed)[0])
    sensor = lc.Sensor(lc.Component(("x", "y", "z")), lc.Gaussian(np.full(3, 20 * UM)))
    commanded = lc.sample_workspace(robot, poses, seed).coordinates
    return robot, lc.simulate(truth, commanded, lc.Instrument((sensor,)), seed)


def draw_weights(count: int, poses: int, seed: int = 1) -> np.ndarray:
    """Multinomial weights (count, poses)."""
    rng = np.random.default_rng(seed)
    return rng.multinomial(poses, np.full(poses, 1.0 / poses), count).astype(float)


@pytest.mark.parametrize("case", CASES)
def test_weighted_resamples_equal_their_own_fits(case) -> None:
    data = CASES[case]()
    fit = identify(hexapod(), data, lc.MAP())
    data = fill_in_reading_sigma(hexapod(), data)
    linear, weight = linearize_fit(fit, data), 0.5 + draw_weights(3, data.n_poses)
    p, U = len(fit.names), len(fit.nuisance)
    equations = np.repeat(linear.linearization.equations, 3)
    fits = fit_resamples(
        linear, Resamples(weight, None, np.zeros((3, p)), None, np.zeros((3, U)), equations)
    )
    assert fits.converged.all()
    for i in range(3):
        own = identify(hexapod(), data.with_weights(weight[i]), lc.MAP())
        values = fit.nominal + fit.tolerance * fits.deviation[i]
        assert values == pytest.approx(own.estimate, abs=2e-4 * fit.standard_deviations.min())


def test_resampled_errors_equal_a_scipy_fit_to_changed_values() -> None:
    robot, data = linear_delta()
    fit = identify(robot, data, lc.LeastSquares())
    linear = linearize_fit(fit, data)
    blocks = Clusters("pose", np.arange(data.n_poses), data.n_poses)
    errors = compute_block_errors(linear, blocks, np.zeros(len(fit.names)))
    rng = np.random.default_rng(4)
    (offset,) = errors.draw(rng.choice([-1.0, 1.0], (2, data.n_poses)), 1.0, rng)
    p = len(fit.names)
    equations = np.repeat(linear.linearization.equations, 2)
    fits = fit_resamples(
        linear, Resamples(None, (offset,), np.zeros((2, p)), None, np.zeros((2, 0)), equations)
    )
    (rows,) = data.observations
    places = fit.free_parameters.places
    for i in range(2):
        measured = rows.measured - offset[i] * 20 * UM

        def residual(z: np.ndarray, measured: np.ndarray = measured) -> np.ndarray:
            values = robot.values.copy()
            values[places] = fit.nominal + fit.tolerance * z
            T = lc.forward(robot.with_values(values), data.readings).T
            return ((T[:, :3, 3] - measured) / (20 * UM)).ravel()

        scipy_fit = least_squares(
            residual, fits.deviation[i], x_scale="jac", xtol=1e-15, ftol=1e-15
        )
        step = np.abs(scipy_fit.x - fits.deviation[i]) * fit.tolerance
        assert (step < 1e-3 * fit.standard_deviations).all()


@pytest.mark.parametrize("sessions", [0, 5])
def test_errors_of_blocks_are_corrected_by_the_dense_hat_matrix(sessions) -> None:
    data = measure(KNOWN_POSE, 15, 2, sessions)
    fit = identify(hexapod(), data, lc.LeastSquares())
    member = np.arange(15) * (sessions or 15) // 15
    blocks = Clusters("unit", member, int(member.max()) + 1)
    linear = linearize_fit(fit, data)
    errors = compute_block_errors(linear, blocks, np.zeros(len(fit.names)))
    J, r = stack_rows(fit, data)
    J = J / np.linalg.norm(J, axis=0)
    H = J @ np.linalg.pinv(J)
    owner = np.repeat(member, 6)
    for g in range(blocks.count):
        rows = np.flatnonzero(owner == g)
        root = np.linalg.inv(np.real(sqrtm(np.eye(len(rows)) - H[np.ix_(rows, rows)])))
        assert errors.error[rows] == pytest.approx(root @ r[rows], abs=2e-4)
        assert errors.residual[rows] == pytest.approx(r[rows], abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("count", [100, pytest.param(300, marks=pytest.mark.evidence)])
@pytest.mark.parametrize("case", [*CASES, "earlier calibration", "prior of the frame", "ridge"])
def test_normal_errors_scatter_as_the_covariance_says(case, count) -> None:
    options, method = FitOptions(sigma_uncertainty=0.0), lc.MAP()
    data = CASES[case]() if case in CASES else hexapod_data(15, seed=5)
    if case == "earlier calibration":
        earlier = identify(hexapod(), hexapod_data(20), lc.MAP())
        options = FitOptions(sigma_uncertainty=0.0, prior=prior_from(earlier.posterior))
        method = lc.LeastSquares()
    if case == "prior of the frame":
        data = CASES["targets"]()
        known = data.nuisance_parameters.with_prior("frame.*", 20 * UM)
        options, method = FitOptions(sigma_uncertainty=0.0, nuisance=known), lc.LeastSquares()
    if case == "ridge":
        method = lc.Ridge(3.0)
    fit = identify(hexapod(), data, method, options=options)
    result = lc.bootstrap(fit, data, count, scheme="normal")
    assert result.failed == 0
    stated = linearize_fit(fit, fill_in_reading_sigma(hexapod(), data))
    if case == "ridge":  # the covariance of the estimate alone, without its bias
        d, lam = stated.decomposition, stated.penalty
        part = d.noise_roots(lam)[0]
        sd = np.sqrt((part**2).sum(axis=1)) * fit.tolerance
    else:
        sd = fit.standard_deviations
    ratio = result.standard_deviations / sd
    error = 1.0 / np.sqrt(2 * count)  # standard deviation of one ratio: 4 % of 300 draws
    assert np.median(ratio) == pytest.approx(1.0, abs=1.22 * error)
    assert ratio == pytest.approx(1.0, abs=4.9 * error)
    center = (result.draws.mean(axis=0) - fit.estimate) / sd
    assert np.abs(center).max() < 4.0 / np.sqrt(count)


def test_the_same_seed_gives_the_same_resamples_and_another_one_others() -> None:
    robot, data = linear_delta()
    fit = identify(robot, data)
    first, again, other = (lc.bootstrap(fit, data, 40, seed=seed).draws for seed in (1, 1, 2))
    assert (first == again).all()
    assert not (first == other).any()


@pytest.mark.slow
def test_errors_that_the_targets_of_a_pose_share_are_reported_and_widen_the_intervals() -> None:
    shared = measure(EIGHT_TARGETS, 30, 1, common=30 * UM)
    fit = identify(hexapod(), shared, lc.MAP(), options=FitOptions(noise="estimated"))
    result = lc.bootstrap(fit, shared, 80)
    assert (result.blocks.unit, result.blocks.count) == ("pose", 30)
    (finding,) = [f for f in result.findings if f.code == "sampling.scatter-differs"]
    assert finding.data["ratio"] > 1.5
    intervals = result.intervals()
    ratio = (intervals.upper - intervals.lower) / (2.0 * fit.interval())
    assert np.median(ratio) > 1.2
    sessions = measure(KNOWN_POSE, 40, 1, sessions=14)
    own = lc.bootstrap(identify(hexapod(), sessions), sessions, 10)
    assert (own.blocks.unit, own.blocks.count) == ("session", 14)


@pytest.mark.slow
def test_independent_errors_are_not_reported_in_99_percent_of_fits() -> None:
    reported = 0
    for seed in range(8):
        robot, data = linear_delta(14, seed)
        fit = identify(robot, data, lc.LeastSquares())
        codes = [f.code for f in lc.bootstrap(fit, data, 60, seed=seed).findings]
        reported += "sampling.scatter-differs" in codes or "sampling.bootstrap-differs" in codes
    assert reported <= 1  # level 1 % each: more than 1 of 8 has a probability of 0.3 %


def test_wrong_input_is_refused_with_what_is_allowed() -> None:
    robot, data = linear_delta()
    fit = identify(robot, data)
    for arguments, text in (
        ({"scheme": "jackknife"}, "one of 'wild', 'pairs', 'normal'"),
        ({"count": 1}, "at least 2"),
        ({"unit": "day"}, "14 poses"),
        ({"unit": 14}, "at least 5 blocks of the unit '14-pose run'"),
        ({"unit": 5}, "at least 5 blocks of the unit '5-pose run'"),
        ({"unit": "month"}, "'month', but must be one of pose, block, session, day"),
        ({"unit": 0}, "at least 1"),
        ({"scheme": "pairs"}, "Use the scheme 'wild'"),
    ):
        with pytest.raises(EstimationError, match=text):
            lc.bootstrap(fit, data, **{"count": 10, **arguments})
    with pytest.raises(EstimationError, match="one of 'widened', 'percentile'"):
        lc.bootstrap(fit, data, 10).intervals(kind="normal")  # pyright: ignore[reportArgumentType]
    stopped = identify(robot, data, options=FitOptions(control=lc.StepControl(iterations=0)))
    with pytest.raises(EstimationError, match="did not converge"):
        lc.bootstrap(stopped, data, 10)
    truncated = identify(robot, data, lc.TruncatedSVD(5))
    with pytest.raises(EstimationError, match="has no uncertainties"):
        lc.bootstrap(truncated, data, 10)


def test_a_penalty_without_a_prior_is_reported() -> None:
    robot, data = linear_delta()
    fit = identify(robot, data, lc.Ridge(1.0))
    codes = [finding.code for finding in lc.bootstrap(fit, data, 30).findings]
    assert "sampling.bias-not-drawn" in codes


@pytest.mark.parametrize("number", [int, np.int64, np.uint8])
def test_consecutive_poses_are_resampled_together_in_the_order_of_time(number) -> None:
    robot, data = linear_delta()
    time = np.arange(14.0)[::-1].copy()
    fit = identify(robot, data)
    (rows,) = data.observations
    timed = replace(data, observations=(replace(rows, context={"time": time}),))
    blocks = lc.bootstrap(fit, timed, 10, unit=number(3)).blocks
    assert blocks.count == 5  # from the last pose on, which is the earliest
    assert blocks.member[13] == blocks.member[11] != blocks.member[10]
    assert blocks.member[0] == blocks.member[1] != blocks.member[2]


@pytest.mark.parametrize("kind", ["widened", "percentile", "bias-corrected", "studentized"])
def test_each_kind_of_interval_contains_the_estimate_and_keeps_its_level(kind) -> None:
    robot, data = linear_delta(30)
    fit = identify(robot, data, lc.LeastSquares())
    result = lc.bootstrap(fit, data, 300, scheme="normal")
    wide, narrow = result.intervals(0.95, kind), result.intervals(0.68, kind)
    assert ((wide.lower < fit.estimate) & (fit.estimate < wide.upper)).all()
    ratio = (narrow.upper - narrow.lower) / (wide.upper - wide.lower)
    assert np.median(ratio) == pytest.approx(0.507, abs=0.05)
