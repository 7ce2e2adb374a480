# SPDX-License-Identifier: Apache-2.0
"""Candidates satisfy all constraints, and excluded ones are counted by reason; straight paths
between them are checked, and a short order visits them.
"""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from loopcal.errors import DataError, MechanismError
from loopcal.io.robot.robot_file import find_robot_file, load_robot
from loopcal.mechanism.singularities import analyze_singularity, trace_singularity
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import check_limits, workspace_ranges
from loopcal.planning import path
from loopcal.planning.candidates import check_listed_poses, draw_candidates
from loopcal.planning.constraints import Constraints, LineOfSight, build_checker
from loopcal.planning.path import (
    check_paths,
    find_short_order,
    interpolate_path,
    locate_home,
    measure_distance,
    order_poses,
)
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
        (lambda: LineOfSight(np.array([np.nan, 0, 0]), np.ones(3)), "station of .*: row 1 is nan"),
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
    with pytest.raises(DataError, match=r"stroke_margin is .*, but must be finite, 0 m or more"):
        Constraints(stroke_margin=margin)


@pytest.fixture(scope="module")
def hexapod(tmp_path_factory):
    """Candidates of a hexapod with short strokes, so that some straight paths leave the strokes."""
    path = tmp_path_factory.mktemp("robot") / "short.yaml"
    path.write_text(
        find_robot_file("hexapod-42")
        .read_text("utf-8")
        .replace("stroke: [-75, 75]", "stroke: [-20, 75]")
    )
    return draw_candidates(load_robot(path), Constraints(min_margin=0.3), 120, seed=1)


def _check_path_finely(found, start, end, steps):
    """Return limits, margin and closure sign of a path at more places than `check_paths` checks."""
    robot = found.checker.robot
    share = np.linspace(0.0, 1.0, steps)
    x = interpolate_path(
        robot, np.repeat(start[None], steps, 0), np.repeat(end[None], steps, 0), share
    )
    path = trace_singularity(robot, coordinates=x, medians=found.checker.medians)
    inside = check_limits(robot, robot.values[None], path.solution.q[None], path.solution.state)[0][
        0
    ]
    margin = np.fmin(path.ratio, path.drive_ratio)
    return inside, margin, path.closure_sign


def test_allowed_paths_satisfy_the_constraints_at_finer_steps(hexapod):
    rng = np.random.default_rng(2)
    edge = hexapod.coordinates[~hexapod.is_uniform]
    pairs = rng.integers(0, len(edge), (60, 2))
    verdict = check_paths(hexapod.checker, edge[pairs[:, 0]], edge[pairs[:, 1]])
    assert verdict.allowed.sum() > 30
    for a, b in pairs[verdict.allowed][:2]:
        inside, margin, sign = _check_path_finely(hexapod, edge[a], edge[b], 150)
        assert inside.all()
        assert margin.min() > 0.3 - 1e-3
        assert (sign == hexapod.checker.robot.home_state.closure_sign).all()


def test_path_that_leaves_the_strokes_is_refused_with_the_reason(hexapod):
    rng = np.random.default_rng(2)
    edge = hexapod.coordinates[~hexapod.is_uniform]
    pairs = rng.integers(0, len(edge), (60, 2))
    verdict = check_paths(hexapod.checker, edge[pairs[:, 0]], edge[pairs[:, 1]])
    refused = np.flatnonzero(~verdict.allowed)
    assert len(refused)
    assert all("stroke" in dict(verdict.violations[i].data)["limit"] for i in refused)
    a, b = pairs[refused[0]]
    inside, *_ = _check_path_finely(hexapod, edge[a], edge[b], 100)
    assert inside[[0, -1]].all()
    assert not inside.all()


@pytest.mark.parametrize("name", ["hexapod-42", "excavator", "pulley-3", "3-rrr", "six-bar"])
def test_allowed_paths_are_those_that_a_machine_follows_step_by_step(name):
    robot = load_robot(name)
    ranges = np.array([workspace_ranges(robot)[name] for name in robot.controlled])
    middle, half = ranges.mean(axis=1), np.diff(ranges)[:, 0]
    ends = middle + 1.5 * half * np.random.default_rng(4).uniform(-1.0, 1.0, (2, 40, len(middle)))
    # without strokes, so that paths end near singularities and in other modes
    free = tuple(replace(actuator, stroke=None) for actuator in robot.actuators)
    robot = replace(robot, assembly=replace(robot.assembly, actuators=free))
    checker = build_checker(robot, Constraints(min_margin=0.4))
    allowed = check_paths(checker, *ends).allowed
    begin, end = (np.array(places)[allowed] for places in ends)
    present = inverse(robot, begin)
    for share in np.linspace(0.0, 1.0, 60):
        present = inverse(robot, interpolate_path(robot, begin, end, share), present)
        assert checker.check_poses(present, at_pose=False).allowed.all()
    np.testing.assert_allclose(present.q, inverse(robot, end).q, atol=1e-6)
    assert 0 < allowed.sum() < len(allowed)


def test_path_through_a_singularity_is_refused():
    robot = load_robot("five-bar")
    checker = build_checker(robot, Constraints(min_margin=0.0))
    home = locate_home(robot)
    # mirrored at the line through both feet: the other side of the singularity where the links are
    # in line
    across = home * np.array([1.0, -1.0])
    verdict = check_paths(checker, home[None], across[None])
    assert not verdict.allowed[0]
    assert verdict.violations[0] is not None


