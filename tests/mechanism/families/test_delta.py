# SPDX-License-Identifier: Apache-2.0
"""Deltas with three and with six rods: where they agree, and what only six rods can model."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.drives import LengthDrive
from loopcal.mechanism.families.limbs import Copies, LimbRecord, Limbs, Prismatic, Shifts
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.families.records import MapEntry, NamedLength, Workspace
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import forward, inverse
from tests.mechanism.families.ranks import random_coordinates
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]


@cache
def build_uneven_delta() -> Mechanism:
    """Return a delta with six unequal rods and displaced joints: its platform tilts."""
    machine = load_cached_robot("linear-delta-6")
    rng = np.random.default_rng(4)
    return machine.with_values(
        machine.values + machine.parameters.tolerance * rng.standard_normal(len(machine.values))
    )


def position_derivatives(machine: Mechanism, q: Array) -> tuple[Array, Array]:
    """Return d position / d parameters (n, 3, p) and / d readings (n, 3, a)."""
    solution = forward(machine, q)
    result = differentiate_pose(machine, machine.values[None], q[None], solution.state)
    return result.parameters[0, :, 3:], result.readings[0, :, 3:]


ARM, RADIUS, STOP, TIP = 0.22, 0.105, 0.3, 0.04  # [m]
DROP = np.sqrt(ARM**2 - RADIUS**2)
PLACE = Workspace(x=(-0.06, 0.06), y=(-0.06, 0.06), z=(0.0, 0.25))


@cache
def build_equal_deltas() -> tuple[Mechanism, Mechanism]:
    """Return deltas of three and six rods with equal geometry to the last digit."""
    angles = tuple(np.deg2rad((210.0, 330.0, 90.0)).tolist())
    three = LinearDelta(
        name="three",
        radius=RADIUS,
        angles=angles,
        arms=ARM,
        stops=STOP,
        home=PoseRecord(z=0.12),
        workspace=PLACE,
    )
    limbs = tuple(
        LimbRecord(
            name=name,
            chain=(
                Prismatic(
                    joint="P",
                    name="carriage",
                    at=(TIP + RADIUS, y, 0.0),
                    actuated="q",
                    start=0.12 + DROP,
                ),
            ),
            ending="distance",
            length=ARM,
            attach=(TIP, y, 0.0),
            copies=Copies(count=3, start=angles[0]),
            errors=(Shifts(of="rod", shift=("length",)),),
        )
        for name, y in (("left", 0.03), ("right", -0.03))
    )
    radius = tuple(MapEntry(limb=name, element="carriage", axis="x") for name in ("left", "right"))
    six = Limbs(
        name="six",
        controlled=("x", "y", "z"),
        drives={
            "q": LengthDrive(reads="length", gain=-1.0, offset=STOP + DROP, unknown=("offset",))
        },
        limbs=limbs,
        parameters=(NamedLength(name="radius", length=TIP + RADIUS, maps=radius),),
        home=PoseRecord(z=0.12),
        workspace=PLACE,
    )
    return build(three.expand()), build(six.expand())


def test_three_and_six_rods_agree_in_readings_poses_and_common_derivatives() -> None:
    # [m] and [m/m]: rounding times the condition of three rods, about 10
    assert_same_kinematics(*build_equal_deltas(), 1e-12)


def test_robot_files_of_three_and_six_rods_agree_to_nine_digits() -> None:
    # [m] 5e-10 in the offset, times slopes of up to 10 / m
    assert_same_kinematics(
        load_cached_robot("linear-delta"), load_cached_robot("linear-delta-6"), 1e-8
    )


def assert_same_kinematics(three: Mechanism, six: Mechanism, atol: float) -> None:
    """Assert equal readings, poses and common derivatives [m, m/m, m/rad]."""
    xyz = random_coordinates(three, 200, seed=5)
    q = inverse(three, xyz).q
    assert_allclose(inverse(six, xyz).q, q, rtol=0, atol=atol)
    pose = forward(six, q)
    assert_allclose(pose.T, forward(three, q).T, rtol=0, atol=atol)
    (D, J), (E, K) = position_derivatives(three, q), position_derivatives(six, q)
    assert_allclose(K, J, rtol=0, atol=atol)
    # in the six a rod's length is one of two, and its height does not depend on radius and rod: the
    # firmware's offset stop + sqrt(arm^2 - radius^2) does
    index, other = three.parameters.index, six.parameters.index
    common = np.zeros_like(E[..., 0])
    for k in (1, 2, 3):
        offset = E[..., other(f"q{k}.offset")]
        assert_allclose(offset, D[..., index(f"tower{k}.stop")], rtol=0, atol=atol)
        both = E[..., other(f"left{k}.length")] + E[..., other(f"right{k}.length")]
        assert_allclose(
            both + ARM / DROP * offset, D[..., index(f"arm{k}.length")], rtol=0, atol=atol
        )
        common += offset
    outwards = E[..., other("radius")] - RADIUS / DROP * common
    assert_allclose(outwards, D[..., index("radius")], rtol=0, atol=atol)


def test_uneven_rods_tilt_the_platform_but_reach_the_position() -> None:
    machine = build_uneven_delta()
    xyz = random_coordinates(machine, 500, seed=6)
    solution = inverse(machine, xyz)
    assert solution.converged.all()
    assert_allclose(solution.T[:, :3, 3], xyz, rtol=0, atol=1e-12)  # [m]
    tilt = np.linalg.norm(geometry.log_so3(solution.T[:, :3, :3]), axis=1)
    assert 1e-4 < np.median(tilt) < 0.1
    # both rods of a carriage at one height
    group, joints = machine.program.groups[0], solution.state.joints[0]
    for a in range(3):
        pair = joints[0][:, group.actuator[0] == a, 0]
        assert_array_equal(pair[:, 0], pair[:, 1])
    back = forward(machine, solution.q)
    assert_allclose(back.T, solution.T, rtol=0, atol=1e-12)


def test_row_of_inverse_kinematics_does_not_depend_on_other_rows() -> None:
    machine = build_uneven_delta()
    xyz = random_coordinates(machine, 40, seed=7)
    together = inverse(machine, xyz)
    for row in (0, 17, 39):
        alone = inverse(machine, xyz[row : row + 1])
        assert_array_equal(alone.q[0], together.q[row])
        assert_array_equal(alone.T[0], together.T[row])


def test_reachable_pose_of_an_uneven_delta_is_kept() -> None:
    machine = build_uneven_delta()
    solution = inverse(machine, random_coordinates(machine, 20, seed=8))
    again = inverse(machine, solution.T)
    assert_allclose(again.T, solution.T, rtol=0, atol=1e-10)


def test_unreachable_position_is_marked() -> None:
    assert not inverse(build_uneven_delta(), np.array([[0.4, 0.0, 0.1]])).converged[0]


@pytest.mark.parametrize("name", ["linear-delta", "linear-delta-6"])
def test_carriages_are_above_the_nozzle_at_home(name: str) -> None:
    machine = load_cached_robot(name)
    assert all((joints[..., 0] > machine.home[2, 3]).all() for joints in machine.home_state.joints)
