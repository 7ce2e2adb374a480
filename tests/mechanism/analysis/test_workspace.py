# SPDX-License-Identifier: Apache-2.0
"""Samples of a workspace: even distribution, within every stroke, reproducible by seed; an empty
workspace is refused.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import MechanismError
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.compilation import build
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests import zoo


def test_samples_are_within_ranges_and_strokes_and_round_trip():
    robot = load_robot("hexapod-42")
    result = sample_workspace(robot, 300, seed=1)
    low, high = np.array([robot.assembly.workspace[name] for name in robot.controlled]).T
    assert ((result.coordinates >= low) & (result.coordinates <= high)).all()
    assert np.abs(result.solution.q).max() <= 0.075
    # [1, m]: rounding over Newton
    assert_allclose(forward(robot, result.solution.q).T, result.solution.T, atol=1e-12)
    assert 0.95 < result.reachable_share < 1.0
    assert all(name.startswith("stroke of q") for name in result.rejected)


def test_seed_determines_the_samples():
    robot = zoo.delta()
    assert_array_equal(
        sample_workspace(robot, 50, seed=3).coordinates,
        sample_workspace(robot, 50, seed=3).coordinates,
    )
    assert (
        sample_workspace(robot, 50, seed=3).coordinates
        != sample_workspace(robot, 50, seed=4).coordinates
    ).all()


def test_sampled_tilt_is_uniform_over_the_spherical_cap():
    robot = load_robot("3-prs")
    result = sample_workspace(robot, 4000, seed=0)
    theta = result.coordinates[:, robot.controlled.index("theta")]
    low, high = robot.assembly.workspace["theta"]
    share = (np.cos(low) - np.cos(theta)) / (np.cos(low) - np.cos(high))
    # uniform on (0, 1): the mean of 4000 is within 4 standard deviations of a half in all but 6 of
    # 1e5 seeds
    assert abs(share.mean() - 0.5) < 4 / np.sqrt(12 * 4000)
    assert abs(np.quantile(share, 0.1) - 0.1) < 4 * np.sqrt(0.09 / 4000)


def test_empty_workspace_is_refused_with_its_reason():
    robot = build_delta_with_workspace({"x": (5.0, 6.0), "y": (-0.08, 0.08), "z": (0.0, 0.2)})
    with pytest.raises(
        MechanismError, match=r"almost nothing .*: 0 of .* reason: the loops cannot be closed"
    ):
        sample_workspace(robot, 10)
    robot = build_delta_with_workspace(
        {"x": (-0.08, 0.08), "y": (-0.08, 0.08), "z": (0.0, 0.2)}, stroke=(0.9, 1.0)
    )
    with pytest.raises(MechanismError, match="reason: stroke of q1 is exceeded"):
        sample_workspace(robot, 10)


@pytest.mark.parametrize(("share", "is_refused"), [(0.005, True), (0.02, False)])
def test_workspace_is_refused_where_drawing_from_it_would_take_long(share, is_refused):
    """A stroke cuts the reachable share of z down; 1 % of the positions must be left."""
    ranges = {"x": (-1e-9, 1e-9), "y": (-1e-9, 1e-9), "z": (0.0, 0.1)}
    q = inverse(build_delta_with_workspace(ranges), [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1 * share]]).q
    robot = build_delta_with_workspace(ranges, stroke=(float(q.min()), float(q.max())))
    if not is_refused:
        assert sample_workspace(robot, 200).reachable_share == pytest.approx(share, rel=0.3)
        return
    with pytest.raises(MechanismError, match=r"of 2000 .*at least 1% are needed"):
        sample_workspace(robot, 200)


def test_missing_range_of_a_workspace_is_named():
    with pytest.raises(MechanismError, match="states no workspace for y"):
        sample_workspace(build_delta_with_workspace({"x": (-0.1, 0.1), "z": (0.0, 0.1)}), 10)


def build_delta_with_workspace(ranges, stroke=None):
    assembly = replace(zoo.delta().assembly, workspace=ranges)
    if stroke:
        assembly = replace(
            assembly, actuators=tuple(replace(a, stroke=stroke) for a in assembly.actuators)
        )
    return build(assembly)
