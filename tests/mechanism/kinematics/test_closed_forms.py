# SPDX-License-Identifier: Apache-2.0
"""Kinematics agree with a published table, with closed forms, and with numbers of LinuxCNC."""

import csv
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.mechanism.compilation import build
from loopcal.mechanism.families.linear_delta import LinearDelta
from loopcal.mechanism.families.placement import PoseRecord
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests import zoo

# Table 4 of "Numerical simulation of the calibration algorithm for a 6-DOF parallel mechanism":
# poses asked for (PT: X, Y, Z [mm]; alpha, beta, gamma in whole degrees, printed there in rad) and
# poses reached (PP, as printed: mm, rad).
TABLE_4 = """
 10   0 200  1  2  3   10.02907 -0.04008  199.991   0.017814  0.034796  0.051874
 10  10 200  2 -2  1   10.0562   9.9385   199.9848  0.0352   -0.0350    0.0174
  0  10 200  3  2 -1   0.040607  9.958774 199.9928  0.052729  0.034775 -0.01794
-10  10 200 -3 -1  1  -9.96499   9.955117 199.9963 -0.05197  -0.0176    0.016979
-10   0 200 -1  1  2  -9.96692  -0.04496  199.9954 -0.01707   0.017326  0.034433
-10 -10 200  1 -3  1  -9.96952  -10.0419  199.9906  0.01787  -0.05245   0.016936
  0 -10 200  2  3 -2   0.03019  -10.0384  199.9892  0.035264  0.052294 -0.03537
 10 -10 200  3  1  3   10.02686 -10.0388  199.9887  0.052733  0.017372  0.051853
  0   0 210 -2  2 -3   0.031535 -0.04165  209.9913 -0.03457   0.034827 -0.05282
  0   0 210  2 -2  2   0.034993 -0.04456  209.9916  0.035298 -0.03502   0.034362
"""

WITHOUT_LENGTH_ERRORS = 1  # row A2 of the table is the same machine without its six length errors

# the largest integrated error of the ten poses: norm in position [mm] plus norm in the three angles
# [rad]  # noqa: ERA001
FIRST_ERROR = 0.058938


def commanded_poses():
    rows = np.array([line.split()[:6] for line in TABLE_4.strip().splitlines()], dtype=float)
    return zoo.make_poses(rows * np.array([zoo.MM] * 3 + [np.pi / 180] * 3))


def compute_reached_poses(truth):
    robot = zoo.hexapod()
    sol = forward(robot.with_values(truth), inverse(robot, commanded_poses()).q)
    assert_array_equal(sol.status, Status.CONVERGED)
    return np.concatenate(
        [sol.T[:, :3, 3] / zoo.MM, geometry.matrix_to_euler(sol.T[:, :3, :3], "xyz")], axis=1
    )


def test_reached_poses_equal_table_4_to_one_unit_of_the_last_digit():
    printed = [line.split()[6:] for line in TABLE_4.strip().splitlines()]
    units = np.array([[10.0 ** -len(text.partition(".")[2]) for text in row] for row in printed])
    nominal = zoo.hexapod().values.reshape(6, 7)
    truth = zoo.hexapod_truth().reshape(6, 7)
    result = compute_reached_poses(truth.ravel())
    result[WITHOUT_LENGTH_ERRORS] = compute_reached_poses(
        np.column_stack([truth[:, :6], nominal[:, 6]]).ravel()
    )[WITHOUT_LENGTH_ERRORS]
    off = np.abs(result - np.array(printed, dtype=float)) / units
    assert off.max() <= 1.0
    assert np.delete(off > 0.5, WITHOUT_LENGTH_ERRORS, axis=0).sum() <= 2


def test_largest_pose_error_is_the_published_one():
    target = np.concatenate(
        [
            commanded_poses()[:, :3, 3] / zoo.MM,
            geometry.matrix_to_euler(commanded_poses()[:, :3, :3], "xyz"),
        ],
        axis=1,
    )
    error = compute_reached_poses(zoo.hexapod_truth()) - target
    integrated = np.linalg.norm(error[:, :3], axis=1) + np.linalg.norm(error[:, 3:], axis=1)
    assert round(integrated.max(), 6) == FIRST_ERROR


