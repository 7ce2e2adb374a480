# SPDX-License-Identifier: Apache-2.0
"""Arguments that would give a wrong result, or an error of numpy, are refused."""

import contextlib
import inspect
import sys

import numpy as np
import pytest

import loopcal as lc
from tests.estimate.problems import hexapod, hexapod_data

INSTRUMENT = lc.Instrument((lc.Sensor(lc.Pose(), lc.Gaussian(np.full(6, 1e-5))),))


@pytest.fixture(scope="module")
def robot():
    return lc.load_robot("hexapod-42")


@pytest.fixture(scope="module")
def data(robot):
    return lc.simulate(robot, lc.sample_workspace(robot, 4, 0).coordinates, INSTRUMENT, seed=0)


@pytest.mark.parametrize("truth", [np.zeros((3, 5)), np.zeros((0, 42))])
def test_simulated_trials_need_a_value_of_each_parameter(robot, truth):
    with pytest.raises(lc.DataError, match="truth"):
        lc.simulate_trials(robot, truth, robot.home[None], INSTRUMENT, seed=0)


@pytest.mark.parametrize(
    "poses", [np.array([0.5, 1.2]), "pose", np.array([True, False]), np.zeros((4, 1), dtype=bool)]
)
def test_take_refuses_anything_but_indices_and_a_mask_of_all_poses(data, poses):
    with pytest.raises(lc.DataError, match="Give"):
        data.take(poses)


def test_take_accepts_indices_and_a_mask_of_all_poses(data):
    by_index, by_mask = data.take([1, 3]), data.take([False, True, False, True])
    assert by_index.labels == by_mask.labels == ("2", "4")


def test_a_negative_sigma_is_refused(robot):
    kind = lc.Pose().with_tool(robot.tool)
    with pytest.raises(lc.DataError, match="sigma contains -1e-05"):
        lc.Observations.from_sigma(kind, [0], np.zeros((1, 6)), -1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_stated_value_is_finite(value):
    with pytest.raises(lc.DataError, match=r"tracker\.x"):
        lc.StatedValue("tracker.x", nominal=value)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda fit, data: lc.validate(fit, data, limit_angle=-1.0), "limit_angle is -1.0. Give"),
        (lambda fit, data: lc.validate(fit, data, np.nan), "limit_position is nan. Give"),
        (lambda fit, data: lc.CalibrationOptions(hold_out=0.2, seed=-1), "seed is -1. Give"),
        (lambda fit, data: data.split(hold_out=0.2, seed=-1), "seed is -1. Give"),
        (lambda fit, data: lc.sample_truth(fit.robot, 1, -1), "seed is -1. Give"),
        (lambda fit, data: lc.identifiability(fit.robot, data, 2.0), "rank_tolerance is 2.0"),
        (lambda fit, data: lc.sample_workspace(lc.load_robot("five-bar"), -1), "-1 positions"),
        (lambda fit, data: lc.find_outliers(fit, hexapod_data(9)), "9 poses, but the fit has 12"),
        (lambda fit, data: lc.examine_fit(fit, hexapod_data(9)), "9 poses, but the fit has 12"),
        (lambda fit, data: lc.compute_joint_region(fit, combinations=np.zeros((1, 42))), "zeros"),
        (
            lambda fit, data: lc.compute_joint_region(fit, combinations=np.full((1, 42), np.inf)),
            "finite",
        ),
        (
            lambda fit, data: lc.save_robot(fit.robot, "a.yaml", np.ones(1)),
            r"shape \(1,\). Give one unc",
        ),
        (lambda fit, data: lc.FitOptions(excluded_poses=(3,)), "excluded_poses: .*'3'"),  # pyright: ignore
        (lambda fit, data: lc.load_run("a\0b"), "path .* contains a null character"),
        (lambda fit, data: lc.load_robot("\ud800"), "path .* half of a character"),
    ],
)
def test_a_value_out_of_range_is_refused_with_what_is_allowed(call, words):
    data = hexapod_data(12)
    with pytest.raises(lc.LoopcalError, match=words):
        call(lc.identify(hexapod(), data, lc.MAP()), data)


@pytest.mark.parametrize(
    "call",
    [
        lambda robot, data, folder: lc.save_measurements(robot, folder / "data.csv", data),
        lambda robot, data, folder: lc.identifiability(data, robot),
        lambda robot, data, folder: lc.assess_repeatability(data, robot),
        lambda robot, data, folder: lc.validate(data, robot),
        lambda robot, data, folder: lc.identify(data, robot),
        lambda robot, data, folder: lc.calibrate(data, robot),
    ],
)
def test_robot_and_data_in_the_wrong_order_are_named(robot, data, tmp_path, call):
    with pytest.raises(lc.DataError, match=r"got a Me.*Give (Me|Id)"):
        call(robot, data, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", [object(), "x.yaml", (), lc.Pose])
@pytest.mark.parametrize(
    "function", [f for name in lc.__all__ if inspect.isfunction(f := getattr(lc, name))]
)
def test_arguments_of_a_wrong_type_are_named_by_every_public_function(function, wrong) -> None:
    needed = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    given = [wrong for p in needed if p.kind is not p.KEYWORD_ONLY]
    named = {p.name: wrong for p in needed if p.kind is p.KEYWORD_ONLY}
    with contextlib.suppress(lc.LoopcalError):
        function(*given, **named)


def test_public_function_is_that_of_its_module_and_counts_its_arguments() -> None:
    assert sys.modules[lc.calibrate.__module__].calibrate is lc.calibrate  # as pickle asks
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'data'"):
        lc.calibrate(lc.load_robot("five-bar"))  # pyright: ignore
    with pytest.raises(
        lc.DataError, match=r"robot: got the text 'x.yaml'\. Give Mechanism, as from"
    ):
        lc.forward("x.yaml", [[1.0, 2.0]])  # pyright: ignore
