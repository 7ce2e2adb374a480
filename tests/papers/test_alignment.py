# SPDX-License-Identifier: Apache-2.0
"""Errors after the alignment that data leave open."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal import geometry
from loopcal.errors import DataError
from loopcal.papers.alignment import align, align_points
from tests import zoo

RNG = np.random.default_rng(3)
T = zoo.poses_of(RNG.uniform(-0.4, 0.4, (12, 6)))
BASE = zoo.place((1.0, -2.0, 0.5), (2.0, 1.5, -0.7))
TOOL = zoo.place((0.1, 0.05, -0.2), (-0.4, 1.1, 0.6))


@pytest.mark.parametrize(
    ("base", "tool"), [(False, False), (True, False), (False, True), (True, True)]
)
def test_frames_that_are_open_are_found_and_nothing_is_left(base, tool):
    reference = (BASE if base else np.eye(4)) @ T @ (TOOL if tool else np.eye(4))
    found = align(T, reference, base=base, tool=tool, size=0.2)
    assert_allclose(
        found.errors(T, reference), 0.0, atol=1e-12
    )  # [rad, m] rounding over a few products
    assert_allclose(found.T_base, BASE if base else np.eye(4), atol=1e-12)
    assert ("base" in found.sentence) == base
    assert ("tool" in found.sentence) == tool


def test_what_is_left_is_a_minimum_of_the_stated_sum():
    noise = RNG.normal(size=(12, 6)) * [1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4]
    reference = geometry.apply_twist(BASE @ T @ TOOL, noise)
    weight = np.array([0.2, 0.2, 0.2, 1.0, 1.0, 1.0])

    def total(found):
        return float(np.sum((weight * found.errors(T, reference)) ** 2))

    found = align(T, reference, base=True, tool=True, size=0.2)
    least = total(found)
    assert least < np.sum((weight * noise) ** 2)
    for step in np.concatenate([np.eye(6), -np.eye(6)]) * 1e-5:
        assert total(replace(found, T_base=geometry.apply_twist(found.T_base, step))) > least
        assert total(replace(found, T_tool=geometry.apply_twist(found.T_tool, step))) > least


def test_an_error_that_is_no_gauge_stays():
    reference = BASE @ geometry.apply_twist(
        T, np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1e-3], (12, 1)) * (np.arange(12.0) % 2)[:, None]
    )
    left = align(T, reference, base=True, tool=False, size=0.2).errors(T, reference)
    assert 0.3e-3 < np.sqrt(np.mean(left[:, 3:] ** 2) * 3) < 0.6e-3


def test_points_are_aligned_too_and_a_line_of_them_is_refused():
    points = RNG.normal(size=(5, 3))
    found, left = align_points(points, points @ BASE[:3, :3].T + BASE[:3, 3])
    assert_allclose(found, BASE, atol=1e-12)
    assert_allclose(left, 0.0, atol=1e-12)
    with pytest.raises(DataError, match="give three points that form a triangle"):
        align_points(np.outer(np.arange(4.0), [1.0, 2.0, 3.0]), points[:4])


def test_too_few_poses_and_other_shapes_are_refused():
    with pytest.raises(DataError, match="2 poses are too few to align 2 frames; give at least 3"):
        align(T[:2], T[:2], base=True, tool=True, size=1.0)
    with pytest.raises(DataError, match="cannot be aligned"):
        align(T, T[:5], base=True, tool=False, size=1.0)
