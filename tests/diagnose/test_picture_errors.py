# SPDX-License-Identifier: Apache-2.0
"""Mistakes with pictures of a printed board are named as the cause of residuals."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from loopcal import calibrate, geometry, identifiability, identify, load_robot
from loopcal.diagnose.conventions.convention_check import compare_conventions
from loopcal.diagnose.error_causes import (
    explain_residuals,
    find_print_scale,
    find_swapped_pictures,
    measure_picture_errors,
)
from loopcal.diagnose.model_discrepancy import check_lack_of_fit
from loopcal.estimate.fit_linearization import linearize_fit
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.image import Image
from loopcal.measure.simulation import sample_truth, simulate_trials

SIGMA = 0.1  # [px]


@cache
def measure(again: int = 0):
    """Return a hexapod with errors of its spreads, and 16 pictures of its board, and those of the
    first poses again.
    """
    robot = load_robot("hexapod-42")
    half, middle = np.array([30, 30, 15, 10, 10, 10]), np.array([0, 0, 200, 0, 0, 0])
    poses = middle + np.random.default_rng(3).uniform(-half, half, (16, 6))
    poses = np.concatenate([poses, poses[:again]]) * np.repeat([1e-3, np.pi / 180], 3)
    kind = Image(
        T_camera=geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.7])),
        T_board=geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.04, 0.03, 0.01])),
        focal=(4000.0, 4000.0),
        corners=(5, 4),
        square=0.02,
        unknown=("camera", "board", "focal", "center"),
    )
    instrument = Instrument((Sensor(kind, Gaussian(np.full(2, SIGMA))),))
    trials = simulate_trials(robot, sample_truth(robot, 1, 4), poses, instrument, 5)
    return robot, trials.trial(0), trials.T[0]


@pytest.mark.parametrize("again", [0, 2])
def test_only_pictures_of_the_same_pose_are_repeats(again):
    robot, data, _ = measure(again)
    lack = check_lack_of_fit(identify(robot, data), data)
    corners, degrees = data.observations[0].kind.rows_per_pose, lack.pure_degrees
    assert degrees == 2 * corners * again
    assert (lack.findings[0].code == "residuals.no-repeats") == (again == 0)
    if again:  # what differs between repeats is the noise as stated
        assert 0.7 < lack.sigma_scale < 1.3


def change(edit) -> Any:
    """Return robot and data whose measured columns an `edit` changed."""
    robot, data, T = measure()
    rows = data.observations[0]
    return robot, replace(data, observations=(edit(rows, T),))


def explain(robot, data):
    """Return the causes of the residuals of a fit, and the sizes of errors of pictures."""
    fit = identify(robot, data)
    linear = linearize_fit(fit, data, None)
    explained = explain_residuals(linear, is_doubted=True)
    return explained.causes, measure_picture_errors(linear, explained)


def zoom(rows, _, factor=1.01):
    measured, middle = np.array(rows.measured), np.array([1999.5, 1499.5])
    own = rows.rows == 6
    measured[own, 1:] = factor * (measured[own, 1:] - middle) + middle
    return replace(rows, measured=measured)


def move_board(rows, T):
    """Move the board on the platform by 0.3 mm before pose 10."""
    other = replace(rows.kind, unknown=("board",))
    zero = np.zeros((1, len(rows), 2))
    shift = np.array([0.001, 0.0, 0.0, 0.0003, 0.0, 0.0])
    before, after = (
        other.measure(T[None, rows.rows], zero, (other.nominal_values + d)[None, None])
        for d in (np.zeros(6), shift)
    )
    later = (rows.rows >= 9)[:, None]
    return replace(rows, measured=rows.measured + later * (after - before)[0])


def move_machine(rows, T, shutter=0.02):
    """Move the platform of pose 7 at 15 mm/s while a rolling shutter reads 3000 rows."""
    other, zero = replace(rows.kind, unknown=()), np.zeros((1, len(rows), 2))
    measured, own = np.array(rows.measured), rows.rows == 6
    for _ in range(3):  # the time at which a row is read depends on where the corner is
        time = shutter * measured[:, 2] / 3000
        twist = time[:, None] * np.array([0.02, 0.03, 0.01, 0.013, -0.007, 0.003])
        moved = geometry.apply_twist(T[rows.rows], twist)
        seen = other.measure(moved[None], zero)[0] - other.measure(T[rows.rows][None], zero)[0]
        measured[own, 1:] = rows.measured[own, 1:] + seen[own, 1:]
    return replace(rows, measured=measured)


def shrink_print(rows, _):
    """State squares that are larger than the printed ones."""
    return replace(rows, kind=replace(rows.kind, square=0.02 / 0.97))


@pytest.mark.slow
def test_picture_with_another_focal_length_is_named_with_its_zoom() -> None:
    causes, sizes = explain(*change(zoom))
    assert (causes[0].source, causes[0].name) == ("zoomed-picture", "7")
    assert sizes[0].code == "residuals.zoomed-picture"
    assert sizes[0].data["zoom"] == pytest.approx(1.0, abs=0.05)  # [%]


@pytest.mark.slow
def test_picture_of_a_moving_machine_is_named() -> None:
    causes, sizes = explain(*change(move_machine))
    assert (causes[0].source, causes[0].name) == ("moving-picture", "7")
    # 0.3 mm in 20 ms at 0.5 m, with 4000 px of focal length
    assert 1.0 < sizes[0].data["motion"] < 4.0


@pytest.mark.slow
def test_board_that_moved_is_named_with_the_first_picture_after() -> None:
    robot, data = change(move_board)
    linear = linearize_fit(identify(robot, data), data, None)
    explained = explain_residuals(linear, is_doubted=True)
    causes, sizes = explained.causes, measure_picture_errors(linear, explained)
    assert causes[0].source == "moved-board"
    assert causes[0].name == "board, 10"
    assert sizes[0].code == "residuals.board-moved"
    # what noise may show as well is no reason to fasten a board
    doubtful = explained._replace(causes=(causes[0]._replace(p_value=0.48),))
    assert measure_picture_errors(linear, doubtful) == []
    assert sizes[0].data["shift"].value == pytest.approx(0.3, rel=0.2)  # [mm]


@pytest.mark.slow
def test_board_printed_to_fit_the_page_is_named_with_its_scale() -> None:
    robot, data = change(shrink_print)
    (found,) = find_print_scale(identify(robot, data), data)
    assert (found.data["scale_x"], found.data["scale_y"]) == pytest.approx((97.0, 97.0), abs=0.3)
    assert find_print_scale(identify(robot, measure()[1]), measure()[1]) == []


@pytest.mark.slow
def test_swapped_pictures_are_named_with_the_poses_that_they_show() -> None:
    def swap(rows, _):
        place = np.arange(16)
        place[[4, 11]] = 11, 4
        return replace(rows, rows=place[rows.rows])

    robot, data = change(swap)
    found = find_swapped_pictures(identify(robot, data), data, ("5", "12"))
    assert [(f.data["pose"], f.data["shown"]) for f in found] == [("5", "12"), ("12", "5")]
    assert find_swapped_pictures(identify(robot, measure()[1]), measure()[1], ("5",)) == []


@pytest.mark.slow
def test_good_pictures_have_no_cause() -> None:
    robot, data, _ = measure()
    fit = identify(robot, data)
    explained = explain_residuals(linearize_fit(fit, data, None))
    assert not explained.causes


def make_delta(**settings):
    """Return a rotary delta with an instrument that takes pictures of a board."""
    ahead = geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.3]))
    board = geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.04, 0.03, 0.01]))
    kind = Image(T_camera=ahead, T_board=board, corners=(3, 3), **settings)
    return load_robot("rotary-delta"), Instrument((Sensor(kind, Gaussian(np.full(2, SIGMA))),))


def test_size_of_a_machine_that_only_pictures_measure_follows_from_the_board() -> None:
    found = {}
    for name, unknown in (("stated", ("camera",)), ("unknown", ("camera", "print"))):
        checked = identifiability(*make_delta(unknown=unknown), poses=12)
        (found[name],) = [f for f in checked.findings if f.code == "identifiability.board-scale"]
        found[name, "rank"] = checked.rank
    assert found["stated"].data["is_known"]
    assert found["unknown"].severity.value == "warning"
    assert found["unknown", "rank"] == found["stated", "rank"] - 1  # the scale of all lengths
    robot, instrument = load_robot("hexapod-42"), make_delta(unknown=("camera",))[1]
    kind = replace(
        instrument.sensors[0].kind,
        T_camera=geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 0.7])),
    )
    of_rods = identifiability(
        robot, Instrument((Sensor(kind, Gaussian(np.full(2, SIGMA))),)), poses=12
    )
    assert "identifiability.board-scale" not in [f.code for f in of_rods.findings]


@pytest.mark.slow
def test_calibration_names_swapped_pictures() -> None:
    def swap(rows, _):
        place = np.arange(16)
        place[[4, 11]] = 11, 4
        return replace(rows, rows=place[rows.rows])

    report = calibrate(*change(swap))
    found = [f.data["shown"] for f in report.findings if f.code == "outliers.swapped-picture"]
    assert found == ["12", "5"]


@pytest.mark.slow
def test_readings_of_the_row_above_are_named() -> None:
    """The first pose then has the readings of the last one, which misleads the start values."""
    robot, rng = load_robot("linear-delta"), np.random.default_rng(2)
    kind = Image(
        T_camera=geometry.make_pose(
            geometry.exp_so3(np.array([np.pi + 0.6, 0.0, 0.0])), np.array([0.0, -0.4, 0.72])
        ),
        T_board=geometry.make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.036, 0.024, 0.0])),
        focal=(4000.0, 4000.0),
        corners=(7, 5),
        square=0.012,
        unknown=("camera", "board", "focal", "center", "radial", "tangential"),
    )
    instrument = Instrument((Sensor(kind, Gaussian(np.full(2, SIGMA))),))
    poses = rng.uniform([-0.06, -0.06, 0.0], [0.06, 0.06, 0.25], (25, 3))
    poses = poses[np.argsort(poses[:, 2])]  # as along a path
    data = simulate_trials(robot, sample_truth(robot, 1, 4), poses, instrument, 5).trial(0)
    shifted = replace(data, readings=np.roll(data.readings, -1, axis=0))
    finding = compare_conventions(robot, shifted).finding
    assert finding is not None
    assert "readings taken from the row above" in str(finding)