def test_path_of_a_machine_with_a_spare_drive_ends_at_any_readings_of_its_pose():
    robot = load_robot("hexapod-turntable")
    home = locate_home(robot)
    turned = home + np.array([0.02, 0.0, 0.0, 0.0, 0.1, 1.0])
    assert check_paths(build_checker(robot, Constraints()), home[None], turned[None]).allowed[0]


def test_tilt_path_takes_the_shorter_azimuth_or_passes_zero_tilt():
    robot = load_robot("3-prs")
    names = robot.controlled
    start, end = np.zeros((2, 1, len(names)))
    z, phi, theta = (names.index(name) for name in ("z", "phi", "theta"))
    start[0, [z, phi, theta]] = 0.5, np.radians(170.0), 0.2
    end[0, [z, phi, theta]] = 0.6, np.radians(-170.0), 0.2
    middle = interpolate_path(robot, start, end, 0.5)[0]
    assert abs(abs(middle[phi]) - np.pi) < 1e-12
    assert_allclose(middle[theta], 0.2 * np.cos(np.radians(10.0)), rtol=1e-12)
    end[0, phi] = np.radians(-10.0)
    assert interpolate_path(robot, start, end, 0.5)[0, theta] < 1e-15
    assert_allclose(
        measure_distance(robot, start, end), np.hypot(0.1, 0.4 * robot.size), rtol=1e-12
    )


def test_a_robot_of_one_meter_wraps_angles_like_others():
    robot = load_robot("hexapod-42")
    start, end = np.zeros((2, len(robot.controlled)))
    start[-1], end[-1] = 3.1, -3.1
    lengths = [measure_distance(replace(robot, size=size), start, end) for size in (1.0, 2.0)]
    assert_allclose(lengths, (2.0 * np.pi - 6.2) * np.array([1.0, 2.0]))


def test_order_of_few_poses_is_within_5_percent_of_the_shortest():
    rng = np.random.default_rng(0)
    exact = 0
    for _ in range(10):
        points = rng.random((8, 2))
        cost = np.linalg.norm(points[1:, None] - points[None, 1:], axis=2)
        begin = np.linalg.norm(points[1:] - points[0], axis=1)
        order, length, is_converged = find_short_order(cost, begin)
        assert is_converged
        orders = np.array(list(permutations(range(7))))
        lengths = begin[orders[:, 0]] + cost[orders[:, :-1], orders[:, 1:]].sum(axis=1)
        assert sorted(order) == list(range(7))
        assert_allclose(length, begin[order[0]] + cost[order[:-1], order[1:]].sum(), rtol=1e-12)
        assert length <= 1.05 * lengths.min()  # 2-opt from seven beginnings: within a few per cent
        exact += length <= lengths.min() * (1 + 1e-12)
    assert exact >= 7


def test_order_that_runs_out_of_steps_is_marked_and_passes_home(hexapod, monkeypatch):
    poses = hexapod.coordinates[:12]
    whole = order_poses(hexapod.checker, poses)
    assert whole.is_converged
    monkeypatch.setattr(path, "REVERSALS", 0)
    assert not order_poses(hexapod.checker, poses).is_converged
    monkeypatch.undo()
    monkeypatch.setattr(path, "ORDERS", 0)
    unchecked = order_poses(hexapod.checker, poses)  # no path between two poses was checked
    assert not unchecked.is_converged
    assert unchecked.via_home[1:].all()
    assert unchecked.length > whole.length


def test_ordered_poses_have_allowed_paths_or_pass_the_home_pose(hexapod):
    rng = np.random.default_rng(2)
    edge = hexapod.coordinates[~hexapod.is_uniform]
    pairs = rng.integers(0, len(edge), (60, 2))
    verdict = check_paths(hexapod.checker, edge[pairs[:, 0]], edge[pairs[:, 1]])
    a, b = pairs[~verdict.allowed][0]
    only = order_poses(hexapod.checker, edge[[a, b]])
    assert only.via_home.tolist() == [False, True]
    poses = edge[rng.choice(len(edge), 12, replace=False)]
    visit = order_poses(hexapod.checker, poses)
    ordered = poses[visit.order]
    direct = np.flatnonzero(~visit.via_home[1:]) + 1
    assert check_paths(hexapod.checker, ordered[direct - 1], ordered[direct]).allowed.all()
    plain = measure_distance(hexapod.checker.robot, poses[:-1], poses[1:]).sum()
    assert visit.length < 0.9 * plain


def test_path_ends_with_the_readings_of_its_last_pose(hexapod):
    robot = hexapod.checker.robot
    x = hexapod.coordinates[:5]
    home = np.broadcast_to(locate_home(robot), x.shape)
    assert check_paths(hexapod.checker, home, x).allowed.all()
    last = trace_singularity(
        robot,
        coordinates=interpolate_path(
            robot, home[:1].repeat(20, 0), x[:1].repeat(20, 0), np.linspace(0, 1, 20)
        ),
    )
    assert_allclose(last.solution.q[-1], inverse(robot, x[:1]).q[0], atol=1e-9)  # [m]
