# SPDX-License-Identifier: Apache-2.0
"""Outliers: robust losses, leverage, leave-one-block-out without refits, and a false-alarm rate
for the whole data set.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, chi2

from loopcal.diagnose import outliers
from loopcal.diagnose import outliers as outlier_search
from loopcal.diagnose.fit_examination import examine_fit
from loopcal.diagnose.outliers import (
    Influence,
    OutlierCheck,
    PartialFit,
    _summarize,
    compute_influence,
    find_ambiguous,
    find_outliers,
    fit_without,
    search_blocks,
)
from loopcal.errors import DataError, EstimationError
from loopcal.estimate.free_parameters import select_free_parameters
from loopcal.estimate.identification import identify
from loopcal.estimate.losses import Huber, Tukey, block_limit
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import MAP, LeastSquares
from loopcal.estimate.problem import problem_of
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.poses import Component
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate, simulate_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.decomposition import decompose
from tests import zoo
from tests.diagnose.correlated_data import LENGTH, ROBOTS, measure
from tests.estimate.problems import UM, URAD, hexapod, hexapod_data, hexapod_poses, noise, tracker

SIGMA = np.array([5 * URAD] * 3 + [UM] * 3)  # of `tracker`
NAMED = ("4", "23", "11")


def make_data_with_outliers(seed: int) -> tuple[Measurements, Measurements]:
    """Return forty clean poses, and the same with two rows 20 sigma off and one row of another
    machine.
    """
    clean = hexapod_data(40, seed)
    rows = clean.observations[0]
    measured = np.array(rows.measured)
    rng = np.random.default_rng(seed)
    for pose in (3, 22):
        step = rng.standard_normal(6)
        measured[pose] += 20.0 * step / np.linalg.norm(step) * SIGMA
    # the same machine without its errors of leg length
    other = zoo.hexapod_truth()
    lengths = [i for i, name in enumerate(zoo.hexapod().parameters.names) if "length" in name]
    other[lengths] = zoo.hexapod().values[lengths]
    measured[10] = (
        simulate(zoo.hexapod().with_values(other), hexapod_poses(40, seed), tracker(), seed)
        .observations[0]
        .measured[10]
    )
    return clean, replace(clean, observations=(replace(rows, measured=measured),))


def rms_error(fit) -> float:
    return float(np.sqrt(np.mean((fit.estimate - zoo.hexapod_truth()) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("loss", [Huber(), Tukey()])
def test_robust_fit_with_outliers_is_nearly_as_good_as_a_fit_of_clean_data(loss):
    clean, robust, plain = [], [], []
    for seed in range(3):
        good, bad = make_data_with_outliers(seed)
        clean.append(rms_error(identify(hexapod(), good)))
        fit = identify(hexapod(), bad, loss=loss)
        robust.append(rms_error(fit))
        plain.append(rms_error(identify(hexapod(), bad)))
        assert all(fit.pose_weights[int(name) - 1] < 0.5 for name in NAMED)
    ratio = np.sqrt(np.mean(np.square(robust)) / np.mean(np.square(clean)))
    assert ratio < 1.3
    assert np.sqrt(np.mean(np.square(plain)) / np.mean(np.square(clean))) > 2.0


@pytest.mark.parametrize("loss", [None, Huber(), Tukey()])
@pytest.mark.parametrize("method", [LeastSquares(), None])
def test_outliers_are_named_but_not_excluded(loss, method):
    _, bad = make_data_with_outliers(0)
    fit = identify(hexapod(), bad, method, loss=loss)
    result = find_outliers(fit, bad)
    assert set(result.names) == set(NAMED)
    assert result.influence.leverage.sum() / 240 < 0.3
    (summary,) = result.summary
    assert summary.code == "outliers.some"
    assert (summary.data["count"], summary.data["blocks"]) == (3, 40)
    assert result.outliers[0].finding.data["poses"] == result.outliers[0].poses
    assert fit.residual_test.degrees in {240 - 42, 240} or loss is not None
    fitted = identify(hexapod(), bad, method, options=FitOptions(excluded_poses=result.names))
    assert set(fitted.options.excluded_poses) == set(NAMED)
    assert any(f.code == "fit.excluded-poses" for f in fitted.findings)
    assert find_outliers(fitted, bad).outliers == ()


@pytest.mark.parametrize("method", [LeastSquares(), MAP()])
def test_deleted_residual_equals_that_of_a_refit_without_the_block(method):
    # one linearization: with it the shortcut is exact
    data, free = hexapod_data(12), select_free_parameters(hexapod())
    problem = problem_of(free, data)
    member, z = np.arange(12) // 2, np.zeros((1, 42))  # two poses to a block

    def fitted(weight):
        kept = problem.weighted(weight).linearize(z, problem.start(z))
        d = decompose(kept.factor, kept.equations, z)
        penalty = method.penalty(d)
        return kept, d, penalty, d.deviation(d.solution(penalty))

    whole, d, penalty, at = fitted(np.ones(12))
    result = compute_influence(problem, whole, member, d, [(penalty, at)], np.ones(6))[0]
    parts = [part for block in problem.leverage_rows(whole) for part in block]
    A = np.concatenate([part.rows.reshape(-1, 43) for part in parts])
    for j in range(6):
        own = slice(12 * j, 12 * j + 12)
        if method == LeastSquares():
            held = np.delete(A, np.arange(12 * j, 12 * j + 12), axis=0)
        else:
            held = np.concatenate(
                [np.delete(A, np.arange(12 * j, 12 * j + 12), axis=0), np.eye(42, 43)]
            )
        without = -np.linalg.lstsq(held[:, :-1], held[:, -1], rcond=None)[0]
        residual = A[own, :-1] @ without + A[own, -1]
        G = A[own, :-1] @ np.linalg.inv(held[:, :-1].T @ held[:, :-1]) @ A[own, :-1].T
        expected = residual @ np.linalg.solve(np.eye(12) + G, residual)
        assert result.distance[j] == pytest.approx(expected, rel=1e-6)
        # the same from a fit in which the block has no weight
        outside = (np.arange(6) != j).astype(float)
        kept, d_j, penalty_j, at_j = fitted(outside[member])
        again = compute_influence(problem, kept, member, d_j, [(penalty_j, at_j)], outside)[0]
        assert again.distance[j] == pytest.approx(expected, rel=1e-6)
        assert again.leverage[j] == 0.0
    if method == LeastSquares():
        assert result.leverage.sum() == pytest.approx(42.0)


@pytest.mark.slow
@pytest.mark.parametrize("t", [40, pytest.param(100, marks=pytest.mark.evidence)])
def test_false_alarm_rate_of_clean_data_sets_is_the_stated_one(t):
    robot, alarms = hexapod(), 0
    measured = simulate_trials(robot, sample_truth(robot, t, 8), hexapod_poses(14), tracker(), 8)
    for i in range(t):
        data = measured.trial(i)
        alarms += bool(find_outliers(identify(robot, data, LeastSquares()), data).outliers)
    # 5 % of 100 is 5; outside the central 99.9 % of binomial(t, 0.05) the level is wrong
    assert binom.ppf(0.0005, t, 0.05) <= alarms <= binom.ppf(0.9995, t, 0.05)


def test_estimated_noise_is_not_inflated_by_outliers():
    _, bad = make_data_with_outliers(1)
    claimed = bad.observations[0]
    sharp = replace(bad, observations=(replace(claimed, covariance=claimed.covariance / 9.0),))
    fit = identify(hexapod(), sharp, loss=Huber(), options=FitOptions(noise="estimated"))
    result = find_outliers(fit, sharp)
    assert result.scale == pytest.approx(3.0, rel=0.3)
    assert set(result.names) == set(NAMED)


def test_blocks_are_not_testable_without_degrees_of_freedom():
    data = hexapod_data(7)  # 42 equations, 42 parameters
    result = find_outliers(identify(hexapod(), data, LeastSquares()), data)
    assert result.blocks == 0
    assert [f.code for f in result.summary] == ["outliers.not-testable"]


def test_block_limit_has_the_exceedance_probability_of_a_single_residual():
    np.testing.assert_allclose(block_limit(1.345, np.array([1.0])), 1.345, rtol=1e-9)
    np.testing.assert_allclose(
        chi2.sf(block_limit(4.685, np.array([6.0])) ** 2, 6), chi2.sf(4.685**2, 1), rtol=1e-6
    )
    distance = np.array([0.0, 1.0, 1.345, 2.69, 10.0])
    one = np.ones(5)
    np.testing.assert_allclose(Huber().weight(distance, one), [1.0, 1.0, 1.0, 0.5, 0.1345])
    np.testing.assert_allclose(Tukey().weight(distance, one)[[0, 4]], [1.0, 0.0])
    assert (np.diff(Tukey().weight(distance, one)) < 0.0).all()


def test_unknown_excluded_poses_and_nonpositive_loss_constants_are_refused():
    data = hexapod_data(20)
    with pytest.raises(DataError, match="no pose '99' to exclude"):
        identify(hexapod(), data, options=FitOptions(excluded_poses=("99",)))
    with pytest.raises(DataError, match="Give a sequence of labels"):
        identify(hexapod(), data, options=FitOptions(excluded_poses="12"))
    with pytest.raises(EstimationError, match="Huber loss with constant 0"):
        Huber(0.0)
    with pytest.raises(EstimationError, match="Tukey loss with constant"):
        Tukey(-1.0)


@pytest.mark.slow
@pytest.mark.parametrize("frame", [(), ("frame",)])
def test_distance_of_an_excluded_pose_without_a_reading_equals_the_chi_square_loss(frame):
    """The pose estimate of an excluded pose comes from its rows in the frame of the other poses,
    not from the start of the iteration.
    """
    robot = load_robot("linear-delta")
    truth = robot.with_values(sample_truth(robot, 1, 3)[0])
    coordinates = sample_workspace(robot, 20, 3).coordinates
    instrument = Instrument((Sensor(Position(unknown=frame), noise(*[10 * UM] * 3)),))
    data = simulate(truth, coordinates, instrument, 3, reading_sigma=20 * UM)
    assert data.reading_sigma is not None
    readings, sigma, rows = data.readings.copy(), data.reading_sigma.copy(), data.observations[0]
    readings[7, 0], sigma[7, 0] = np.nan, np.inf
    measured = rows.measured.copy()
    measured[7] += np.array([150 * UM, -150 * UM, 0.0])
    data = replace(
        data,
        readings=readings,
        reading_sigma=sigma,
        observations=(replace(rows, measured=measured),),
    )
    fit = identify(robot, data, LeastSquares(), loss=Tukey())
    assert fit.pose_weights[7] < 0.5  # excluded in the first round
    result = find_outliers(fit, data)
    assert "8" in result.names
    others = tuple(name for name in result.names if name != "8")
    with_it, without = (
        identify(robot, data, LeastSquares(), options=FitOptions(excluded_poses=names))
        for names in (others, result.names)
    )
    # [1] nonlinearity over 0.1 mm
    assert result.influence.distance[7] == pytest.approx(
        with_it.chi_square - without.chi_square, rel=1e-2
    )


def probe_delta(
    points: int, off: dict[int, float], sigma: float = 20 * UM
) -> tuple[Mechanism, Measurements]:
    """Return a delta printer with six free parameters and its heights at `points` of two rings.

    `off` adds errors [m] to some heights.
    """
    robot = load_robot("linear-delta")
    names = ("radius", "tower1.angle", "tower2.angle", "tower1.stop", "tower2.stop", "tower3.stop")
    robot = replace(robot, parameters=robot.parameters.with_free(names))
    turn = np.arange(points - 1) * 2.4  # [rad], so that no two points are opposite
    ring = (
        np.stack([np.cos(turn), np.sin(turn)], axis=1)
        * np.where(np.arange(points - 1) % 2, 0.05, 0.08)[:, None]
    )
    coordinates = np.zeros((points, 3))
    coordinates[1:, :2], coordinates[:, 2] = (
        ring,
        sample_workspace(robot, 20, 3).coordinates[:, 2].mean(),
    )
    heights = Instrument((Sensor(Component(("z",)), noise(sigma)),))
    data = simulate(robot, coordinates, heights, 5)
    rows = data.observations[0]
    measured = rows.measured.copy()
    for place, length in off.items():
        measured[place] += length
    return robot, replace(data, observations=(replace(rows, measured=measured),))


@pytest.mark.parametrize("wrong", range(7))
def test_one_degree_of_freedom_names_no_outlier_and_no_conflict(wrong):
    """All seven residuals are multiples of one number, so each height may be the wrong one."""
    robot, data = probe_delta(7, {wrong: 1e-3})
    fit = identify(robot, data, LeastSquares())
    result = find_outliers(fit, data)
    assert result.is_converged
    assert result.blocks == 7
    assert result.names == ()
    assert fit.residual_test.failed
    (group,) = result.ambiguous
    assert len(group.poses) == 7
    assert group.times == pytest.approx(np.sqrt(fit.chi_square), rel=1e-3)  # not linear over 1 mm
    (summary,) = result.summary
    assert summary.data["reason"] == "one-degree"  # the only statement on outliers
    codes = [f.code for f in examine_fit(fit, data).findings]
    assert [code for code in codes if code.startswith("outliers.")] == ["outliers.not-testable"]


@pytest.mark.parametrize(
    ("points", "off", "noise", "names", "codes"),
    [
        (7, {3: 1e-3}, "estimated", (), ["outliers.not-testable"]),
        (12, {4: 1e-3}, "given", ("5",), ["outliers.some"]),
        # no single height explains both, and any two do
        (8, {0: 1e-3, 1: -1e-3}, "given", (), ["outliers.ambiguous"]),
    ],
)
def test_wrong_heights_are_named_with_enough_degrees_of_freedom(points, off, noise, names, codes):
    robot, data = probe_delta(points, off)
    fit = identify(robot, data, LeastSquares(), options=FitOptions(noise=noise))
    result = find_outliers(fit, data)
    assert result.names == names
    assert bool(result.ambiguous) == (codes == ["outliers.ambiguous"])
    assert [f.code for f in result.summary] == codes


def test_misfit_of_all_rows_is_reported_although_no_outlier_is_named():
    robot, data = probe_delta(40, {}, 38 * UM)
    rows = data.observations[0]
    data = replace(data, observations=(replace(rows, covariance=rows.covariance * (20 / 38) ** 2),))
    fit = identify(robot, data, LeastSquares(), options=FitOptions(sigma_uncertainty=0.0))
    result = find_outliers(fit, data, level=1e-9)  # so low a level that no outlier is named
    assert fit.residual_test.failed
    assert result.outliers == result.ambiguous == ()
    assert [f.code for f in result.summary] == ["outliers.none-but-misfit"]


def test_one_gross_row_does_not_make_the_right_poses_outliers():
    """A row that is half a machine off pulls the geometry so far that half the poses misfit."""
    robot, data = measure_five_bar()
    wrong = move_row(data, 6, 0.3)
    fit = identify(robot, wrong, MAP())
    assert fit.converged
    assert fit.residual_test.failed
    assert find_outliers(fit, wrong).names == (data.labels[6],)


@pytest.mark.parametrize("outlier", [None, 6])
def test_a_sigma_that_is_far_too_small_makes_no_outliers(outlier):
    robot, data = measure_five_bar()
    wrong = data if outlier is None else move_row(data, outlier, 5e-4)
    rows = wrong.observations[0]
    wrong = replace(wrong, observations=(replace(rows, covariance=rows.covariance * 1e-6),))
    result = find_outliers(identify(robot, wrong), wrong)
    codes = [finding.code for finding in result.summary]
    if outlier is None:
        assert result.names == ()
        assert codes == ["outliers.none-but-misfit"]
    else:
        assert result.names == (data.labels[outlier],)
        assert codes == ["outliers.larger-noise", "outliers.some"]
        assert result.summary[0].data["times"] == pytest.approx(1e3, rel=0.3)


def measure_five_bar():
    """Return the shipped five-bar and what a camera measures of a machine with errors."""
    robot = load_robot("five-bar")
    truth = robot.with_values(sample_truth(robot, 1, seed=2)[0])
    camera = Instrument((Sensor(Component(components=("x", "y")), noise(20 * UM, 20 * UM)),))
    poses = sample_workspace(robot, 30, seed=3).coordinates
    return robot, simulate(truth, poses, camera, seed=4, controller=robot)


def move_row(data, row, amount):
    """Return the data with the second value of one row changed [m]."""
    rows = data.observations[0]
    measured = rows.measured.copy()
    measured[row, 1] += amount
    return replace(data, observations=(replace(rows, measured=measured),))


def delta_data(n: int, wrong: dict[int, float]) -> tuple[Mechanism, Measurements]:
    """Return a linear delta and n measured positions, rows of which are wrong by lengths [m]."""
    errors = np.random.default_rng(2).standard_normal((n, 3))
    for row, length in wrong.items():
        errors[row] += length / LENGTH
    return ROBOTS["linear-delta"], measure("linear-delta", "component", errors, 4)[1]


def list_result(result: OutlierCheck) -> tuple[object, ...]:
    return result.outliers, result.ambiguous, result.scale


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [{3: 1e-3, 50: -2e-4}, {7: 3e-5, 8: 4e-5}, {}])
@pytest.mark.parametrize("n", [6, 20])
def test_far_outliers_are_compared_with_others_only_where_these_may_replace_them(
    monkeypatch, n, wrong
):
    robot, data = delta_data(n, {row % n: length for row, length in wrong.items()})
    fit = identify(robot, data)
    result = find_outliers(fit, data)
    monkeypatch.setattr(outlier_search, "_may_have_rivals", lambda *_: True)
    assert list_result(find_outliers(fit, data)) == list_result(result)


def test_the_number_of_fits_does_not_grow_with_the_gross_errors(monkeypatch):
    counts = []
    for wrong in (2, 12):
        robot, data = delta_data(300, {20 * i: 1e-3 for i in range(wrong)})
        fit, calls = identify(robot, data), []
        counted = lambda *a, calls=calls, **k: calls.append(1) or fit_without(*a, **k)  # noqa: E731
        monkeypatch.setattr(outliers, "fit_without", counted)
        assert len(find_outliers(fit, data).outliers) == wrong
        counts.append(len(calls))
    assert max(counts) <= 6


def test_an_even_choice_of_blocks_is_enough_to_begin_the_search(monkeypatch):
    robot, data = delta_data(200, {5: 1e-3, 70: -3e-4, 133: 2e-3})
    fit = identify(robot, data)
    whole = find_outliers(fit, data)
    monkeypatch.setattr(outliers, "MOST_ROBUST", 60)
    assert set(find_outliers(fit, data).names) == set(whole.names) == {"6", "71", "134"}


def test_outlier_search_reports_progress():
    robot, data = probe_delta(12, {4: 1e-3})
    reports: list[tuple[int, int, str]] = []
    find_outliers(
        identify(robot, data, LeastSquares()), data, progress=lambda *report: reports.append(report)
    )
    assert {what.partition(",")[0] for _, _, what in reports} == {
        "fitting",
        "searching for outliers",
        "comparing suspected poses with others",
    }
    assert all(0 <= done < total for done, total, _ in reports)


def test_cyclic_outlier_search_is_not_converged_and_lists_its_suspects():
    """Blocks 0 and 1 mask each other: each is suspected while the other is excluded."""

    def ask(excluded: np.ndarray) -> PartialFit:
        distance = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
        distance[0 if excluded[1] else 1] = 100.0
        one = np.ones(6, dtype=np.int64)
        influence = Influence(np.full(6, 0.1), one, distance, one)
        return PartialFit(excluded, influence, 1.0, 4)

    search = search_blocks(ask, np.zeros(6, dtype=bool), 0.05)
    assert [np.flatnonzero(state.excluded).tolist() for state in search.fits] == [[1], [0]]
    (group,) = find_ambiguous(search)
    assert np.flatnonzero(group).tolist() == [0, 1]
    fit = identify(*probe_delta(12, {}))
    shared = {"blocks": 6, "single_poses": True}
    (finding,) = _summarize(fit, 0, 2, 0.05, shared, is_converged=False)
    assert finding.code == "outliers.search-not-converged"
    assert (finding.data["count"], finding.data["blocks"]) == (2, 6)
