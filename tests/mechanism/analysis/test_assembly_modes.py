# SPDX-License-Identifier: Apache-2.0
"""Assembly modes and working modes: 40 of Dietmaier's hexapod, those of known robots, and
selection by `start`.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import DataError, MechanismError
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.gough import Gough
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.modes import find_assembly_modes, find_working_modes
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import driven_values
from tests import zoo

# P. Dietmaier, "The Stewart-Gough platform of general geometry can have 40 real postures" (1998,
# doi:10.1007/978-94-015-9064-8_1); numbers as in the tests of Drake's global inverse kinematics.
# Dimensionless.
DIETMAIER_BASE = (
    (0.0, 0.0, 0.0),
    (1.107915, 0.0, 0.0),
    (0.549094, 0.756063, 0.0),
    (0.735077, -0.223935, 0.525991),
    (0.514188, -0.526063, -0.368418),
    (0.590473, 0.094733, -0.205018),
)
DIETMAIER_PLATFORM = (
    (0.0, 0.0, 0.0),
    (0.542805, 0.0, 0.0),
    (0.956919, -0.528915, 0.0),
    (0.665885, -0.353482, 1.402538),
    (0.478359, 1.158742, 0.107672),
    (-0.137087, -0.235121, 0.353913),
)
DIETMAIER_LENGTHS = (1.0, 0.645275, 1.086284, 1.503439, 1.281933, 0.771071)


def build_dietmaier_hexapod():
    home = PoseRecord(z=0.8, roll=0.3, pitch=0.2, yaw=0.5)
    record = Gough(
        "dietmaier",
        base=DIETMAIER_BASE,
        platform=DIETMAIER_PLATFORM,
        lengths=DIETMAIER_LENGTHS,
        home=home,
    )
    return build(record.expand())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_dietmaier_hexapod_has_forty_assembly_modes(seed):
    result = find_assembly_modes(build_dietmaier_hexapod(), np.zeros(6), seed=seed)
    assert len(result) == 40
    assert result.solution.residual.max() < 1e-12  # of legs of length 1
    for T in result.solution.T:  # closure in closed form
        legs = np.array(DIETMAIER_PLATFORM) @ T[:3, :3].T + T[:3, 3] - DIETMAIER_BASE
        assert_allclose(np.linalg.norm(legs, axis=1), DIETMAIER_LENGTHS, atol=1e-13)
    assert result.starts_since_new >= 8192
    assert str(result).startswith("40 modes from ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "coordinates", "modes", "above"),
    [
        ("hexapod-42", (0.013, -0.007, 0.205, 0.05, -0.08, 0.11), 8, 4),
        ("hexapod-nategh-agheli", (0.03, -0.02, 0.8, 0.1, -0.05, 0.15), 16, 8),
    ],
)
def test_planar_hexapods_have_equal_counts_of_modes_above_and_below_the_base(
    robot, coordinates, modes, above
):
    machine = load_robot(robot)
    at = inverse(machine, np.array(coordinates))
    result = find_assembly_modes(machine, at.q[0])
    assert (len(result), int((result.solution.T[:, 2, 3] > 0).sum())) == (modes, above)
    # the original pose is among them
    assert np.abs(result.solution.T - at.T).max(axis=(1, 2)).min() < 1e-9


@pytest.mark.parametrize(
    ("name", "modes"), [("five-bar", 2), ("linear-delta", 2), ("rotary-delta", 2), ("cable-4", 1)]
)
def test_known_robots_have_the_counted_assembly_modes(name, modes):
    robot = load_robot(name)
    at = inverse(robot, robot.home[None])
    assert len(find_assembly_modes(robot, at.q[0], patience=4096)) == modes


@pytest.mark.parametrize(
    ("name", "modes"), [("five-bar", 4), ("3-rrr", 8), ("rotary-delta", 8), ("3-prs", 8)]
)
def test_each_driven_limb_doubles_the_working_modes(name, modes):
    robot = load_robot(name)
    target = inverse(robot, robot.home[None])
    home = find_working_modes(robot, np.array([home_coordinates(robot)]))
    assert len(home) == modes
    assert np.abs(home.solution.q - target.q).max(axis=1).min() < 1e-9  # [rad, m]


def home_coordinates(robot):
    return read_coordinates(robot.home, robot.controlled)


def test_start_selects_the_assembly_and_working_mode():
    robot = load_robot("five-bar")
    modes = find_working_modes(robot, home_coordinates(robot))
    for row in range(len(modes)):
        one = modes.solution.take(np.array([row]))
        near = inverse(robot, home_coordinates(robot) + np.array([0.005, -0.005]), start=one)
        assert np.abs(near.q - one.q).max() < 0.1
    q = modes.solution.q[0]
    both = find_assembly_modes(robot, q)
    for row in range(len(both)):
        one = both.solution.take(np.array([row]))
        assert_allclose(forward(robot, q[None], start=one).T, one.T, atol=1e-12)


def test_unreachable_readings_have_no_assembly_modes():
    result = find_assembly_modes(load_robot("linear-delta"), [5.0, -5.0, 0.0], patience=2048)
    assert len(result) == 0
    assert "0 modes" in str(result)


def test_incomplete_search_for_modes_is_refused():
    with pytest.raises(MechanismError, match="still new ones"):
        find_assembly_modes(build_dietmaier_hexapod(), np.zeros(6), patience=4096, max_starts=2048)


def test_wrong_number_of_readings_is_refused_for_assembly_modes():
    with pytest.raises(DataError, match="3 readings do not fit"):
        find_assembly_modes(zoo.hexapod(), np.zeros(3))


@pytest.mark.parametrize("stroke", [None, (5.0, 11.0)])
def test_working_modes_are_within_half_a_turn_and_ordered_by_distance_from_home(stroke):
    assembly = zoo.five_bar().assembly
    robot = build(
        replace(assembly, actuators=tuple(replace(a, stroke=stroke) for a in assembly.actuators))
    )
    result = find_working_modes(robot, home_coordinates(robot))
    low, high = stroke or (-np.pi, np.pi)
    home = inverse(robot, robot.home[None]).q[0]
    middle = (low + high) / 2
    q = result.solution.q
    assert len(result) == 4
    assert (np.abs(q - middle) <= np.pi + 1e-12).all()
    distance = np.linalg.norm(q - home, axis=1)
    assert (np.diff(distance) >= -1e-12).all()
    if stroke is None:
        assert_allclose(q[0], home, atol=1e-9)
    for row in range(4):  # readings, joints and pose belong together
        one = result.solution.take(np.array([row]))
        assert_allclose(driven_values(robot.program, one.state)[0], one.q, atol=1e-12)
        assert_allclose(forward(robot, one.q, start=one).T, one.T, atol=1e-12)
