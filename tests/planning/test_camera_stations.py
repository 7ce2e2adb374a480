# SPDX-License-Identifier: Apache-2.0
"""Where a camera stands: what is promised there is what simulated machines end with."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares

import loopcal as lc
from loopcal.geometry import exp_so3, make_pose, pose_difference
from loopcal.measure.instrument import Instrument
from loopcal.measure.kinds.image import Image
from loopcal.measure.simulation import sample_truth
from loopcal.planning.camera_stations import choose_stations, list_stations
from tests.zoo import load_cached_robot

CALIPER = ((0.0, 3.6e-4),) * 2
OPTIONS = lc.PlanOptions(n_poses=20, n_candidates=100)


def get_camera(instrument: Instrument) -> Image:
    """Return the placed camera of an instrument."""
    kind = instrument.sensors[0].kind
    assert isinstance(kind, Image)
    return kind


@cache
def plan_pictures(name: str) -> tuple[Instrument, lc.Finding, lc.Plan]:
    """Return the best station for a robot, what is said of it, and the plan of pictures there."""
    robot = load_cached_robot(name)
    camera = Image(corners=(4, 3), square=robot.size / 10.0)
    instrument, (found,) = choose_stations(robot, camera, OPTIONS, CALIPER)
    return instrument, found, lc.plan(robot, instrument, options=OPTIONS)


def find_errors(robot: lc.Mechanism, instrument: Instrument, poses: np.ndarray) -> np.ndarray:
    """Return rms position errors [m] of calibrated machines after a rigid fit of both frames,
    by scipy.
    """
    q, errors = lc.sample_workspace(robot, 80, 5).solution.q, []
    for seed in range(12):
        truth = robot.with_values(sample_truth(robot, 1, seed)[0])
        data = lc.simulate(truth, poses, instrument, seed=seed)
        found = lc.identify(robot, data).robot
        T, true = (lc.forward(machine, q).T @ robot.tool for machine in (found, truth))

        def differ(x: np.ndarray, T: np.ndarray = T, true: np.ndarray = true) -> np.ndarray:
            base, tool = make_pose(exp_so3(x[:3]), x[3:6]), make_pose(exp_so3(x[6:9]), x[9:])
            d = pose_difference(base @ T @ tool, true)
            return np.concatenate([robot.size * d[:, :3], d[:, 3:]])

        fit = least_squares(lambda x: differ(x).ravel(), np.zeros(12))
        errors.append(np.sqrt((differ(fit.x)[len(q) :] ** 2).sum() / len(q)))
    return np.array(errors)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod-42", "linear-delta"])
def test_machines_end_with_the_promised_error(name):
    instrument, found, made = plan_pictures(name)
    errors = find_errors(
        load_cached_robot(name), instrument, made.poses.coordinates[~made.poses.held_out]
    )
    rms = float(np.sqrt((errors**2).mean()))
    # a root mean square over 12 machines of some directions each scatters by about 15 %
    assert rms == pytest.approx(made.errors.after.position_rms, rel=0.35)
    assert found.data["seen"] > 95.0


@pytest.mark.slow
def test_square_pixels_give_a_board_that_never_turns_a_focal_length():
    """With another aspect for each camera, a third of such fits ended nowhere."""
    robot = lc.load_robot("five-bar")
    instrument, _ = choose_stations(robot, Image(corners=(4, 3), square=0.05), OPTIONS, CALIPER)
    poses = lc.sample_workspace(robot, 20, 1).coordinates
    for seed in (0, 1, 6):
        truth = robot.with_values(sample_truth(robot, 1, seed)[0])
        fit = lc.identify(robot, lc.simulate(truth, poses, instrument, seed=seed))
        assert fit.converged
        place = fit.nuisance.names.index("camera.fx")
        found, sd = fit.nuisance.estimate[place], fit.nuisance.sd[place]
        assert sd < 800.0  # [px], of 4000
        assert abs(found - 4000.0) < 4.0 * sd


def test_delta_from_straight_above_would_end_with_a_larger_error():
    """A board that keeps its orientation shows the focal length only at an angle."""
    robot = load_cached_robot("linear-delta")
    instrument, _, made = plan_pictures("linear-delta")
    (sensor,), poses = instrument.sensors, lc.sample_workspace(robot, 30, 1).solution
    steep = next(
        iter(list_stations(robot, get_camera(instrument), poses))
    )  # 10 deg from the normal
    other = replace(instrument, sensors=(replace(sensor, kind=steep),))
    there = lc.plan(robot, other, options=OPTIONS)
    assert there.errors.after.position_rms > 1.2 * made.errors.after.position_rms


def test_every_station_shows_the_whole_board_from_its_front():
    robot = lc.load_robot("linear-delta")
    poses, camera = lc.sample_workspace(robot, 20, 1).solution, Image(square=0.01)
    for station in list_stations(robot, camera, poses):
        T = np.repeat(poses.T, station.rows_per_pose, axis=0)[None]
        columns = station.measure(T, np.zeros((1, T.shape[1], 2)))
        seen = station.hide_unseen(T, columns, station.nominal_values[None, None])
        assert np.isnan(seen).mean() < 0.02  # at 55 deg a corner may be at a grazing angle


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_either_side_of_the_platform_may_carry_the_board(side):
    robot = lc.load_robot("hexapod-42")
    place = np.array([0.1, 0.0, 0.2 + side * 0.4])
    sight = lc.LineOfSight(place, np.array([0.0, 0.0, 1.0]), cone=np.pi)
    options = replace(OPTIONS, constraints=lc.Constraints(sight=sight))
    instrument, (found,) = choose_stations(robot, Image(square=0.01), options, CALIPER)
    assert found.data["side"] == ("z" if side > 0.0 else "-z")
    assert found.data["seen"] > 95.0
    assert get_camera(instrument).T_board[2, 2] == -side


@pytest.mark.parametrize(
    ("place", "square"), [((0.5, 0.0, 0.2), 0.012), ((0.0, 0.0, 0.21), 0.012), ((0, 0, 1.0), 1e-5)]
)
def test_place_without_usable_pictures_promises_nothing(place, square):
    sight = lc.LineOfSight(np.array(place), np.array([0.0, 0.0, 1.0]), cone=np.pi)
    options = replace(OPTIONS, constraints=lc.Constraints(sight=sight))
    with pytest.raises(lc.DataError, match="pictures from there cannot be used"):
        choose_stations(lc.load_robot("hexapod-42"), Image(square=square), options, CALIPER)


def test_line_of_sight_fixes_the_station():
    robot = lc.load_robot("linear-delta")
    sight = lc.LineOfSight(np.array([0.5, 0.1, 0.6]), np.array([0.0, 0.0, 1.0]))
    options = replace(OPTIONS, constraints=lc.Constraints(sight=sight))
    instrument, _ = choose_stations(robot, Image(square=0.01), options, CALIPER)
    assert get_camera(instrument).T_camera[:3, 3].tolist() == [0.5, 0.1, 0.6]
    with pytest.raises(lc.DataError, match="fixed camera only"):
        choose_stations(robot, Image(mount="camera"), OPTIONS)
