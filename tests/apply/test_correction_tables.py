# SPDX-License-Identifier: Apache-2.0
"""Tables of corrections: what they leave at other points, and how many nodes they take."""

import numpy as np
import pytest

import loopcal as lc
from loopcal.apply.compensation import CorrectionTable, TableSize, make_tables
from loopcal.errors import DataError
from loopcal.io.robot.robot_file import list_shipped_robots
from loopcal.units import Dimension
from tests.robot_texts import load_text

GRID, HEIGHT = TableSize("commands", 20000, 500), TableSize("height", 10000, 99)
READINGS = TableSize("readings", 256, 256)


def disturb(robot: lc.Mechanism, seed: int = 1) -> lc.Mechanism:
    """Return a robot with errors of its spreads."""
    scale = np.nan_to_num(robot.parameters.tolerance) * robot.parameters.free
    errors = np.random.default_rng(seed).standard_normal(len(scale))
    return robot.with_values(robot.values + scale * errors)


def interpolate(table: CorrectionTable, name: str, points: np.ndarray) -> np.ndarray:
    """Return a correction (n,) at points (n, d) by an interpolation of our own: the mean of the
    corners of a cell, weighted by the opposite volumes.
    """
    corners = np.zeros(points.shape, int)
    shares = np.zeros(points.shape)
    for i, nodes in enumerate(table.axes.values()):
        corners[:, i] = np.clip(np.searchsorted(nodes, points[:, i]) - 1, 0, len(nodes) - 2)
        low, high = nodes[corners[:, i]], nodes[corners[:, i] + 1]
        shares[:, i] = (points[:, i] - low) / (high - low)
    found = np.zeros(len(points))
    for corner in np.ndindex((2,) * points.shape[1]):
        weight = np.prod(np.where(corner, shares, 1 - shares), axis=1)
        found += weight * table.values[name][tuple((corners + corner).T)]
    return found


@pytest.mark.parametrize("name", ["linear-delta", "five-bar", "hexapod-42", "rotary-delta"])
@pytest.mark.parametrize("limit", [None, 10e-6])
def test_a_grid_leaves_at_other_points_what_it_states(name, limit) -> None:
    robot = lc.load_robot(name)
    truth = disturb(robot)
    (table,), found = make_tables(truth, robot, GRID, limit)
    points = lc.sample_workspace(robot, 500, 7).coordinates
    commands = points + np.column_stack(
        [interpolate(table, coordinate, points) for coordinate in robot.controlled]
    )
    led = lc.inverse(robot, commands)
    reached = lc.forward(truth, led.q).T[:, :3, 3]
    wanted = lc.inverse(robot, points).T[:, :3, 3]
    places = ["xyz".index(c) for c in robot.controlled if c in "xyz"]
    left = np.linalg.norm((reached - wanted)[:, places], axis=1).max()
    assert found.data["is_met"]
    stated = found.data["after"].value * robot.get_unit(Dimension.LENGTH).factor_to_si
    assert left <= 1.05 * stated  # its own points are others than these
    if limit is not None:
        assert stated <= limit


def test_four_times_the_accuracy_takes_twice_the_intervals() -> None:
    """Linear interpolation errs by the square of the spacing."""
    robot = lc.load_robot("linear-delta")
    truth, intervals = disturb(robot), []
    for limit in (4e-6, 1e-6, 0.25e-6):
        (table,), _ = make_tables(truth, robot, HEIGHT, limit)
        intervals.append([len(nodes) - 1 for nodes in table.axes.values()])
    ratios = np.array(intervals[1:]) / intervals[:-1]
    assert ((ratios > 1.6) & (ratios < 2.5)).all()


def test_errors_of_straight_axes_remain_as_zero_not_as_rounding() -> None:
    robot = lc.load_robot("core-xy")
    found = make_tables(disturb(robot), robot, GRID, 1e-6)[1]
    assert found.data["after"].value == 0.0
    assert " to 0 mm, at " in str(found)


def test_a_table_that_is_too_small_says_so() -> None:
    robot = lc.load_robot("linear-delta")
    small = TableSize("height", 30, 8)
    (table,), found = make_tables(disturb(robot), robot, small, 1e-6)
    assert table.values["z"].size <= 30
    assert not found.data["is_met"]
    assert found.data["after"].value > 1e-3
    assert found.data["others"] == ("x", "y")
    assert float(found.data["rests"][0].removesuffix(" mm")) > 0.1


