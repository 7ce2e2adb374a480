# SPDX-License-Identifier: Apache-2.0
"""The convention check names setup items that are not declared unknown, and other zeros of the
readings; it names neither where they do not fit.
"""

from dataclasses import replace

import numpy as np
import pytest

from loopcal import geometry
from loopcal.diagnose.conventions.convention_check import (
    compare_conventions,
    explain_outside_strokes,
)
from loopcal.diagnose.conventions.misfit import ALLOWED
from loopcal.errors import DataError
from loopcal.io.robot.robot_file import load_robot
from loopcal.measure.data_checks import check_targets_move
from loopcal.measure.instrument import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.directions import Inclination
from loopcal.measure.kinds.poses import Component, Pose
from loopcal.measure.kinds.position import Position
from loopcal.measure.measurements import Measurements
from loopcal.measure.simulation import simulate
from loopcal.mechanism.solutions import forward
from loopcal.mechanism.workspace import sample_workspace
from tests.diagnose.test_conventions import change_values, load_cached_robot, simulate_data
from tests.mistakes.machines import HELIOSTAT

STATION = geometry.make_pose(
    geometry.exp_so3(np.array([0.3, -0.2, 1.1])), np.array([-1.5, 0.8, 0.4])
)


def write_in_frame(name: str, kind, frame) -> Measurements:
    """Return data of a kind whose instrument stands at `frame`, without stating it."""
    measured = simulate_data(name, replace(kind, T_base_frame=frame), n=20)
    rows = measured.observations[0]
    stated = replace(rows, kind=replace(rows.kind, T_base_frame=np.eye(4)))
    return replace(measured, observations=(stated,))


@pytest.mark.parametrize("name", ["3-prs", "hexapod-42", "linear-delta"])
@pytest.mark.parametrize("kind", [Pose(), Position()], ids=["pose", "position"])
def test_frame_that_is_not_declared_unknown_is_named(name, kind) -> None:
    check = compare_conventions(load_cached_robot(name), write_in_frame(name, kind, STATION))
    assert check.is_refused
    assert check.other_misfit <= ALLOWED
    assert "'unknown: [frame]' in the settings they fit" in str(check)


def test_frame_is_not_suggested_where_it_does_not_fit() -> None:
    data = write_in_frame("hexapod-42", Pose(), STATION)
    rng = np.random.default_rng(0)
    noisy = change_values(
        data, lambda values: values.__iadd__(0.05 * rng.standard_normal(values.shape))
    )
    check = compare_conventions(load_cached_robot("hexapod-42"), noisy)
    assert check.is_doubtful
    assert not check.is_refused
    assert check.finding is not None
    assert check.finding.data["tried"] > 0
    assert "unknown: [" not in str(check)


def change_readings(data, change):
    readings = np.array(data.readings)
    change(readings)
    return replace(data, readings=readings)


@pytest.mark.parametrize("name", ["hexapod-42", "rotary-delta", "3-prs"])
@pytest.mark.parametrize("column", [0, slice(None)], ids=["one", "all"])
def test_readings_of_the_other_direction_from_another_zero_are_named(name, column) -> None:
    robot = load_cached_robot(name)
    low, high = robot.actuators[0].stroke or (-0.1, 0.3)

    def reverse(readings):
        readings[:, column] = 0.9 * low + 1.1 * high - readings[:, column]

    check = compare_conventions(robot, change_readings(simulate_data(name, Pose(), 20), reverse))
    assert check.is_refused
    assert check.other_misfit <= ALLOWED
    assert check.interpretation is not None
    slips = {one.slip for one in (check.interpretation, *check.alternatives)}
    assert slips & {"reading-zero", "reading-sign"}


def test_small_error_of_a_zero_is_left_to_the_calibration() -> None:
    """An end stop that is ten spreads off: a first calibration must not be refused."""
    data = simulate_data("linear-delta", Position(), 20)
    shifted = change_readings(data, lambda q: q.__setitem__((slice(None), 0), q[:, 0] + 0.005))
    assert not compare_conventions(load_cached_robot("linear-delta"), shifted).is_refused


def test_readings_outside_strokes_are_explained_only_by_changes_that_put_all_inside() -> None:
    robot, data = (
        load_cached_robot("five-bar"),
        simulate_data("five-bar", Component(("x", "y")), 20),
    )
    swapped = replace(data, readings=data.readings[:, ::-1].copy())
    finding = explain_outside_strokes(robot, swapped)
    assert finding is not None
    assert finding.code == "conventions.strokes-explained"
    assert finding.data["interpretation"]["code"] == "conventions.swapped-readings"
    assert explain_outside_strokes(robot, data) is None
    rng = np.random.default_rng(0)
    random = replace(data, readings=rng.uniform(-9.0, 9.0, data.readings.shape))
    assert explain_outside_strokes(robot, random) is None


def test_column_of_equal_numbers_is_named_unless_the_robot_keeps_it_equal() -> None:
    robot, data = load_cached_robot("rotary-delta"), simulate_data("rotary-delta", Position(), 20)
    T = forward(robot, data.readings).T
    typed = change_values(data, lambda values: values.__setitem__((slice(None), 2), -0.45))
    with pytest.raises(DataError, match="column 'z' of kind 'position' is -450 mm in every row"):
        check_targets_move(typed, T, robot.size)
    check_targets_move(data, T, robot.size)
    level = T.copy()
    level[:, 2, 3] = T[0, 2, 3] + 1e-3 * (T[:, 2, 3] - T[0, 2, 3])
    check_targets_move(typed, level, robot.size)


def test_a_change_that_still_does_not_fit_is_not_suggested(tmp_path) -> None:
    """A robot file with a base joint on the wrong side: half the readings from home reduce the
    misfit 60 times, but leave 28 degrees.
    """
    right, mistyped = tmp_path / "right.yaml", tmp_path / "mistyped.yaml"
    right.write_text(HELIOSTAT)
    mistyped.write_text(HELIOSTAT.replace("tip: [-600, 0, -800]", "tip: [600, 0, -800]"))
    noise = Gaussian(np.full(2, 2e-5))
    robot = load_robot(right)
    data = simulate(
        robot,
        sample_workspace(robot, 20, 1).coordinates,
        Instrument((Sensor(Inclination(), noise),)),
        0,
    )
    check = compare_conventions(load_robot(mistyped), data)
    assert check.misfit > 1000.0
    assert check.finding is not None
    assert check.finding.code == "conventions.unexplained"
    assert check.interpretation is None
