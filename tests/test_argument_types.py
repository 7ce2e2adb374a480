# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false
# Wrong types are passed on purpose.
"""Arguments of the wrong type or out of range: every public function says what to pass."""

from typing import Any

import numpy as np
import pytest

import loopcal as lc
from tests.estimate.problems import hexapod, hexapod_data

WRONG: Any = "measurements.csv"


@pytest.fixture(scope="module")
def data():
    return hexapod_data(12)


@pytest.fixture(scope="module")
def fit(data):
    return lc.identify(hexapod(), data, lc.MAP())


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda fit, data: lc.validate(WRONG, data), "fit: .* give Identification, .*, or Mech"),
        (lambda fit, data: lc.validate(fit, WRONG), "data: .* give Measurements, .*load_meas"),
        (
            lambda fit, data: lc.validate(fit, data, limit_position=WRONG),
            "limit_position: .*metres",
        ),
        (lambda fit, data: lc.pose_uncertainty(WRONG, [[0.0]]), "fit: .* Identification, .*Poste"),
        (lambda fit, data: lc.accuracy_map(WRONG, [[0.0]]), "fit: .* Identification, .*Posterior"),
        (lambda fit, data: lc.compensate(WRONG, [[0.0]]), "fit: .* Identification, .*, or Mech"),
        (lambda fit, data: lc.find_outliers(fit.robot, data), "fit: got a Mech.* Identification"),
        (lambda fit, data: lc.examine_fit(WRONG, data), "fit: .* give Identification"),
        (lambda fit, data: lc.examine_fit(fit, WRONG), "data: .* give Measurements"),
        (lambda fit, data: lc.identifiability(WRONG, data), "robot: .* give Mechanism"),
        (lambda fit, data: lc.identifiability(fit.robot, WRONG), "data: .* give Measurements"),
        (lambda fit, data: lc.suggest_measurements(fit), "give Identifiability"),
        (lambda fit, data: lc.choose_identifiable_subset(fit), "give Identifiability"),
        (lambda fit, data: lc.check_conventions(fit.robot, WRONG), "data: .* give Measurements"),
        (lambda fit, data: lc.compare_conventions(WRONG, data), "robot: .* give Mechanism"),
        (lambda fit, data: lc.choose_model(fit.robot, WRONG), "data: .* give Measurements"),
        (lambda fit, data: lc.cross_validate(WRONG, data), "robot: .* give Mechanism"),
        (lambda fit, data: lc.prior_from(fit), "earlier: .* give Posterior, .*posterior"),
        (lambda fit, data: lc.recalibrate(fit.robot, data, fit), "earlier: .* give Posterior"),
        (lambda fit, data: lc.plan(WRONG, WRONG, 9), "robot: .* give Mechanism"),
        (lambda fit, data: lc.plan(fit.robot, lc.Pose(), 9), "instrument: .* give Instrument"),
        (lambda fit, data: lc.plan_surfaces(WRONG), "robot: .* give Mechanism"),
        (lambda fit, data: lc.CalibrationOptions(hold_out=WRONG), "hold_out: .* give a share"),
        (lambda fit, data: lc.CalibrationOptions(seed=WRONG), "seed: .* give a whole number"),
        (lambda fit, data: lc.CalibrationOptions(fit=lc.MAP()), "fit: .* give FitOptions"),
        (lambda fit, data: lc.CalibrationOptions(prior=fit), "prior: .* give Posterior"),
        (lambda fit, data: lc.FitOptions(control=50), "control: .* give StepControl"),
        (lambda fit, data: lc.FitOptions(nuisance={"x": 0.1}), "nuisance: .* give NuisanceParam"),
        (lambda fit, data: lc.FitOptions(rank_tolerance=WRONG), "rank_tolerance: .* give a numb"),
        (lambda fit, data: lc.FitOptions(excluded_poses=(3,)), "excluded_poses: .*'3'"),
        (lambda fit, data: lc.FitOptions(start=WRONG), "start: .* give an array"),
        (lambda fit, data: lc.StepControl(iterations=2.5), "iterations: .* a whole number"),
        (lambda fit, data: lc.StepControl(relative=WRONG), "relative: .* a finite number"),
        (lambda fit, data: data.split(hold_out=WRONG, seed=1), "hold_out: .* give the share"),
    ],
)
def test_a_wrong_type_is_refused_with_what_to_pass(call, words, fit, data):
    with pytest.raises(lc.ArgumentTypeError, match=words):
        call(fit, data)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda fit, data: lc.validate(fit, data, limit_angle=-1.0), "limit_angle is -1.0; give"),
        (lambda fit, data: lc.validate(fit, data, np.nan), "limit_position is nan; give"),
        (lambda fit, data: lc.CalibrationOptions(hold_out=0.2, seed=-1), "seed is -1; give"),
        (lambda fit, data: data.split(hold_out=0.2, seed=-1), "seed is -1; give"),
        (lambda fit, data: lc.sample_truth(fit.robot, 1, -1), "seed is -1; give"),
        (lambda fit, data: lc.identifiability(fit.robot, data, 2.0), "rank_tolerance is 2.0"),
        (lambda fit, data: lc.sample_workspace(lc.load_robot("five-bar"), -1), "-1 positions"),
        (lambda fit, data: lc.find_outliers(fit, hexapod_data(9)), "9 poses, .* made from 12"),
        (lambda fit, data: lc.examine_fit(fit, hexapod_data(9)), "9 poses, .* made from 12"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_is_allowed(call, words, fit, data):
    with pytest.raises(lc.LoopcalError, match=words):
        call(fit, data)
