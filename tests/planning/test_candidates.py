# SPDX-License-Identifier: Apache-2.0
"""Candidates satisfy all constraints; excluded ones are counted by reason."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import DataError, MechanismError
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.mechanism.singularities import analyze_singularity
from loopcal.mechanism.workspace import check_limits, workspace_ranges
from loopcal.planning.candidates import check_listed_poses, draw_candidates
from loopcal.planning.constraints import Constraints, LineOfSight
from tests.findings.expectations import expect_refusal

STATION = np.array([0.5, -0.3, 0.6])


@pytest.fixture(scope="module")
def constrained():
    """Candidates of a hexapod that satisfy all constraints together."""
    sight = LineOfSight(STATION, np.array([0.0, 0.0, 2.0]), np.radians(60.0), 0.1, 2.0)
    return draw_candidates(
        load_robot("hexapod-42"), Constraints(0.6, np.radians(12.0), sight), 100, seed=3
    )


def test_every_candidate_satisfies_every_constraint(constrained):
    robot, T = constrained.checker.robot, constrained.solution.T
    assert constrained.solution.converged.all()
    assert check_limits(
        robot, robot.values[None], constrained.solution.q[None], constrained.solution.state
    )[0].all()
    near = analyze_singularity(robot, constrained.coordinates)
    assert (near.ratio >= 0.6).all()
    assert (near.drive_ratio >= 0.6).all()
    tilt = np.arccos(T[:, 2, 2])
    assert tilt.max() <= np.radians(12.0) + 1e-9  # [rad], rounding of arccos near the bound
    to_station = STATION - T[:, :3, 3]
    cosine = np.einsum("ni,ni->n", T[:, :3, 2], to_station) / np.linalg.norm(to_station, axis=1)
    assert cosine.min() >= np.cos(np.radians(60.0)) - 1e-9
    assert np.linalg.norm(to_station, axis=1).min() >= 0.1


def test_excluded_candidates_are_counted_by_reason(constrained):
    assert {"tilt-exceeded", "target-faces-away"} <= {v.code for v in constrained.excluded}
    assert any(
        dict(v.data).get("max_tilt_deg") == pytest.approx(12.0) for v in constrained.excluded
    )
    assert sum(constrained.excluded.values()) == constrained.n_drawn - len(constrained)
    found = constrained.report()
    assert found.code == "plan.candidates"
    assert (found.data["allowed"], found.data["total"]) == (len(constrained), constrained.n_drawn)
    assert sum(reason["count"] for reason in found.data["reasons"]) == constrained.n_drawn - len(
        constrained
    )


@pytest.mark.parametrize("name", ["hexapod-42", "linear-delta"])
def test_many_candidates_lie_at_the_boundary_of_the_workspace(name):
    found = draw_candidates(load_robot(name), None, 60, seed=1)
    low, high = np.array(list(workspace_ranges(found.checker.robot).values())).T
    # within a micrometer or a microradian
    at_end = np.isclose(found.coordinates, low, atol=1e-6) | np.isclose(
        found.coordinates, high, atol=1e-6
    )
    edge = ~found.is_uniform
    # of thirty that are drawn; corners drawn twice count once
    assert 15 <= edge.sum() <= 30
    # not all: what cannot be reached there was drawn back
    assert at_end[edge].any(axis=1).mean() > 0.6
    assert ((found.coordinates >= low - 1e-9) & (found.coordinates <= high + 1e-9)).all()


def test_coordinates_of_candidates_are_rounded(constrained):
    millimetres = constrained.coordinates[:, :3] * 1e3
    assert_allclose(millimetres, np.round(millimetres, 3), atol=1e-9)
    degrees = np.degrees(constrained.coordinates[:, 3:])
    assert_allclose(degrees, np.round(degrees, 4), atol=1e-9)


def test_workspace_without_an_allowed_pose_is_refused_with_the_counts():
    nobody_sees = Constraints(
        sight=LineOfSight(np.array([0.0, 0.0, -5.0]), np.array([0.0, 0.0, 1.0]), np.radians(20.0))
    )
    with expect_refusal("plan.workspace-excluded", MechanismError, allowed=0) as data:
        draw_candidates(load_robot("hexapod-42"), nobody_sees, 200)
    assert "target-faces-away" in {reason["code"] for reason in data["reasons"]}


def test_home_pose_that_violates_a_constraint_is_refused(tmp_path):
    text = (
        find_robot_file("hexapod-42")
        .read_text("utf-8")
        .replace("home: {z: 200}", "home: {z: 200, roll: 10}")
    )
    (tmp_path / "leaning.yaml").write_text(text)
    with expect_refusal("plan.home-excluded", MechanismError) as data:
        draw_candidates(
            load_robot(tmp_path / "leaning.yaml"), Constraints(max_tilt=np.radians(5.0)), 50
        )
    (reason,) = data["reasons"]
    assert reason["code"] == "tilt-exceeded"
    assert reason["max_tilt_deg"] == pytest.approx(5.0)


def test_listed_poses_outside_the_limits_are_excluded_with_the_reason():
    robot = load_robot("hexapod-42")
    poses = np.array([[0.0, 0.0, 0.2, 0.0, 0.0, 0.0], [0.0, 0.0, 0.9, 0.0, 0.0, 0.0]])
    found = check_listed_poses(robot, poses)
    assert len(found) == 1
    assert any("stroke" in dict(v.data).get("limit", "") for v in found.excluded)
    with expect_refusal("plan.listed-poses-excluded", MechanismError, total=1):
        check_listed_poses(robot, poses[1:])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Constraints(min_margin=1.5), "share of the median"),
        (lambda: Constraints(max_tilt=-1.0), "angle above 0"),
        (lambda: LineOfSight(np.zeros(3), np.zeros(3)), "length above 0"),
        (lambda: LineOfSight(np.array([np.nan, 0, 0]), np.ones(3)), "three finite numbers"),
        (lambda: LineOfSight(np.zeros(3), np.ones(3), cone=0.0), "at most 180 deg"),
        (
            lambda: LineOfSight(np.zeros(3), np.ones(3), nearest=2.0, farthest=1.0),
            "a smaller and a larger",
        ),
    ],
)
def test_invalid_constraints_are_refused(make, said):
    with pytest.raises(DataError, match=said):
        make()


def test_stroke_margin_holds_at_poses_and_on_paths() -> None:
    robot = load_robot("five-bar")
    margin = np.radians(60.0)
    free = draw_candidates(robot, Constraints(), 60)
    kept = draw_candidates(robot, Constraints(stroke_margin_angle=margin), 60)
    low, high = np.array([a.stroke for a in robot.actuators]).T

    def measure(candidates) -> float:
        q = candidates.solution.q
        return float(np.minimum(q - low, high - q).min())

    assert measure(free) < margin <= measure(kept) + 1e-12  # [rad], rounding


@pytest.mark.parametrize(
    ("margin", "words"),
    [
        ({"stroke_margin": 0.01}, "no actuator of five-bar of dimension length has a stroke"),
        ({"stroke_margin_angle": 1.6}, "twice the margin of 91.7 deg .* stroke of left, 180 deg"),
    ],
)
def test_impossible_stroke_margin_is_refused(margin, words) -> None:
    with pytest.raises(DataError, match=words):
        draw_candidates(load_robot("five-bar"), Constraints(**margin), 10)


@pytest.mark.parametrize("margin", [-1.0, np.inf, np.nan])
def test_stroke_margin_is_a_finite_number(margin) -> None:
    with pytest.raises(DataError, match="margin from the ends of strokes"):
        Constraints(stroke_margin=margin)
