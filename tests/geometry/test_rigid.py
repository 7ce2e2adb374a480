# SPDX-License-Identifier: Apache-2.0
"""Poses form a group; twists, pose differences and transport matrices agree with it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from loopcal import geometry
from tests.jacobians import check_jacobian

ROUNDING = 2e-14  # [1] and [m], double rounding over three products of poses of a few meters
coordinate = st.floats(-1.7, 1.7)
twist = st.lists(coordinate, min_size=6, max_size=6).map(np.array)
poses = twist.map(lambda x: geometry.apply_twist(np.eye(4), x))


@given(poses, poses, poses)
def test_poses_form_a_group(a, b, c):
    back = geometry.invert_pose(a)
    assert_allclose((a @ b) @ c, a @ (b @ c), atol=ROUNDING)
    assert_allclose(a @ back, np.eye(4), atol=ROUNDING)
    assert_allclose(back @ a, np.eye(4), atol=ROUNDING)
    assert_allclose(geometry.invert_pose(a @ b), geometry.invert_pose(b) @ back, atol=ROUNDING)


@given(poses, poses)
def test_pose_difference_is_the_twist_from_one_pose_to_the_other(a, b):
    assert_allclose(geometry.apply_twist(b, geometry.pose_difference(a, b)), a, atol=ROUNDING)


@pytest.mark.slow
def test_transport_matrix_is_the_derivative_of_a_tool_pose_in_another_frame():
    rng = np.random.default_rng(1)
    T_base_platform, T_platform_tool, T_base_frame = geometry.apply_twist(
        np.eye(4), rng.normal(size=(3, 6))
    )
    T_frame_base = geometry.invert_pose(T_base_frame)
    start = T_frame_base @ T_base_platform @ T_platform_tool
    arm = T_base_platform[:3, :3] @ T_platform_tool[:3, 3]

    def seen(x):
        return geometry.pose_difference(
            T_frame_base @ geometry.apply_twist(T_base_platform, x) @ T_platform_tool, start
        )

    check_jacobian(
        seen,
        geometry.transport_matrix(arm, T_frame_base[:3, :3]),
        np.zeros(6),
        scale=0.3,
        automatic=seen,
    )
    assert_allclose(geometry.transport_matrix(arm)[:3, :3], np.eye(3))


def test_leading_axes_broadcast():
    T = geometry.make_pose(geometry.exp_so3(np.zeros((4, 1, 3))), np.ones((5, 3)))
    assert T.shape == (4, 5, 4, 4)
    assert geometry.apply_twist(np.eye(4), np.zeros((4, 5, 6))).shape == (4, 5, 4, 4)
    assert geometry.pose_difference(T, np.eye(4)).shape == (4, 5, 6)
    assert geometry.transport_matrix(np.ones((4, 5, 3)), np.eye(3)).shape == (4, 5, 6, 6)
