# SPDX-License-Identifier: Apache-2.0
"""Differences of poses are those of `loopcal.geometry`."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from tests.engine.conftest import list_engines_with

ANGLES = [0.0, 1e-160, 1e-12, 1e-8, 1e-5, 1e-3, 0.3, 0.8, 1.0, 1.6, 2.4, 3.0, np.pi - 1e-9, np.pi]


@pytest.fixture(scope="module", params=list_engines_with("compare_poses"), ids=str)
def compare(request) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return the function of an engine that has it."""
    return request.param.compare_poses


def draw_poses(angle: float, t: int = 3, n: int = 13) -> tuple[np.ndarray, np.ndarray]:
    """Return poses (t, n, 4, 4), and references (t, n, 12) that are turned by an angle [rad]."""
    rng = np.random.default_rng(int(1e3 * angle))
    axis = rng.normal(size=(t, n, 3))
    turn = geometry.exp_so3(angle * axis / np.linalg.norm(axis, axis=-1, keepdims=True))
    R, places = geometry.exp_so3(rng.uniform(-4.0, 4.0, (t, n, 3))), rng.normal(size=(t, n, 3))
    T = geometry.make_pose(turn @ R, rng.normal(size=(t, n, 3)))
    return T, np.concatenate([R.reshape(t, n, 9), places], axis=-1)


@pytest.mark.parametrize("angle", ANGLES)
def test_differences_and_derivatives_are_those_of_geometry(compare, angle):
    T, reference = draw_poses(angle)
    residual, by_twist = compare(T, reference)
    R = T[..., :3, :3] @ reference[..., :9].reshape(3, 13, 3, 3).swapaxes(-1, -2)
    expected = geometry.log_so3(R)
    # 1e-15 [rad]: rounding of angles up to pi; near pi of the axis, whose sign is open at pi
    sign = np.sign((residual[..., :3] * expected).sum(axis=-1, keepdims=True))
    sign = np.where(np.pi - angle < 1e-7, sign, 1.0)
    assert_allclose(residual[..., :3], sign * expected, rtol=0, atol=2e-15)
    assert_array_equal(residual[..., 3:], T[..., :3, 3] - reference[..., 9:])
    inverse = geometry.left_jacobian_inverse_so3(residual[..., :3])
    assert_allclose(by_twist[..., :3, :3], inverse, rtol=0, atol=2e-15)
    assert_array_equal(by_twist[..., 3:, 3:], np.broadcast_to(np.eye(3), (3, 13, 3, 3)))
    assert not by_twist[..., :3, 3:].any()
    assert not by_twist[..., 3:, :3].any()


def test_poses_do_not_depend_on_those_beside_them_bit_for_bit(compare):
    T, reference = draw_poses(0.4)
    together = compare(T, reference)
    for i, j in ((0, 0), (1, 12), (2, 7)):
        row = slice(i, i + 1), slice(j, j + 1)
        for mine, ours in zip(compare(T[row], reference[row]), together, strict=True):
            assert_array_equal(mine[0, 0], ours[i, j])


def test_one_pose_or_reference_stands_for_all_trials(compare):
    T, reference = draw_poses(0.4)
    for some, others in ((T[:1], reference), (T, reference[:1])):
        whole = [np.broadcast_to(a, (3, *a.shape[1:])) for a in (some, others)]
        expected = compare(*whole)
        for mine, ours in zip(compare(some, others), expected, strict=True):
            assert_array_equal(mine, ours)


def test_nothing_is_compared_without_poses(compare):
    for t, others, n in ((2, 2, 0), (1, 2, 0), (0, 1, 3), (1, 0, 3)):
        residual, by_twist = compare(np.zeros((t, n, 4, 4)), np.zeros((others, n, 12)))
        trials = others if t == 1 else t
        assert residual.shape == (trials, n, 6)
        assert by_twist.shape == (trials, n, 6, 6)
