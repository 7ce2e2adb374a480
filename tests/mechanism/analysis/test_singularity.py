# SPDX-License-Identifier: Apache-2.0
"""Distance from singularities: closed forms, findings, and paths; samples of a workspace: even
distribution, within every stroke, reproducible by seed.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.errors import DataError, MechanismError
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.compilation import build
from loopcal.mechanism.singularities import (
    analyze_singularity,
    compute_median_margins,
    trace_singularity,
)
from loopcal.mechanism.solutions import forward, inverse
from loopcal.mechanism.workspace import sample_workspace
from tests import zoo


def test_singularity_margin_of_a_hexapod_is_that_of_its_plucker_lines():
    robot, T = zoo.hexapod(), zoo.nategh_poses(np.random.default_rng(0), 5)
    T[:, 2, 3] -= 0.6
    result = analyze_singularity(robot, T)
    p = np.einsum("nij,kj->nki", T[:, :3, :3], zoo.HEXAPOD_PLATFORM * zoo.MM)
    u = p + T[:, None, :3, 3] - zoo.HEXAPOD_BASE * zoo.MM
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    lines = np.concatenate([np.cross(p, u) / robot.size, u], axis=-1)
    # [m/m] rounding
    assert_allclose(result.margin, np.linalg.svd(lines, compute_uv=False)[:, -1], atol=1e-14)
    assert (
        result.closure_sign
        == np.sign(np.linalg.det(lines)) * result.closure_sign[0] * np.sign(np.linalg.det(lines))[0]
    ).all()
    # a rod pushes along itself, whatever the pose
    assert_allclose(result.drive_margin, 1.0, atol=1e-14)


def test_hexapod_rotated_by_90_degrees_is_singular():
    # Fichter's singularity: a symmetric platform turned by 90 degrees about its normal
    result = analyze_singularity(
        zoo.hexapod(),
        np.array([[0.0, 0.0, 0.2, 0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]]),
    )
    assert result.margin[0] < 1e-9  # [m/m] six printed digits of the centers
    assert result.is_near.tolist() == [True, False]
    assert "rz" in result.motion(0)
    assert result.explain(0).code == "singularity.distance"


def test_path_through_a_singularity_warns_near_it_and_at_the_sign_change():
    robot = load_robot("hexapod-42")
    path = np.zeros((41, 6))
    path[:, 2], path[:, 5] = 0.2, np.linspace(0.0, 2.0, 41)
    result = trace_singularity(robot, coordinates=path)
    assert len(result.warnings) == 2
    (first, near), (changed, sign) = result.warnings
    assert path[first, 5] < np.pi / 2 < path[changed, 5] < path[changed - 1, 5] + 0.06
    assert (near.code, near.data["first"]) == ("singularity.path-near", first)
    assert (sign.code, sign.data["row"]) == ("singularity.path-crosses", changed)
    assert str(near)
    assert str(sign)
    assert not trace_singularity(robot, coordinates=path[:20]).warnings


def test_unreachable_step_of_a_path_is_reported():
    robot = zoo.delta()
    path = np.zeros((12, 3))
    path[:, 2], path[:, 0] = 0.1, np.linspace(0.0, 0.6, 12)
    result = trace_singularity(robot, coordinates=path, medians=compute_median_margins(robot))
    lost = int(np.flatnonzero(np.isnan(result.margin))[0])
    warnings = [(step, finding.code) for step, finding in result.warnings]
    assert (lost, "singularity.path-not-reached") in warnings


def test_margins_of_a_path_agree_for_readings_and_coordinates():
    robot = zoo.planar_rrr()
    path = np.linspace(0.0, 1.0, 10)[:, None] * np.array([0.02, 0.01, 0.1])
    solution = trace_singularity(robot, coordinates=path, medians=(1.0, 1.0))
    again = trace_singularity(robot, readings=solution.solution.q, medians=(1.0, 1.0))
    assert_allclose(again.margin, solution.margin, atol=1e-11)  # [m/m] rounding through Newton
    assert (again.closure_sign == solution.closure_sign).all()


def test_outstretched_crank_is_reported_as_a_weak_actuator():
    # crank of 0.2 m and rod of 0.3 m in one line: the drive's row of closure vanishes
    robot = load_robot("five-bar")
    reach = 0.4999 * np.array([np.cos(1.0), np.sin(1.0)]) + [-0.075, 0.0]
    result = analyze_singularity(robot, inverse(robot, reach[None]))
    assert result.drive_margin[0] < 0.05 * result.drive_median
    assert result.explain(0).code == "singularity.weak-actuator"
    assert result.explain(0).data["actuator"] == "left"


def test_median_margin_without_a_workspace_is_that_of_home():
    robot = zoo.planar_rrr()
    assert compute_median_margins(robot)[0] == pytest.approx(
        analyze_singularity(robot, robot.home[None], (1.0, 1.0)).margin[0], abs=1e-12
    )


def test_redundant_actuators_have_a_margin_but_no_closure_sign():
    result = analyze_singularity(load_robot("cable-4"), load_robot("cable-4").home[None])
    assert result.margin[0] > 0.5
    assert result.closure_sign[0] == 0


@pytest.mark.parametrize(
    "given", [{}, {"readings": np.zeros((2, 6)), "coordinates": np.zeros((2, 6))}]
)
def test_path_with_both_or_neither_of_readings_and_coordinates_is_refused(given):
    with pytest.raises(DataError, match="exactly one of readings and coordinates"):
        trace_singularity(zoo.hexapod(), **given)


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
        MechanismError, match=r"almost nothing .*: 0 of .* reason: the loops do not close"
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
    with pytest.raises(MechanismError, match=r"of 2000 .*at least 1% needed"):
        sample_workspace(robot, 200)


def test_missing_range_of_a_workspace_is_named():
    with pytest.raises(MechanismError, match="has no workspace for y"):
        sample_workspace(build_delta_with_workspace({"x": (-0.1, 0.1), "z": (0.0, 0.1)}), 10)


def build_delta_with_workspace(ranges, stroke=None):
    assembly = replace(zoo.delta().assembly, workspace=ranges)
    if stroke:
        assembly = replace(
            assembly, actuators=tuple(replace(a, stroke=stroke) for a in assembly.actuators)
        )
    return build(assembly)
