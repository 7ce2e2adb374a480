# SPDX-License-Identifier: Apache-2.0
"""Controlled coordinates: round trip, and derivatives, also at zero tilt."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.errors import MechanismError
from loopcal.mechanism.platform_coordinates import (
    check_coordinates,
    compare_coordinates,
    pose_from_coordinates,
    read_coordinates,
)
from tests.jacobians import check_jacobian

COORDINATE_SETS = [
    ("x", "y", "z", "roll", "pitch", "yaw"),
    ("x", "y", "z", "phi", "theta", "psi"),
    ("z", "phi", "theta"),
    ("x", "yaw"),
    ("pitch", "psi")[:1],
]
SIZE = 0.3


def random_poses(n, tilt=1.2, seed=3):
    rng = np.random.default_rng(seed)
    angles = rng.uniform([-3.0, 0.05, -3.0], [3.0, tilt, 3.0], (n, 3))
    return geometry.make_pose(geometry.tilt_torsion_to_matrix(angles), rng.normal(size=(n, 3)))


@pytest.mark.slow
@pytest.mark.parametrize("names", COORDINATE_SETS)
@given(part=st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6))
def test_coordinates_round_trip(names, part):
    low = {"phi": -3.1, "theta": 0.001, "psi": -3.1, "roll": -3.1, "pitch": -1.5, "yaw": -3.1}
    high = {"theta": 3.0, "pitch": 1.5}
    ends = np.array([(low.get(n, -1.0), high.get(n, 3.1 if n in low else 1.0)) for n in names])
    values = ends[:, 0] + np.array(part[: len(names)]) * (ends[:, 1] - ends[:, 0])
    T = pose_from_coordinates(values, names, np.eye(4))
    # phi and roll lose what the sine of the tilt and the cosine of the pitch take
    assert_allclose(read_coordinates(T, names), values, atol=1e-12)


def test_unnamed_coordinates_keep_their_values():
    base = geometry.make_pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    T = pose_from_coordinates(np.array([[0.5, 0.2]]), ("z", "yaw"), base)
    assert_allclose(T[0, :3, 3], [1.0, 2.0, 0.5])
    assert_allclose(T[0, :3, :3], geometry.rotation_about_axis(0.2, 2))


@pytest.mark.parametrize("names", [*COORDINATE_SETS, ("roll",), ("psi",)])
@pytest.mark.parametrize("off", [0.0, 0.3])
def test_derivatives_of_every_coordinate_agree_with_differences(names, off):
    T = random_poses(5)
    target = read_coordinates(T, names) + off
    _, columns = compare_coordinates(T, target, names, SIZE)

    def moved(x):
        return compare_coordinates(
            geometry.apply_twist(T, np.broadcast_to(x, (5, 6))), target, names, SIZE
        )[0]

    check_jacobian(moved, columns, np.zeros(6), scale=0.05)


@pytest.mark.parametrize("names", [("x", "y", "z", "phi", "theta", "psi"), ("z", "phi", "theta")])
@pytest.mark.parametrize("phi", [0.0, 2.0])
def test_coordinate_derivatives_are_regular_at_zero_tilt(names, phi):
    T = geometry.make_pose(geometry.tilt_torsion_to_matrix(np.array([phi, 0.0, 0.4])), np.ones(3))[
        None
    ]
    values = {"x": 1.0, "y": 1.0, "z": 1.0, "phi": phi, "theta": 0.0, "psi": 0.4}
    target = np.array([[values[n] for n in names]])
    residual, columns = compare_coordinates(T, target, names, SIZE)
    assert_allclose(residual, 0.0, atol=1e-15)
    assert np.linalg.matrix_rank(columns[0]) == len(names)

    def moved(x):
        return compare_coordinates(geometry.apply_twist(T, x[None]), target, names, SIZE)[0]

    check_jacobian(moved, columns, np.zeros(6), scale=0.05)


def test_angle_differences_are_taken_the_short_way_around():
    T = pose_from_coordinates(np.array([[np.pi - 0.01]]), ("yaw",), np.eye(4))
    residual, _ = compare_coordinates(T, np.array([[-np.pi + 0.01]]), ("yaw",), SIZE)
    assert_allclose(residual, -0.02 * SIZE)


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (("x", "height"), "'height' is not a platform coordinate. Allowed: x, y, z, roll"),
        (("x", "x"), "duplicate coordinate in x, x"),
        (("roll", "psi"), "roll, psi mixes roll-pitch-yaw with phi-theta-psi"),
        (("z", "theta"), "phi and theta give the direction of the normal together"),
    ],
)
def test_invalid_sets_of_coordinates_are_refused(names, sentence):
    with pytest.raises(MechanismError, match=sentence):
        check_coordinates(names)
