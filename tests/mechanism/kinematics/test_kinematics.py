# SPDX-License-Identifier: Apache-2.0
"""Inverse and forward kinematics over whole workspaces: closure, round trips, marked failures
instead of exceptions; of an unreachable pose the nearest reachable one, rows and paths that say
so.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from loopcal import engine, geometry
from loopcal.errors import DataError
from loopcal.findings.catalog import load_catalog
from loopcal.io.robot.robot_file import list_shipped_robots, load_robot
from loopcal.mechanism import inverse as inverse_kinematics
from loopcal.mechanism import kinematics as reading_paths
from loopcal.mechanism.assembly import Address, LinearMap
from loopcal.mechanism.compilation import build
from loopcal.mechanism.kinematics import compute_readings, forward_trials
from loopcal.mechanism.platform_coordinates import POSITION, read_coordinates
from loopcal.mechanism.solutions import (
    controls_all,
    differentiate_by_coordinates,
    forward,
    inverse,
    jacobian,
)
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from loopcal.parameters import Parameter
from tests import zoo
from tests.engine.cases import actuated_joint_values, stack_dense_rows
from tests.zoo import load_cached_robot

ROBOT_NAMES = ["mixed_hexapod", "three_prs", "hexapod", "delta", "five_bar", "planar_rrr"]

WORKSPACES = {
    "hexapod": ([-0.04, -0.04, 0.17, -0.24, -0.24, -0.24], [0.04, 0.04, 0.23, 0.24, 0.24, 0.24]),
    "mixed_hexapod": (
        [0.007, -0.023, 0.247, 0.03, -0.10, 0.08],
        [0.013, -0.017, 0.253, 0.07, -0.06, 0.12],
    ),
    "delta": ([-0.08, -0.08, 0.0], [0.08, 0.08, 0.2]),
    "three_prs": ([0.65, -np.pi, 0.0], [0.75, np.pi, 0.6]),
    "five_bar": ([-0.05, 0.2], [0.05, 0.28]),
    "planar_rrr": ([-0.03, -0.03, -0.2], [0.03, 0.03, 0.2]),
}


def sample_inverse(name, n, seed=7):
    """Return a robot, n inverse solutions across its workspace, and which are within strokes."""
    robot, (low, high) = getattr(zoo, name)(), WORKSPACES[name]
    sol = inverse(robot, np.random.default_rng(seed).uniform(low, high, (n, len(low))))
    strokes = np.array([a.stroke or (-np.inf, np.inf) for a in robot.actuators]).T
    inside = ((sol.q >= strokes[0]) & (sol.q <= strokes[1])).all(axis=1)
    return robot, sol, inside


def relative_pose_distance(robot, T, reference):
    """Distance of poses (n,): position in sizes of the robot, rotation in radians."""
    return np.linalg.norm(
        geometry.pose_difference(T, reference) / np.array([1.0] * 3 + [robot.size] * 3), axis=1
    )


def closure_condition(robot, state):
    """Return the condition (n,) of the closure Jacobian, lengths in sizes of the robot."""
    e, _ = robot.slots(robot.values[None])
    blocks = engine.linearize(robot.program, e, actuated_joint_values(robot.program, state), state)
    A = stack_dense_rows(robot.program, blocks.closure)[0][0]
    return np.linalg.cond(
        A / np.array([robot.size if f < 3 else 1.0 for f in robot.program.freedoms])
    )


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_forward_after_inverse_is_exact_to_rounding_times_the_condition(name):
    robot, sol, _ = sample_inverse(name, 500)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert sol.residual.max() <= 1e-13 * robot.size
    back = forward(robot, sol.q)
    assert_array_equal(back.status, Status.CONVERGED)
    assert back.residual.max() <= 1e-13 * robot.size
    assert (
        relative_pose_distance(robot, back.T, sol.T) <= 1e-14 * closure_condition(robot, sol.state)
    ).all()


@pytest.mark.parametrize("name", ["hexapod", "delta"])
def test_random_readings_within_the_strokes_close_or_are_marked(name):
    robot = getattr(zoo, name)()
    stroke = np.array([a.stroke for a in robot.actuators]).T
    sol = forward(
        robot, np.random.default_rng(11).uniform(stroke[0], stroke[1], (1000, len(robot.actuators)))
    )
    closed = np.isin(sol.status, (Status.CONVERGED, Status.OTHER_MODE))
    assert (sol.residual[closed] <= 1e-13 * robot.size).all()
    assert (sol.residual[sol.status == Status.UNREACHABLE] > 1e-9 * robot.size).all()


def test_unreachable_and_nan_rows_are_marked_and_do_not_change_other_rows():
    robot = zoo.hexapod()
    q = np.zeros((5, 6))
    q[1, 0], q[2, 3], q[3, 0], q[4] = 2.0, np.nan, np.inf, 0.01
    sol = forward(robot, q)
    assert sol.status[1] in (Status.UNREACHABLE, Status.NOT_CONVERGED)
    assert_array_equal(
        sol.status[[0, 2, 3, 4]],
        [Status.CONVERGED, Status.NOT_FINITE, Status.NOT_FINITE, Status.CONVERGED],
    )
    assert sol.residual[1] > 0.01
    assert_array_equal(sol.T[4], forward(robot, q[4]).T[0])
    assert sol.explain(0).code == "kinematics.closed"
    assert sol.explain(1).data["gap"].value == pytest.approx(1e3 * sol.residual[1])
    assert_array_equal(inverse(zoo.delta(), [[5.0, 0.0, 0.1]]).converged, [False])
    assert_array_equal(inverse(robot, np.full((1, 4, 4), np.nan)).status, Status.NOT_FINITE)


def test_every_kinematics_status_is_in_the_catalog_of_findings():
    assert all(status.code in load_catalog() for status in Status)


def test_wrong_shapes_of_readings_and_targets_are_refused():
    with pytest.raises(
        DataError, match=r"5 readings a row do not fit: hexapod has 6 actuators \(q1, q2"
    ):
        forward(zoo.hexapod(), np.zeros((2, 5)))
    with pytest.raises(
        DataError, match=r"a target has the shape \(2, 5\). Allowed: \(n, 4, 4\) poses or \(n, 3\)"
    ):
        inverse(zoo.delta(), np.zeros((2, 5)))


def test_a_start_that_is_no_solution_is_refused():
    robot = load_cached_robot("five-bar")
    for solve in (forward, inverse):
        with pytest.raises(DataError, match="start is of type ndarray"):
            solve(robot, np.zeros((1, 2)), start=robot.home)  # type: ignore[arg-type]


def test_start_selects_the_assembly_mode():
    robot = zoo.delta()
    sol = forward(robot, np.full((1, 3), 0.2))
    upper = np.array(sol.T)
    upper[0, 2, 3] += 0.6
    mirrored = forward(robot, np.full((1, 3), 0.2), start=move_solution(robot, sol, upper))
    assert mirrored.T[0, 2, 3] > sol.T[0, 2, 3] + 0.3
    assert mirrored.status[0] == Status.CONVERGED


def move_solution(robot, sol, T):
    """Move the platform of a solution and reverse its closure sign."""
    state = replace(sol.state, T=T[None], closure_sign=-sol.state.closure_sign)
    return replace(sol, T=T, state=state)


@pytest.mark.parametrize("name", ["hexapod", "mixed_hexapod", "delta"])
def test_trials_in_one_call_equal_single_calls_bit_for_bit(name):
    robot, sol, _ = sample_inverse(name, 20)
    values = robot.values + np.random.default_rng(1).normal(size=(7, len(robot.parameters))) * 1e-4
    together = forward_trials(robot, values, sol.q[None])
    for i in range(7):
        alone = forward_trials(robot, values[i : i + 1], sol.q[None])
        assert_array_equal(together.T[i], alone.T[0])
        assert_array_equal(together.status[i], alone.status[0])
        one = forward(robot.with_values(values[i]), sol.q)
        assert_array_equal(together.T[i], one.T)


@settings(max_examples=20)
@given(st.floats(0.01, 100.0))
def test_poses_scale_with_the_unit_of_length(s):
    small = build(zoo.scale_lengths(zoo.mixed_hexapod_assembly(), s))
    assert_allclose(small.size, s * zoo.mixed_hexapod().size, rtol=1e-12)
    lengths = np.array([s if a.dimension.value == "length" else 1.0 for a in small.actuators])
    q = inverse(zoo.mixed_hexapod(), zoo.mixed_hexapod().home[None]).q + 0.002
    one, other = forward(zoo.mixed_hexapod(), q), forward(small, q * lengths)
    assert one.status[0] == other.status[0] == Status.CONVERGED
    assert_allclose(other.T[0, :3, :3], one.T[0, :3, :3], atol=1e-12)
    assert_allclose(other.T[0, :3, 3] / s, one.T[0, :3, 3], atol=1e-12)


@settings(max_examples=20)
@given(st.lists(st.floats(-2.0, 2.0), min_size=6, max_size=6))
def test_readings_do_not_depend_on_the_pose_of_the_base(twist):
    G = geometry.apply_twist(np.eye(4), np.array(twist))
    original, moved = zoo.hexapod(), build(zoo.move_base(zoo.hexapod().assembly, G))
    _, sol, _ = sample_inverse("hexapod", 5)
    assert_allclose(inverse(moved, G @ sol.T).q, sol.q, atol=1e-14)
    assert_allclose(forward(moved, sol.q).T, G @ forward(original, sol.q).T, atol=1e-12)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.diag([2.0, 2.0, 2.0, 1.0]), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "not a rotation"),
        (2 * np.eye(4), "last row"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0.2, 1]]), "last row"),
    ],
)
def test_matrix_that_is_not_a_pose_is_refused(matrix, words):
    with pytest.raises(DataError, match=words):
        inverse(zoo.hexapod(), matrix[None])


def test_jacobian_has_labels_and_is_the_derivative_of_the_poses():
    robot = zoo.hexapod()
    q = np.array([[0.01, -0.02, 0.0, 0.015, 0.0, 0.01], [0.0, 0.01, 0.0, 0.0, -0.01, 0.0]])
    result = jacobian(robot, q)
    assert result.components == ("rx", "ry", "rz", "x", "y", "z")
    step = 1e-6
    for name in ("q2", "leg3.length", "leg5.base.y"):
        if name in result.reading_names:
            moved = forward(robot, q + step * (np.array(result.reading_names) == name))
        else:
            change = step * (np.array(result.parameter_names) == name)
            moved = forward(robot.with_values(robot.values + change), q)
        slope = geometry.pose_difference(moved.T, result.solution.T) / step
        assert_allclose(result.of(name), slope, atol=1e-5)  # [rad/m, m/m] of a forward difference
    with pytest.raises(DataError, match="no column 'leg9'"):
        result.of("leg9")


def test_jacobian_contains_backlash_where_directions_of_approach_are_given():
    assembly = zoo.mixed_hexapod_assembly()
    actuator = assembly.actuators[0]
    backlash = Parameter(f"{actuator.name}.backlash", actuator.dimension, 0.0)
    address = Address(actuator.name, "transmission", "backlash")
    robot = build(
        replace(
            assembly,
            parameters=(*assembly.parameters, backlash),
            maps=(*assembly.maps, LinearMap(backlash.name, address)),
        )
    )
    rng = np.random.default_rng(6)
    robot = robot.with_values(robot.values + 1e-3 * rng.standard_normal(len(robot.values)))
    q = compute_readings(robot, robot.values[None], robot.home_state)[0]
    readings = np.hstack([q, np.ones_like(q)])
    result, step = jacobian(robot, readings), 1e-6
    for name in (backlash.name, "limb1.link0.x", "limb4.link0.x"):
        change = step * (np.array(robot.parameters.names) == name)
        ends = [forward(robot.with_values(robot.values + c), readings).T for c in (change, -change)]
        slope = geometry.pose_difference(*ends) / (2 * step)
        assert np.abs(slope).max() > 0.01  # [rad/m, m/m]
        assert_allclose(result.of(name), slope, atol=1e-6)  # of a central difference


def test_repr_of_robots_and_results_is_short():
    robot = zoo.hexapod()
    solution = forward(robot, np.zeros((3, 6)))
    for text in (repr(robot), repr(solution), repr(jacobian(robot, np.zeros((3, 6))))):
        assert len(text) < 600
    assert "42" in repr(robot)
    assert "3 of 3 rows" in repr(solution)


def squared_distance(robot, T, target):
    """|log(R R*')|^2 size^2 + |t - t*|^2 (n,) [m^2]."""
    gap = geometry.pose_difference(T, target) * np.array([robot.size] * 3 + [1.0] * 3)
    return (gap**2).sum(axis=1)


def make_unreachable_poses(n=20):
    """Draw poses up to 2 cm and 0.05 rad from the workspace of a 3-PRS, in all six directions."""
    rng = np.random.default_rng(5)
    values = rng.uniform([0.66, -np.pi, 0.1], [0.74, np.pi, 0.5], (n, 3))
    T = inverse(zoo.three_prs(), values).T
    return geometry.apply_twist(T, rng.uniform(-1, 1, (n, 6)) * np.array([0.05] * 3 + [0.02] * 3))


def test_nearest_pose_of_a_3_prs_minimizes_the_distance():
    robot, target = zoo.three_prs(), make_unreachable_poses()
    sol = inverse(robot, target)
    assert_array_equal(sol.status, Status.CONVERGED)
    result = read_coordinates(sol.T, robot.controlled)
    best, h = squared_distance(robot, sol.T, target), 1e-5
    for i in range(3):
        ahead, behind = (
            squared_distance(robot, inverse(robot, result + s * h * np.eye(3)[i]).T, target)
            for s in (1, -1)
        )
        # slope against curvature: how far along this coordinate the minimum still is
        assert (np.abs(ahead - behind) / (ahead + behind - 2 * best) * h / 2 < 1e-6).all()
        assert (np.minimum(ahead, behind) >= best).all()


@pytest.mark.parametrize(("name", "least"), [("jansen-leg", 30), ("klann-leg", 21)])
def test_poses_far_from_a_leg_are_projected(name: str, least: int) -> None:
    # plain Gauss-Newton steps, which shrink by a constant share, end before 24 and 18 of these rows
    robot, n = load_cached_robot(name), 40
    near = sample_workspace(robot, n).solution.T
    twist = np.random.default_rng(1).normal(size=(n, 6)) * np.repeat([1.0, 0.3 * robot.size], 3)
    target = geometry.apply_twist(near, twist)
    solution = inverse(robot, target)
    done = solution.take(solution.converged)
    assert len(done) >= least
    best = squared_distance(robot, done.T, target[solution.converged])
    for step in (-1e-4, 1e-4):  # of the crank [rad]
        moved = forward(robot, done.q + step, start=done)
        there = squared_distance(robot, moved.T, target[solution.converged])
        assert (there[moved.converged] > best[moved.converged]).all()


def test_reachable_pose_is_its_own_nearest_pose():
    robot, sol, _ = sample_inverse("three_prs", 20)
    back = inverse(robot, sol.T)
    assert_allclose(geometry.pose_difference(back.T, sol.T), 0.0, atol=1e-11)
    assert_allclose(back.q, sol.q, atol=1e-11)


def test_delta_ignores_the_orientation_of_a_target_pose():
    robot = zoo.delta()
    T = zoo.make_poses(np.array([[0.02, -0.03, 0.08, 0.3, 0.2, 0.1]]))
    sol = inverse(robot, T)
    assert_array_equal(sol.status, Status.CONVERGED)
    assert_allclose(sol.T[0, :3, 3], T[0, :3, 3], atol=1e-14)
    assert_allclose(sol.T[0, :3, :3], np.eye(3))


def test_hexapod_reaches_the_target_pose_exactly():
    _, sol, _ = sample_inverse("hexapod", 20)
    assert_allclose(
        geometry.pose_difference(inverse(zoo.hexapod(), sol.T).T, sol.T), 0.0, atol=1e-15
    )


def list_robots_with_few_freedoms():
    """Shipped robots whose controlled coordinates do not state each freedom of the platform."""
    return [name for name in list_shipped_robots() if not controls_all(load_cached_robot(name))]


def make_far_poses(robot, far, n):
    """Draw poses `far` sizes and `far` rad away from home, in random directions."""
    rng = np.random.default_rng(1)
    direction = rng.normal(size=(n, 2, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    twist = np.concatenate([direction[:, 0], robot.size * direction[:, 1]], axis=1) * far
    return geometry.apply_twist(np.broadcast_to(robot.home_state.T[0, 0], (n, 4, 4)), twist)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.evidence) if name in zoo.RELATIVES else name
        for name in list_robots_with_few_freedoms()
    ],
)
def test_projection_is_converged_only_where_the_distance_is_stationary(name):
    """The gradient by central differences of inverse solutions vanishes where a row is converged,
    for targets up to two sizes and 2 rad away from home.
    """
    robot, n = load_robot(name), 4
    target = np.concatenate([make_far_poses(robot, far, n // 2) for far in (0.05, 2.0)])
    sol = inverse(robot, target)
    done = sol.converged
    assert done[: n // 2].sum() >= 0.9 * (n // 2)  # the near ones are not merely given up
    assert not np.isin(sol.status, Status.NOT_FINITE).any()
    end, target = sol.take(done), target[done]
    at = read_coordinates(end.T, robot.controlled)
    distance, h = squared_distance(robot, end.T, target), 1e-5  # [rad] or a share of the size
    for i, coordinate in enumerate(robot.controlled):
        step = np.zeros(len(at[0]))
        step[i] = h * (robot.size if coordinate in POSITION else 1.0)
        ahead, behind = (inverse(robot, at + sign * step, end) for sign in (1, -1))
        both = ahead.converged & behind.converged
        slope = (
            squared_distance(robot, ahead.T, target) - squared_distance(robot, behind.T, target)
        ) / (2 * h)
        # the share 1e-6 of the distance that the search allows, at a lever of at most 3 sizes,
        # the error of differences, and what rounding of the distances leaves
        limit = 1e-5 * robot.size * np.sqrt(distance) + 1e-8 * (robot.size**2 + distance)
        assert (np.abs(slope) <= limit)[both].all()


def test_projection_that_ends_at_the_limit_of_the_reach_says_so():
    sol = inverse(load_robot("ru-pus-prs"), make_far_poses(load_robot("ru-pus-prs"), 2.0, 20))
    codes = {
        sol.explain(int(row)).code for row in np.flatnonzero(sol.status == Status.NOT_CONVERGED)
    }
    assert "kinematics.not-nearest" in codes


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    solve, calls = engine.solve, []

    def counted(*args, **options):
        calls.append(1)
        return solve(*args, **options)

    monkeypatch.setattr(engine, "solve", counted)
    return calls


def test_unreachable_readings_take_few_solutions_and_stay_marked(calls) -> None:
    far = 0.45 * np.array([[1.0, 1.0, 1.0, -1.0, -1.0, -1.0], [-1.0, 1.0, -1.0, 1.0, -1.0, 1.0]])
    robot = load_robot("hexapod-42")
    calls.clear()
    assert not forward(robot, far).converged.any()
    first, last = reading_paths.PATH_STEPS
    assert len(calls) < 1 + first + last  # the finer path ended before its last step


def test_redundant_readings_that_contradict_each_other_take_few_solutions(calls) -> None:
    robot = load_robot("cable-4")
    calls.clear()
    state = forward(robot, np.full((3, 4), 80.0))  # every line half a meter shorter than at home
    assert not state.converged.any()
    first, last = reading_paths.PATH_STEPS
    assert len(calls) < 1 + first + last / 2  # the finer path ended where the gap opened wide


Array = NDArray[np.float64]


def count_calls(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> list[int]:
    """Return a list that grows by one for each call of a function."""
    calls: list[int] = []
    function: Callable[..., object] = getattr(owner, name)

    def counted(*args: object, **options: object) -> object:
        calls.append(1)
        return function(*args, **options)

    monkeypatch.setattr(owner, name, counted)
    return calls


# Far away, at the foot of the excavator, and behind the base of the Tricept.
BEYOND = {
    "arm-6r": [8.0, 0.3, 0.5, 0.0, 0.0, 0.0],
    "excavator": [0.3, 0.2, 0.5, 1.0],
    "palletizer": [90.0, 0.2, 0.5, 1.0],
    "tricept": [0.1, 0.1, -1.5, 0.0, 0.8, 0.0],
}


@pytest.mark.parametrize("name", BEYOND)
def test_a_row_out_of_reach_takes_at_most_ten_times_the_evaluations(name, monkeypatch):
    robot = load_cached_robot(name)
    target = sample_workspace(robot, 1, seed=1).coordinates
    calls = count_calls(monkeypatch, inverse_kinematics._Rows, "evaluate")
    assert inverse(robot, target).converged.all()
    reached = len(calls)
    calls.clear()
    assert not inverse(robot, [BEYOND[name]]).converged.any()
    assert reached < len(calls) <= 10 * reached


def test_a_hexapod_turned_around_is_solved_once_at_its_pose(monkeypatch):
    robot = load_cached_robot("hexapod-42")
    T = robot.home[None].repeat(3, axis=0)
    T[:, :3, :3] = (
        geometry.exp_so3(np.radians([[0, 0, 170], [0, 160, 0], [150, 0, 10]])) @ T[:, :3, :3]
    )
    calls = count_calls(monkeypatch, engine, "reach")
    solution = inverse(robot, T)
    assert (solution.status == Status.OTHER_MODE).all()
    assert len(calls) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["3-prs", "excavator"])
def test_limited_steps_still_project_to_the_nearest_pose(name: str) -> None:
    robot, n = load_cached_robot(name), 8
    near = inverse(robot, sample_workspace(robot, n, seed=1).coordinates).T
    twist = np.random.default_rng(2).uniform(-1.0, 1.0, (n, 6)) * np.repeat([0.3, 0.3], 3)
    away = geometry.apply_twist(near, twist * np.repeat([1.0, robot.size], 3))
    solution = inverse(robot, away)
    slope = differentiate_by_coordinates(robot, robot.values[None], solution.state)[0]
    slope = slope * robot.twist_scale[:, None]
    gap = geometry.pose_difference(solution.T, away) * robot.twist_scale
    gradient = np.einsum("nij,ni->nj", slope, gap)[solution.converged]
    assert len(gradient) > 6
    # [m] of a gap of 0.3 sizes: it is across the reachable poses; Gauss-Newton ends in 12 steps
    assert np.abs(gradient).max() < 1e-5 * robot.size