def readings_of_hexapod(T):
    """Distances between joint centers."""
    platform = zoo.HEXAPOD_PLATFORM * zoo.MM @ T[:, :3, :3].swapaxes(1, 2)
    legs = T[:, None, :3, 3] + platform - zoo.HEXAPOD_BASE * zoo.MM
    return np.linalg.norm(legs, axis=-1) - zoo.HEXAPOD_LENGTH * zoo.MM


def list_arms(T, radius, base):
    """Vectors (n, 3, 3) from points on the base to the platform at three equal angles."""
    angles = 2 * np.pi * np.arange(3) / 3
    out = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    return T[:, None, :3, 3] + radius * out @ T[:, :3, :3].swapaxes(1, 2) - base * out


def readings_of_3_prs(T):
    """The right triangle of rod and carriage."""
    c = list_arms(T, zoo.PRS_A, zoo.PRS_B)
    return c[..., 2] - np.sqrt(zoo.PRS_L**2 - c[..., 0] ** 2 - c[..., 1] ** 2)


def readings_of_3_rps(T):
    return np.linalg.norm(list_arms(T, 0.15, 0.25), axis=2)


def readings_of_delta(T):
    record = zoo.delta().record
    towers = record.radius * np.column_stack([np.cos(record.angles), np.sin(record.angles)])
    arms = np.array(record.arms)
    across = ((T[:, None, :2, 3] - towers) ** 2).sum(-1)
    height = np.sqrt(arms**2 - across) + T[:, None, 2, 3]
    return np.array(record.stops) + np.sqrt(arms**2 - record.radius**2) - height


def readings_of_five_bar(T):
    """Two triangles."""
    q = []
    for pivot, crank, rod, side in [(-0.07, 0.1, 0.22, 1), (0.07, 0.15, 0.2, -1)]:
        x, y = T[:, 0, 3] - pivot, T[:, 1, 3]
        d = np.hypot(x, y)
        inner = np.arccos((crank**2 + d**2 - rod**2) / (2 * crank * d))
        q.append(np.arctan2(y, x) + side * inner)
    return np.stack(q, axis=1)


def readings_of_6_rus(T):
    """The intersection of the circle of a crank and the sphere of its rod."""
    servo, crank, rod = np.array([0.1, 0.04, 0.0]), 0.025, 0.16
    ball, q = np.array([0.045886, 0.065532, 0.0]), []
    for k in range(6):
        turn, side = geometry.rotation_about_axis(2 * np.pi / 3 * (k % 3), 2), 1 if k < 3 else -1
        mirror = np.array([1, side, 1])
        to_ball = T[:, :3, 3] + T[:, :3, :3] @ turn @ (mirror * ball) - turn @ (mirror * servo)
        a, b = to_ball @ turn @ [0, side, 0], to_ball[:, 2]  # at zero and at 90 degrees
        c = ((to_ball**2).sum(axis=1) + crank**2 - rod**2) / (2 * crank)
        q.append(np.arctan2(b, a) - np.arccos(c / np.hypot(a, b)))
    return np.stack(q, axis=1)


def readings_of_agile_eye(T):
    """The elbow axis of limb 1 is (0, -sin q1, cos q1), normal to its pin axis -R (0, 1, 0); the
    other limbs are this one with the axes permuted.
    """
    return np.stack(
        [
            np.arctan2(T[:, (k + 2) % 3, (k + 1) % 3], T[:, (k + 1) % 3, (k + 1) % 3])
            for k in range(3)
        ],
        axis=1,
    )


def readings_of_orthoglide(T):
    """A carriage is behind the tool by the part of the rod along its slide."""
    p, length = T[:, :3, 3], 0.31058
    across = (p**2).sum(axis=1, keepdims=True) - p**2
    return p + length - np.sqrt(length**2 - across)


def readings_of_cable_camera(T):
    """Lengths from four masts, the first two in one reading."""
    masts = np.array([[-7, 5, 8], [7, 5, 8], [7, -5, 8], [-7, -5, 8]])
    m, n, k, h = np.linalg.norm(T[:, :3, 3] - masts[:, None], axis=2)
    return np.stack([m + n, k, h], axis=1)


