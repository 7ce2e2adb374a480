# SPDX-License-Identifier: Apache-2.0
"""Kinematics agree with numbers printed by LinuxCNC's genhexkins and lineardeltakins (see the
README of the data).
"""

import csv
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.records import PoseRecord
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from tests import zoo


def read_columns(path, names):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return np.array([[float(row[name]) for name in names.split()] for row in rows])


@pytest.fixture(scope="module")
def oracle_folder(data_folder):
    return data_folder / "kinematics_oracles"


@pytest.fixture(scope="module")
def hexapod(oracle_folder):
    """Return the hexapod, 200 poses, their strut lengths, and the poses that genhexkins computed
    from these lengths, in the unit of genhexkins.
    """
    geometry = json.loads((oracle_folder / "genhexkins_geometry.json").read_text("utf-8"))
    robot = zoo.gough(
        "genhexkins", np.array(geometry["base"]), np.array(geometry["platform"]), 0.0, 20.0
    )
    path = oracle_folder / "genhexkins_default_200poses.csv"
    degrees = np.array([1.0, 1.0, 1.0, *[np.pi / 180] * 3])
    given_poses = zoo.make_poses(read_columns(path, "x y z a_deg b_deg c_deg") * degrees)
    result = zoo.make_poses(read_columns(path, "fk_x fk_y fk_z fk_a fk_b fk_c") * degrees)
    return robot, given_poses, read_columns(path, "L0 L1 L2 L3 L4 L5"), result


def test_strut_lengths_agree_with_genhexkins(hexapod):
    robot, poses, lengths, _ = hexapod
    sol = inverse(robot, poses)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert len(poses) == 200
    assert_allclose(sol.q, lengths, rtol=0, atol=1e-9)  # its poses are printed to 1e-10


def test_poses_of_genhexkins_lengths_agree_with_genhexkins(hexapod):
    robot, poses, lengths, result = hexapod
    sol = forward(robot, inverse(robot, poses).q)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert_allclose(geometry.pose_difference(sol.T, poses), 0.0, atol=1e-10)
    theirs = forward(robot, lengths)
    assert_array_equal(theirs.status, Status.CONVERGED)
    # its own iteration stops there
    assert_allclose(geometry.pose_difference(theirs.T, result), 0.0, atol=1e-7)


def test_carriages_and_poses_agree_with_lineardeltakins(oracle_folder):
    # its carriages are counted upwards; R 130.25 and L 269 are its defaults, towers at 90, 210 and
    # 330 degrees
    record = LinearDelta(
        name="lineardeltakins", radius=130.25, angles=tuple(np.deg2rad((90.0, 210.0, 330.0)).tolist()), arms=269.0,  # noqa: E501
        stops=-float(np.sqrt(269.0**2 - 130.25**2)), readings="height", home=PoseRecord(z=50.0),
    )  # fmt: skip
    robot, path = build(record.expand()), oracle_folder / "lineardeltakins_default_200poses.csv"
    points, carriages, result = (
        read_columns(path, names) for names in ("x y z", "j0 j1 j2", "fk_x fk_y fk_z")
    )
    sol = inverse(robot, points)
    assert len(points) == 200
    assert_array_equal(sol.status, Status.CONVERGED)
    assert_allclose(sol.q, carriages, rtol=0, atol=1e-9)
    back = forward(robot, carriages)
    assert_array_equal(back.status, Status.CONVERGED)
    assert_allclose(back.T[:, :3, 3], result, rtol=0, atol=1e-9)
    assert_allclose(forward(robot, sol.q).T[:, :3, 3], points, rtol=0, atol=1e-10)
