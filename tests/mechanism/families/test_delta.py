# SPDX-License-Identifier: Apache-2.0
"""The delta with three rods and the one with six: alike where they must be, and what only the six can do."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from loopcal import se3
from loopcal.io.robot_file import load_robot
from loopcal.mechanism import Mechanism, forward, inverse
from loopcal.mechanism.trials import sensitivity
from tests.mechanism.families.ranks import coordinates

Array = NDArray[np.float64]


@cache
def robot(name: str) -> Mechanism:
    return load_robot(name)


@cache
def uneven() -> Mechanism:
    """Six rods, each of its own length, joints displaced: the platform tilts by milliradians."""
    machine = robot("linear-delta-6")
    rng = np.random.default_rng(4)
    return machine.with_values(machine.values + machine.parameters.tolerance * rng.standard_normal(len(machine.values)))


def slopes(machine: Mechanism, q: Array) -> tuple[Array, Array]:
    """d position (n, 3, p) and (n, 3, a)."""
    solution = forward(machine, q)
    found = sensitivity(machine, machine.values[None], q[None], solution.state)
    return found.parameters[0, :, 3:], found.readings[0, :, 3:]


def test_three_and_six_rods_agree_in_readings_poses_and_common_slopes() -> None:
    three, six = robot("linear-delta"), robot("linear-delta-6")
    xyz = coordinates(three, 200, seed=5)
    q = inverse(three, xyz).q
    np.testing.assert_allclose(inverse(six, xyz).q, q, rtol=0, atol=1e-9)  # [m] the file's offset has nine digits
    pose = forward(six, q)
    np.testing.assert_allclose(pose.T, forward(three, q).T, rtol=0, atol=1e-9)
    (D, J), (E, K) = slopes(three, q), slopes(six, q)
    np.testing.assert_allclose(K, J, rtol=0, atol=1e-8)
    # in the six a rod's length is one of two, and its height does not depend on radius and rod: the firmware's offset
    # stop + sqrt(arm^2 - radius^2) does
    arm, radius = 0.22, 0.105
    drop = np.sqrt(arm**2 - radius**2)
    index, other = three.parameters.index, six.parameters.index
    common = np.zeros_like(E[..., 0])
    for k in (1, 2, 3):
        offset = E[..., other(f"q{k}.offset")]
        np.testing.assert_allclose(offset, D[..., index(f"tower{k}.stop")], rtol=0, atol=1e-8)
        both = E[..., other(f"left{k}.length")] + E[..., other(f"right{k}.length")]
        np.testing.assert_allclose(both + arm / drop * offset, D[..., index(f"arm{k}.length")], rtol=0, atol=1e-7)
        common += offset
    outwards = E[..., other("radius")] - radius / drop * common
    np.testing.assert_allclose(outwards, D[..., index("radius")], rtol=0, atol=1e-7)


def test_uneven_rods_tilt_the_platform_and_the_position_is_still_reached() -> None:
    machine = uneven()
    xyz = coordinates(machine, 500, seed=6)
    there = inverse(machine, xyz)
    assert there.converged.all()
    np.testing.assert_allclose(there.T[:, :3, 3], xyz, rtol=0, atol=1e-12)  # [m]
    tilt = np.linalg.norm(se3.log_so3(there.T[:, :3, :3]), axis=1)
    assert 1e-4 < np.median(tilt) < 0.1
    # both rods of a carriage at one height
    group, joints = machine.program.groups[0], there.state.joints[0]
    for a in range(3):
        pair = joints[0][:, group.actuator[0] == a, 0]
        np.testing.assert_array_equal(pair[:, 0], pair[:, 1])
    back = forward(machine, there.q)
    np.testing.assert_allclose(back.T, there.T, rtol=0, atol=1e-12)


def test_a_row_does_not_depend_on_its_neighbours() -> None:
    machine = uneven()
    xyz = coordinates(machine, 40, seed=7)
    together = inverse(machine, xyz)
    for row in (0, 17, 39):
        alone = inverse(machine, xyz[row : row + 1])
        np.testing.assert_array_equal(alone.q[0], together.q[row])
        np.testing.assert_array_equal(alone.T[0], together.T[row])


def test_the_nearest_reachable_pose_keeps_a_pose_that_is_reachable() -> None:
    machine = uneven()
    there = inverse(machine, coordinates(machine, 20, seed=8))
    again = inverse(machine, there.T)
    np.testing.assert_allclose(again.T, there.T, rtol=0, atol=1e-10)


def test_a_place_out_of_reach_is_marked() -> None:
    assert not inverse(uneven(), np.array([[0.4, 0.0, 0.1]])).converged[0]


@pytest.mark.parametrize("name", ["linear-delta", "linear-delta-6"])
def test_the_carriages_stand_above_the_nozzle(name: str) -> None:
    machine = robot(name)
    assert all((joints[..., 0] > machine.home[2, 3]).all() for joints in machine.home_state.joints)
