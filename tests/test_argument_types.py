# SPDX-License-Identifier: Apache-2.0
# pyright: reportArgumentType=false
# Wrong types are passed on purpose.
"""Arguments of the wrong type or out of range: every public function says what to pass."""

import inspect
import pickle
from typing import Any

import numpy as np
import pytest

import loopcal as lc
from loopcal.argument_types import list_checks
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
        (
            lambda fit, data: lc.suggest_measurements(lc.identifiability(fit.robot, data), data),
            "sigma: got a Measurements; give dict, such as",
        ),
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
        (lambda fit, data: lc.bootstrap(fit, data, seed=WRONG), "seed: .* give a whole number"),
        (lambda fit, data: lc.bootstrap(fit, data, 2**63), "count: .* number below 2.63"),
        (lambda fit, data: lc.bootstrap(fit, data, scheme=["wild"]), "scheme: .* one of 'wild', "),
        (lambda fit, data: lc.bootstrap(fit, data, unit=np.ones(2)), "unit: .* text, or a whole"),
        (lambda fit, data: lc.choose_model(fit.robot, data, ["x"]), "nested: .* a dict of lists"),
        (lambda fit, data: lc.compensate(fit, [[0.0]], steps="3"), "steps: .* a whole number"),
        (lambda fit, data: lc.compensate(fit, [[None, "x"]]), "targets: .* an array of numbers"),
        (lambda fit, data: lc.compensate(fit, [[0.0]], labels="abc"), "labels: .* list of names"),
        (lambda fit, data: lc.compute_joint_region(data), "fit: .* Identification, .* Posterior,"),
        (lambda fit, data: lc.compute_joint_region(fit, [1]), "names: .* text, or a list of names"),
        (lambda fit, data: lc.compare_with_values(fit, {"x": "1"}), "values: .* numbers by name"),
        (lambda fit, data: lc.find_outliers(fit, data, "5%"), "level: .* give a number"),
        (lambda fit, data: lc.examine_fit(fit, data, frame=3), "frame: .* give text"),
        (lambda fit, data: lc.calibrate(fit.robot, data, progress=3), "progress: .* a function"),
        (
            lambda fit, data: lc.check_conventions(fit.robot, data, allow_still=np.ones(2)),
            "True or",
        ),
        (lambda fit, data: lc.trace_singularity(fit.robot, medians=(1.0,)), "medians: .* two numb"),
        (
            lambda fit, data: lc.save_robot(fit.robot, "a.yaml", [1.0]),
            r"shape \(1,\); give one unc",
        ),
        (lambda fit, data: lc.Huber("1"), "k: .* give a number"),
        (lambda fit, data: lc.Tukey(None), "c: .* give a number"),
        (lambda fit, data: lc.StatedValue("x", "1 mm"), "sd: .* give a number"),
        (lambda fit, data: lc.Constraints(max_tilt="20deg"), "max_tilt: .* give a number"),
        (lambda fit, data: lc.LineOfSight("left", [1, 0, 0]), "station: .* an array of numbers"),
        (lambda fit, data: lc.load_run("a\0b"), "path .* contains a null character"),
        (lambda fit, data: lc.load_robot("\ud800"), "path .* half of a character"),
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
        (lambda fit, data: lc.cross_validate(fit.robot, data, seed=-1), "seed is -1; give"),
        (lambda fit, data: lc.sample_workspace(fit.robot, 3, seed=-1), "seed is -1; give"),
        (lambda fit, data: lc.compute_joint_region(fit, combinations=[[0.0] * 42]), "zeros"),
        (lambda fit, data: lc.compute_joint_region(fit, combinations=[[np.inf] * 42]), "finite"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_is_allowed(call, words, fit, data):
    with pytest.raises(lc.LoopcalError, match=words):
        call(fit, data)


UNCHECKED = {
    "compare_runs(runs)",  # checked by the function: whatever has the attributes of a run
    *(f"{name}(method)" for name in ("choose_model", "cross_validate", "identify")),
    *(f"{name}(method)" for name in ("identify_trials", "simulate_accuracy")),
    *(f"{name}(path)" for name in ("load_measurements", "load_run", "load_stored_values")),
    *("save_measurements(path)", "save_measurements(data)", "save_robot(path)", "save_run(path)"),
    *("save_run(report)", "save_run(inputs)", "load_robot(source)", "identify(loss)"),
    *("suggest_measurements(sigma)", "validate(uncertainty)"),
    *("sample_truth(seed)", "simulate_trials(seed)"),
    *("write_report(path)", "write_report(report)", "write_view(path)", "write_view(source)"),
    *("write_comparison(path)", "write_comparison(comparison)"),
    *("load_study(path)", "study(source)", "study(folder)", "study(executor)"),
}
"""Parameters of public functions that check them themselves, or use objects of any class."""


def test_annotations_of_public_functions_are_checked() -> None:
    unchecked = {
        f"{name}({parameter.name})"
        for name in lc.__all__
        if inspect.isfunction(function := getattr(lc, name))
        for parameter in inspect.signature(function).parameters.values()
        if not list_checks(str(parameter.annotation), inspect.unwrap(function))
    }
    assert unchecked == UNCHECKED


def test_public_functions_can_be_sent_to_other_processes() -> None:
    assert (lc.forward.__module__, lc.forward.__qualname__) == ("loopcal", "forward")
    assert pickle.dumps(lc.forward)
