# SPDX-License-Identifier: Apache-2.0
"""Curves of the held-out error against lam and k agree with repeated fits."""

from __future__ import annotations

import numpy as np
import pytest

from loopcal.diagnose.cross_validation import compute_regularization_curves, cross_validate
from loopcal.estimate.identification import identify
from loopcal.estimate.options import FitOptions
from loopcal.estimate.penalties import GCV, MarginalLikelihood, Ridge, TruncatedSVD, TruncationGCV
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.instrument import Instrument, Sensor
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import sample_truth, simulate
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.workspace import sample_workspace
from tests.estimate.problems import noise


@pytest.fixture(scope="module")
def robot() -> Mechanism:
    return load_robot("linear-delta")


def measure(robot: Mechanism, kind: Position, n: int = 16) -> Measurements:
    """Return measurements of a machine with errors within its spreads."""
    truth = robot.with_values(sample_truth(robot, 1, 4)[0])
    instrument = Instrument((Sensor(kind, noise(*[60e-6] * 3)),))
    return simulate(truth, sample_workspace(robot, n, 5).coordinates, instrument, 6)


@pytest.fixture(scope="module")
def data(robot: Mechanism) -> Measurements:
    return measure(robot, Position())


def test_scores_and_standard_errors_are_those_of_fits_without_each_pose(robot, data) -> None:
    curves = compute_regularization_curves(robot, data)
    assert (curves.scheme, curves.left_out, curves.parameters) == ("leave-one-out", 16, 9)
    # first order in deviations that are 1e-3 of the size of the robot; a truncation also keeps its
    # directions, which change where singular values are close (those of 3 and 4)
    for curve, tolerance, methods in (
        (curves.ridge, 0.01, {lam: Ridge(lam) for lam in (1.0, 1e4)}),
        (curves.truncation, 0.06, {float(k): TruncatedSVD(k) for k in (3, 6)}),
    ):
        for value, method in methods.items():
            refitted = cross_validate(robot, data, method, count=16)
            score, error = curve.score_at(value)
            assert score == pytest.approx(refitted.score, rel=tolerance)
            assert error == pytest.approx(refitted.standard_error, rel=tolerance)


def test_rules_choose_what_fits_with_them_choose(robot, data) -> None:
    curves = compute_regularization_curves(robot, data)
    lam = {chosen.rule: chosen.value for chosen in curves.ridge.chosen}
    assert set(lam.values()) <= set(curves.ridge.values)  # each has its own score
    k = {chosen.rule: chosen.value for chosen in curves.truncation.chosen}
    for name, rule in (("GCV", GCV()), ("marginal likelihood", MarginalLikelihood())):
        fit = identify(robot, data, Ridge(rule))
        assert fit.regularization is not None
        # the fit is linearized at its own estimate
        assert lam[name] == pytest.approx(fit.regularization.value, rel=2e-2)
    fit = identify(robot, data, TruncatedSVD(TruncationGCV()))
    assert fit.regularization is not None
    assert k["GCV"] == fit.regularization.value


def test_marked_values_are_the_lowest_and_the_simplest_within_one_standard_error(
    robot, data
) -> None:
    curves = compute_regularization_curves(robot, data)
    for curve in (curves.ridge, curves.truncation):
        chosen = {c.rule: c.value for c in curve.chosen}
        best, error = curve.score_at(chosen["lowest held-out error"])
        assert best == curve.score.min()
        assert curve.score_at(chosen["one standard error"])[0] <= best + error
        simpler = curve.values > chosen["one standard error"]
        if curve.name == "k":
            simpler = curve.values < chosen["one standard error"]
        assert (curve.score[simpler] > best + error).all()


def test_curves_begin_and_end_at_the_given_robot_and_at_least_squares(robot, data) -> None:
    curves = compute_regularization_curves(robot, data)
    assert curves.nominal[0] == curves.truncation.score[0]
    given = cross_validate(robot, data, count=16).before_fold.mean()
    assert curves.nominal[0] == pytest.approx(given, rel=2e-2)
    assert curves.ridge.score[0] == pytest.approx(curves.truncation.score[-1], rel=2e-2)
    assert curves.ridge.score[-1] > 5.0 * curves.ridge.score.min()
    assert curves.ridge.values[0] < 1.0 < curves.ridge.values[-1]


def test_tolerances_that_are_right_give_the_lowest_error_near_lam_1(robot) -> None:
    """Machines that are drawn from the spreads are predicted best with lam = 1 on average."""
    total: dict[float, float] = {}
    instrument = Instrument((Sensor(Position(), noise(*[2e-3] * 3)),))
    poses = sample_workspace(robot, 8, 5).coordinates
    for seed in range(10):
        truth = robot.with_values(sample_truth(robot, 1, seed)[0])
        curves = compute_regularization_curves(robot, simulate(truth, poses, instrument, seed))
        for value in (1e-2, 1.0, 1e2):
            total[value] = total.get(value, 0.0) + curves.ridge.score_at(value)[0]
    assert total[1.0] == min(total.values())


@pytest.mark.slow
def test_unknown_frames_are_scored_by_folds_that_are_fitted_again(robot) -> None:
    data = measure(robot, Position(unknown=("frame",), frame="tracker"), 12)
    curves = compute_regularization_curves(robot, data, folds=2, seed=2)
    assert (curves.scheme, curves.left_out) == ("folds", 2)
    assert len(curves.ridge.values) <= 13 + 2
    value = float(curves.ridge.values[6])
    refitted = cross_validate(robot, data, options=FitOptions(method=Ridge(value)), count=2, seed=2)
    assert curves.ridge.score_at(value) == (refitted.score, refitted.standard_error)


def test_excluded_poses_are_not_used(robot, data) -> None:
    options = FitOptions(excluded_poses=data.labels[:4])
    curves = compute_regularization_curves(robot, data, options=options)
    assert (curves.poses, curves.left_out) == (12, 12)


def test_too_few_poses_for_an_unpenalized_fit_are_said_to_be_not_determined(robot) -> None:
    curves = compute_regularization_curves(robot, measure(robot, Position(), 3))
    assert np.isinf(curves.truncation.score[-1])
    assert np.isfinite(curves.ridge.score_at(1.0)[0])
    assert {c.rule for c in curves.ridge.chosen} >= {"GCV", "lowest held-out error"}