def draw(low, high, n, seed):
    """Draw coordinates (n, c) evenly."""
    return np.random.default_rng(seed).uniform(low, high, (n, len(low)))


def sample(name, seed):
    return sample_workspace(zoo.load_cached_robot(name), 100, seed=seed).coordinates


PRS_RANGE = [0.65, -np.pi, 0.0], [0.75, np.pi, np.deg2rad(35)]

RPS_RANGE = [0.43, -np.pi, 0.0], [0.57, np.pi, np.deg2rad(20)]

CLOSED_FORMS = {
    "hexapod": (zoo.hexapod, commanded_poses, readings_of_hexapod, 1e-15),
    "3-prs": (zoo.three_prs, lambda: draw(*PRS_RANGE, 60, 2), readings_of_3_prs, 1e-13),
    "linear delta": (
        zoo.delta,
        lambda: draw([-0.08, -0.08, 0.0], [0.08, 0.08, 0.2], 50, 3),
        readings_of_delta,
        1e-14,
    ),
    "five-bar": (
        zoo.five_bar,
        lambda: draw([-0.05, 0.2], [0.05, 0.28], 20, 4),
        readings_of_five_bar,
        1e-13,
    ),
    "3-rps": (
        lambda: zoo.load_cached_robot("3-rps"),
        lambda: draw(*RPS_RANGE, 60, 5),
        readings_of_3_rps,
        1e-13,
    ),
    "6-rus": (
        lambda: zoo.load_cached_robot("6-rus"),
        lambda: sample("6-rus", 6),
        readings_of_6_rus,
        1e-12,
    ),
    "agile-eye": (
        lambda: zoo.load_cached_robot("agile-eye"),
        lambda: sample("agile-eye", 7),
        readings_of_agile_eye,
        1e-13,
    ),
    "orthoglide": (
        lambda: zoo.load_cached_robot("orthoglide"),
        lambda: sample("orthoglide", 8),
        readings_of_orthoglide,
        1e-13,
    ),
    "cable-camera": (
        lambda: zoo.load_cached_robot("cable-camera"),
        lambda: sample("cable-camera", 9),
        readings_of_cable_camera,
        1e-12,
    ),
}


"""Robot, its poses, readings (n, a) of platform poses in closed form, and tolerance [m, rad]."""


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_readings_and_poses_agree_with_closed_forms(name):
    make, list_poses, compute, atol = CLOSED_FORMS[name]
    robot, poses = make(), list_poses()
    sol = inverse(robot, poses)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert_allclose(sol.q, compute(sol.T), rtol=0, atol=atol)
    back = forward(robot, sol.q)
    assert_allclose(geometry.pose_difference(back.T, sol.T), 0.0, atol=1e-12)
    if name in ("3-prs", "3-rps"):
        # N = (a/2)(1 - cos theta)(-cos 2 phi, sin 2 phi), zero torsion
        z, phi, theta = poses.T
        half = {"3-prs": zoo.PRS_A, "3-rps": 0.15}[name] / 2 * (1 - np.cos(theta))
        N = np.stack([-half * np.cos(2 * phi), half * np.sin(2 * phi), z], axis=1)
        assert_allclose(sol.T[:, :3, 3], N, atol=1e-13)
        R = geometry.tilt_torsion_to_matrix(np.stack([phi, theta, 0.0 * phi], axis=1))
        assert_allclose(sol.T[:, :3, :3], R, atol=1e-13)
    if name == "agile-eye":
        assert_allclose(sol.T[:, :3, 3], 0.0, atol=1e-15)


def test_passive_joints_of_a_3_prs_are_the_rod_angles():
    sol = inverse(zoo.three_prs(), np.array([[0.7, 0.0, 0.0]]))
    assert sol.passive_names == ("limb1.pin", "limb2.pin", "limb3.pin")
    assert_allclose(np.cos(sol.passive), (zoo.PRS_A - zoo.PRS_B) / zoo.PRS_L, atol=1e-14)


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
