# SPDX-License-Identifier: Apache-2.0
"""Pose groups on a plane and a perpendicular line: geometry, derivatives, rank and refusals."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import loopcal as lc
from loopcal.errors import EstimationError
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward, inverse
from loopcal.planning.design_space import Criterion, PriorInformation
from loopcal.planning.exchange import coordinate_exchange
from loopcal.planning.plane_line_planning import PlaneLineGroups, linearize_surfaces
from tests.findings.expectations import expect_refusal

MM = 1e-3


@pytest.fixture(scope="module")
def robot() -> Mechanism:
    return lc.load_robot("hexapod-nategh-agheli")


def compute_tool_origins(planned: PlaneLineGroups, design: np.ndarray) -> np.ndarray:
    """Return tool origins (u, k, 3) of designs."""
    x = planned.place_points(design)
    T = inverse(planned.robot, x.reshape(-1, x.shape[2])).T @ planned.robot.tool
    return T[:, :3, 3].reshape(*x.shape[:2], 3)


def test_points_lie_on_a_plane_and_a_perpendicular_line_in_the_workspace(robot) -> None:
    planned = PlaneLineGroups(robot, 7, MM)
    design = planned.draw(12, 1)
    assert {int(axis) for axis in design[:, 3]} == {0, 1, 2}
    at = compute_tool_origins(planned, design)
    for x, axis in zip(at, design[:, 3].astype(int), strict=True):
        lever = x - x[0]
        along = np.eye(3)[axis]
        # [m], end of the inverse kinematics
        assert_allclose(lever[2:] @ along, 0.0, atol=1e-9)
        assert_allclose(np.cross(lever[1], along), 0.0, atol=1e-9)
    low, high = np.array([robot.assembly.workspace[name] for name in "xyz"]).T
    assert (at > low - 1e-9).all()
    assert (at < high + 1e-9).all()


def test_tool_point_lies_on_plane_and_line(robot) -> None:
    tool = np.eye(4)
    tool[:3, 3] = 0.02, -0.03, 0.05
    assembly = replace(robot.assembly, tool=tool)
    planned = PlaneLineGroups(replace(robot, assembly=assembly), 5, MM, ("z",))
    lever = compute_tool_origins(planned, planned.draw(3, 0))
    lever = lever - lever[:, :1]
    assert_allclose(lever[:, 2:, 2], 0.0, atol=1e-9)  # [m]
    assert_allclose(lever[:, 1, :2], 0.0, atol=1e-9)


def test_derivatives_of_points_agree_with_the_forward_kinematics(robot) -> None:
    planned = PlaneLineGroups(robot, 5, MM, ("x",))
    design = planned.draw(1, 3)
    q = inverse(robot, planned.place_points(design)[0])
    _, J, _ = planned.linearize_points(planned.place_points(design)[0])
    for place in (0, 4, 20, 41):
        step = np.zeros(42)
        step[place] = 1e-6
        ends = [
            forward(robot.with_values(robot.values + s * step), q.q, q).T[:, :3, 3]
            for s in (1.0, -1.0)
        ]
        by_hand = (ends[0] - ends[1]) / 2e-6 * planned.free.tolerance[place]
        # [m per spread], central differences of 1e-3
        assert_allclose(J[:, :, place], by_hand, atol=1e-11)


def test_derivatives_by_surfaces_agree_with_small_rotations(robot) -> None:
    planned, axis = PlaneLineGroups(robot, 6, MM), np.arange(3)
    design = planned.draw(3, 5)
    design[:, 3] = axis
    at = compute_tool_origins(planned, design)
    F, _ = linearize_surfaces(
        at, np.repeat(np.eye(3)[None, None], 3, axis=0).repeat(6, axis=1), axis
    )
    assert (np.linalg.matrix_rank(F) == 5).all()
    turn = 1e-6
    for g in range(3):
        n, t_1, t_2 = (np.eye(3)[(g + j) % 3] for j in range(3))
        lever = at[g] - at[g, 0]
        turned = n + turn * t_1, t_1 - turn * n, t_2
        moved = [
            (lever @ new - lever @ old) / turn
            for new, old in zip(turned, (n, t_1, t_2), strict=True)
        ]
        # [m per rad]
        assert_allclose(F[g, :4, 0], [*moved[1][:2], *moved[2][:2]], atol=1e-9)
        assert_allclose(F[g, 4:, 0], moved[0][[0, 2, 3, 4, 5]], atol=1e-9)


def test_rank_is_33_of_42_for_1_to_30_groups(robot) -> None:
    for groups, k in ((1, 40), (3, 15), (10, 8), (30, 8)):
        planned = PlaneLineGroups(robot, k, MM)
        rows = planned.linearize(planned.draw(groups, 0))
        assert rows.shape == (groups, k - 2, 42)
        s = np.linalg.svd(rows.reshape(-1, 42), compute_uv=False)
        assert s[32] > 1e-6 * s[0]
        assert s[33] < 1e-13 * s[0]  # rounding


def test_short_line_and_unreachable_poses_are_not_allowed(robot) -> None:
    planned = PlaneLineGroups(robot, 5, MM, ("z",))
    design = planned.draw(2, 0)
    along = 4 + len(planned.orientation_names)  # the end of the line
    design[1, along] = design[1, 2] + 0.9 * planned.shortest
    assert [np.isnan(r).all() for r in planned.linearize(design)] == [False, True]
    design[0, 2] = 30.0  # 3 m above the workspace
    assert np.isnan(planned.linearize(design)).all()


def test_groups_in_reach_are_drawn_in_one_call_with_long_enough_lines(monkeypatch) -> None:
    planned = PlaneLineGroups(lc.load_robot("linear-delta"), 8, MM)
    rows, calls = PlaneLineGroups.linearize, []
    monkeypatch.setattr(
        PlaneLineGroups,
        "linearize",
        lambda self, design: calls.append(len(design)) or rows(self, design),
    )
    design = planned.draw(200, 1)
    assert calls == [200]  # of lines drawn without their least length, a fifth is too short
    length = np.abs(design[:, 4] - design[np.arange(200), design[:, 3].astype(int)])
    assert length.min() >= planned.shortest
    assert np.abs(np.delete(design, 3, axis=1)).max() <= 1.0


def test_invalid_group_settings_are_refused(robot) -> None:
    for settings, words in (
        ({"points": 3}, "at least 4"),
        ({"sigma": 0.0}, "above 0"),
        ({"axes": ("w",)}, "one or more of x, y, z"),
        ({"robot": lc.load_robot("3-prs")}, "does not control x and y"),
    ):
        given: dict[str, Any] = {"robot": robot, "points": 5, "sigma": MM} | settings
        with pytest.raises(EstimationError, match=words):
            PlaneLineGroups(**given)
    with expect_refusal("plan.surfaces-out-of-reach", points=5):
        PlaneLineGroups(robot, 5, MM, shortest=3.0).draw(1)


@pytest.mark.slow
def test_one_sweep_of_coordinate_exchange_reduces_the_sd_threefold(robot) -> None:
    planned = PlaneLineGroups(robot, 10, MM, ("z",))
    first = planned.draw(10, 3)
    found = coordinate_exchange(
        lambda _, design: planned.linearize(design),
        first,
        planned.list_levels(),
        Criterion("D"),
        PriorInformation.none(42),
        sweeps=1,
    )

    def sd(rows: np.ndarray) -> float:
        s = np.linalg.svd(rows.reshape(-1, 42), compute_uv=False)[:33]
        return float(np.sqrt(np.mean(s**-2.0)))

    assert sd(planned.linearize(first)) > 3.0 * sd(found.rows)
    assert_array_equal(planned.linearize(found.design), found.rows)