def test_periodic_errors_of_screws_are_corrected_by_tables_of_readings(tmp_path) -> None:
    text = list_shipped_robots()["hexapod-42"].read_text("utf-8")
    text += (
        "\ndrives:\n  q: {reads: length, stroke: [-75, 75], period: 40, "
        "unknown: [gain, sin1, cos1], length: {sd: 0.02}, ratio: {sd: 0.001}}\n"
    )
    robot = load_text(tmp_path, text)
    own = [".gain" in n or "1" in n.rpartition(".")[2] for n in robot.parameters.names]
    truth = robot.with_values(np.where(own, disturb(robot).values, robot.values))
    tables, found = make_tables(truth, robot, READINGS, 2e-6)
    assert found.data["is_met"]
    assert found.data["before"].value > 0.02  # [mm]
    assert [len(t.axes) for t in tables] == [1] * 6
    # joint centers in addition: no table of a reading corrects them, which is stated
    found = make_tables(disturb(robot), robot, READINGS, 2e-6)[1]
    assert not found.data["is_met"]


def test_machines_without_tables_are_refused() -> None:
    delta, tripod = lc.load_robot("linear-delta"), lc.load_robot("3-prs")
    reasons = []
    for robot, controller, size in (
        (disturb(tripod), tripod, GRID),
        (disturb(lc.load_robot("five-bar")), lc.load_robot("five-bar"), HEIGHT),
        (delta, delta, GRID),
        (delta, lc.load_robot("hexapod-42"), GRID),
    ):
        with pytest.raises(DataError) as refused:
            make_tables(robot, controller, size)
        assert refused.value.finding is not None
        reasons.append(refused.value.finding.data["reason"])
    assert reasons == ["tilt", "height", "equal", "other"]


def test_a_controller_that_reaches_no_pose_is_refused() -> None:
    robot = lc.load_robot("linear-delta")
    arms = np.array([name.startswith("arm") for name in robot.parameters.names])
    short = robot.with_values(
        np.where(arms, 0.106, robot.values)
    )  # one millimeter above its radius
    with pytest.raises(DataError) as refused:
        make_tables(robot, short.with_values(short.values), GRID)
    assert refused.value.finding is not None
    assert refused.value.finding.data["reason"] == "nowhere"


def test_nodes_out_of_reach_leave_the_reached_points_correct(tmp_path) -> None:
    """The corners of a square around the round bed of a delta."""
    text = list_shipped_robots()["linear-delta"].read_text("utf-8")
    wide = text.replace("x: [-60, 60], y: [-60, 60]", "x: [-110, 110], y: [-110, 110]")
    robot = load_text(tmp_path, wide)
    truth = disturb(robot)
    assert not lc.inverse(robot, np.array([[0.11, 0.11, 0.0]])).converged[0]
    points = np.random.default_rng(7).uniform([-0.11, -0.11, 0.0], [0.11, 0.11, 0.25], (3000, 3))
    points = points[np.hypot(*points[:, :2].T) < 0.105]
    for size, at in ((GRID, points), (HEIGHT, points * [1, 1, 0])):
        (table,), found = make_tables(truth, robot, size)
        commands = at.copy()
        for name in table.values:
            commands[:, "xyz".index(name)] += interpolate(table, name, at[:, : len(table.axes)])
        reached = lc.forward(truth, lc.inverse(robot, commands).q).T[:, :3, 3]
        left = (reached - at)[:, ["xyz".index(name) for name in table.values]]
        assert found.data["is_met"]
        assert np.linalg.norm(left, axis=1).max() * 1e3 < found.data["after"].value
        assert np.linalg.norm(left, axis=1).max() < 0.15e-3  # [m] of 0.8 without the table


@pytest.mark.parametrize("name", ["hexapod-42", "tricept", "cable-4", "core-xy"])
def test_a_skew_leaves_after_the_best_motion_what_it_states(name) -> None:
    robot = lc.load_robot(name)
    (table,), found = make_tables(disturb(robot), robot, TableSize("skew", 0, 0))
    assert set(table.values) == {"xy", "xz", "yz", "x", "y", "z"}
    if name == "core-xy":  # of these the one with straight axes
        assert found.data["after"].value < 0.5 * found.data["before"].value
    assert found.data["others"] == robot.controlled[3:]
    assert bool(found.data["rests"]) == bool(robot.controlled[3:])


def test_angles_that_a_height_map_leaves_are_stated() -> None:
    robot = lc.load_robot("hexapod-42")
    found = make_tables(disturb(robot), robot, HEIGHT)[1]
    assert found.data["others"] == ("x", "y", "roll", "pitch", "yaw")
    assert [text.split()[1] for text in found.data["rests"]] == ["mm", "deg"]
