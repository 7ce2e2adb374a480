# SPDX-License-Identifier: Apache-2.0
"""A target counts as reached only if forward kinematics from the start returns it: every shipped
robot, in its workspace and far beyond it.

A new file in src/loopcal/robots is included automatically.
"""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.compensation import Reach, compensate
from loopcal.engine import NEAR_GOAL
from loopcal.errors import DataError
from loopcal.measure.readings import solve_commanded_poses
from loopcal.mechanism.inverse import determine_platform, inverse_trials
from loopcal.mechanism.kinematics import clear_sign, compute_readings, drive_loops, forward_trials
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.modes import find_working_modes
from loopcal.mechanism.platform_coordinates import compare_coordinates, read_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.singularities import trace_singularity
from loopcal.mechanism.solutions import (
    SAME_POSE,
    Solution,
    forward,
    has_one_solution,
    inverse,
    judge_modes,
    make_solution,
)
from loopcal.mechanism.states import Status, select_poses
from loopcal.mechanism.workspace import (
    check_limits,
    draw_coordinates,
    sample_workspace,
    workspace_ranges,
)
from tests.zoo import ROBOTS, load_cached_robot

Array = NDArray[np.float64]
ROWS = 40
WIDE = (1.0, 2.5, 6.0)  # times the ranges of the workspace
ROUNDING = 1e-9  # of the size, or in radians


def draw_targets(robot: Mechanism, wide: float, n: int = ROWS) -> Array:
    """Draw coordinates (n, c) from ranges of the workspace widened about their middle."""
    ranges = {}
    for name, (low, high) in workspace_ranges(robot).items():
        middle, half = (low + high) / 2, wide * (high - low) / 2
        ranges[name] = (middle - half, middle + half)
    if "theta" in ranges:
        ranges["theta"] = (0.0, min(ranges["theta"][1], 3.0))
    return draw_coordinates(np.random.default_rng(5), robot.controlled, ranges, n)


def measure_gap(robot: Mechanism, solution: Solution, wanted: Array) -> Array:
    """Return how far (n,) forward solutions are from poses, per size; infinite where they fail."""
    gap = np.abs(geometry.pose_difference(solution.T, wanted) * robot.twist_scale).max(axis=1)
    return np.where(solution.converged, gap / robot.size, np.inf)


def start_readings(robot: Mechanism) -> Array:
    """Return the readings (1, a) of home."""
    return compute_readings(robot, robot.values[None], robot.home_state)[0]


def measure_mobility_sign(robot: Mechanism, solution: Solution) -> Array:
    """Return the sign (n,) of the determinant of the coordinates' derivatives by the readings."""
    names, T = robot.controlled, solution.T
    _, by_twist = compare_coordinates(T, read_coordinates(T, names), names, robot.size)
    slopes = differentiate_pose(robot, robot.values[None], solution.q[None], solution.state)
    return np.sign(np.linalg.det(np.nan_to_num(by_twist @ slopes.readings[0])))


@pytest.mark.slow
@pytest.mark.parametrize(
    "wide", [*(pytest.param(wide, marks=pytest.mark.evidence) for wide in (1.0, 2.5)), 6.0]
)
@pytest.mark.parametrize("name", ROBOTS)
def test_converged_rows_return_from_home_and_other_modes_do_not(name: str, wide: float) -> None:
    robot = load_cached_robot(name)
    result = inverse(robot, draw_targets(robot, wide, 8))
    gap = measure_gap(robot, forward(robot, result.q), result.T)
    assert gap[result.converged].max(initial=0.0) < ROUNDING
    other = result.status == Status.OTHER_MODE
    if robot.stages and len(robot.actuators) == len(robot.controlled):
        # readings of a flipped arm lead to their pose
        home = measure_mobility_sign(robot, forward(robot, start_readings(robot)))
        other &= measure_mobility_sign(robot, result) == home
    # Close to a singularity the two solutions of a row lie close together.
    assert gap[other].min(initial=np.inf) > 1e-6
    for row in np.flatnonzero(other)[:3]:
        assert "in another mode than the start" in str(result.explain(int(row)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_modes_are_those_of_complete_forward_solutions(name: str) -> None:
    robot = load_cached_robot(name)
    # a tenth of the rows of the pentapod are refused, which needs more of them to count
    values, n = robot.values[None], 60 if name == "pentapod" else 9
    for wide in WIDE:
        target = draw_targets(robot, wide, n)[None]
        state = inverse_trials(robot, values, target)
        rows = np.flatnonzero(state.status[0] == Status.CONVERGED)
        closed = select_poses(state, rows)
        home = select_poses(robot.home_state, np.zeros(len(rows), dtype=np.int64))
        back = forward(robot, compute_readings(robot, values, closed)[0])
        gap = measure_gap(robot, back, closed.T[0])
        has_sign = clear_sign(robot, closed).closure_sign == clear_sign(robot, home).closure_sign
        expected = has_sign[0] & (gap <= SAME_POSE)
        # an arm that was stretched on the way is bent to the other side
        if determine_platform(robot) and not has_one_solution(robot):
            q = compute_readings(robot, values, closed)[0]
            at_home = forward(robot, start_readings(robot))
            expected &= measure_mobility_sign(
                robot, make_solution(robot, closed, q)
            ) == measure_mobility_sign(robot, at_home)
        for begin in (home, robot.home_state):  # a start of one pose allows proofs
            judged, is_other = judge_modes(robot, closed, begin)
            assert is_other[~expected].all()
            # a few that return by a jump are refused, see test_shipped_robots
            refused = (is_other & expected).sum()
            assert refused <= (0.1 * is_other.size if name == "pentapod" else 0)
            assert_array_equal(judged.closure_sign, closed.closure_sign)


def test_the_test_of_modes_ends_long_before_rounding() -> None:
    robot = load_cached_robot("hexapod-42")
    values = robot.values[None]
    state = inverse_trials(robot, values, draw_targets(robot, 1.0)[None])
    q = compute_readings(robot, values, state)
    loops, joints = drive_loops(robot, values, q)
    ended = loops.close(joints, goal=state)
    assert (ended.status == NEAR_GOAL).mean() > 0.95
    assert ended.iterations.mean() < 0.6 * forward_trials(robot, values, q).iterations.mean()


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_no_target_called_reached_differs_from_the_pose_of_its_readings(name: str) -> None:
    robot = load_cached_robot(name)
    spread = np.nan_to_num(robot.parameters.tolerance, nan=1e-4)
    noise = np.random.default_rng(1).standard_normal(len(spread))
    true = robot.with_values(robot.values + spread * noise)
    result = compensate(true, draw_targets(robot, 2.5, 15))
    back = forward(true, result.readings[result.usable])
    assert result.usable.any()
    assert measure_gap(robot, back, result.reached[result.usable]).max() < ROUNDING
    reached = np.array([reach is Reach.REACHED for reach in result.reach])[result.usable]
    wanted = result.wanted[result.usable]
    assert measure_gap(robot, back, wanted)[reached].max(initial=0.0) < 2 * ROUNDING
    q = result.readings[result.usable]
    allowed, _ = check_limits(true, true.values[None], q[None], back.state)
    assert allowed.all()


@pytest.mark.parametrize("name", ["five-bar", "hexapod-42", "linear-delta"])
def test_shifted_commands_called_reached_lead_to_their_targets(name: str) -> None:
    robot = load_cached_robot(name)
    true = robot.with_values(robot.values + 1e-5)
    result = compensate(true, draw_targets(robot, 1.5, 15), "commands", steps=5)
    assert result.commands is not None
    back = forward(true, inverse(robot, result.commands[result.usable]).q)
    assert result.usable.sum() > 3
    assert measure_gap(robot, back, result.reached[result.usable]).max() < ROUNDING


def test_linear_delta_above_its_carriages_exceeds_its_strokes() -> None:
    robot = load_cached_robot("linear-delta")
    targets = np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.36]])
    solution = inverse(robot, targets)
    # The solution with the carriages below the platform, which home does not lead to, is not taken.
    assert solution.converged.all()
    assert forward(robot, solution.q).T[1, 2, 3] == pytest.approx(0.36, abs=1e-12)
    result = compensate(robot, targets)
    assert result.reach == (Reach.REACHED, Reach.OUTSIDE)
    assert "stroke of q1" in str(result.findings[1])


def test_target_in_another_mode_is_refused_with_the_reason() -> None:
    robot = load_cached_robot("3-prs")
    targets = draw_targets(robot, 6.0)
    solution = inverse(robot, targets)
    other = np.flatnonzero(solution.status == Status.OTHER_MODE)[:3]
    result = compensate(robot, targets[other])
    assert set(result.reach) == {Reach.OTHER_MODE}
    assert not result.usable.any()
    assert "from home its readings lead to another pose" in str(result)
    with pytest.raises(DataError, match=r"'far' .* in another mode than the start"):
        solve_commanded_poses(robot, targets[other[:1]], ("far",))


@pytest.mark.parametrize("mode", ["readings", "commands"])
def test_targets_that_no_pose_was_found_for_have_no_numbers(mode) -> None:
    robot = load_cached_robot("3-prs")
    true = robot.with_values(robot.values + 1e-5)
    result = compensate(true, draw_targets(robot, 6.0), mode)
    lost = np.array([r in (Reach.OTHER_MODE, Reach.UNREACHABLE) for r in result.reach])
    assert lost.any()
    assert result.usable.any()
    names = ["readings", "reached", "remaining", "not_compensable"]
    for name in [*names, "commands"] if mode == "commands" else names:
        values = getattr(result, name).reshape(ROWS, -1)
        assert np.isnan(values[lost]).all(), name
        assert np.isfinite(values[~lost]).all(), name


def test_two_turns_of_the_cranks_reach_what_the_first_solution_does_not() -> None:
    robot = load_cached_robot("five-bar")
    targets = draw_targets(robot, 6.0)
    result = inverse(robot, targets)
    assert not (result.status == Status.OTHER_MODE).any()
    assert result.converged.sum() > 10


def test_arms_of_a_five_bar_stay_bent_as_at_home() -> None:
    # Closed form: the tip of an arm of 200 mm, and on which side of the arm the rod lies.
    robot = load_cached_robot("five-bar")
    motors = np.array([[-0.075, 0.0], [0.075, 0.0]])

    def find_sides(solution: Solution) -> Array:
        arm = 0.2 * np.stack([np.cos(solution.q), np.sin(solution.q)], axis=-1)
        rod = solution.T[:, None, :2, 3] - motors - arm
        return np.sign(arm[..., 0] * rod[..., 1] - arm[..., 1] * rod[..., 0])

    # Each of the first two was CONVERGED with one arm bent to the other side.
    targets = np.array([[0.28494558, 0.15969963], [-0.29664238, 0.1867183]])
    result = inverse(robot, np.concatenate([targets, draw_targets(robot, 6.0, 200)]))
    assert result.converged[:2].all()
    assert result.converged.sum() > 50
    home = find_sides(forward(robot, start_readings(robot)))
    assert (find_sides(result)[result.converged] == home).all()


@pytest.mark.parametrize("name", ["five-bar", "3-rrr", "linear-delta"])
def test_a_start_selects_the_mode_and_stays_in_it(name: str) -> None:
    robot = load_cached_robot(name)
    target = sample_workspace(robot, 1, seed=3).coordinates
    modes = find_working_modes(robot, target[0], patience=2048)
    assert len(modes) > 1
    for k in range(len(modes)):
        start = modes.solution.take(np.arange(k, k + 1))
        near = inverse(robot, target + 1e-3 * robot.size, start)
        assert near.converged.all()
        assert measure_gap(robot, forward(robot, near.q, start), near.T).max() < ROUNDING


def test_paths_are_followed_beyond_a_singularity() -> None:
    robot = load_cached_robot("3-prs")
    targets = draw_targets(robot, 6.0)
    far = targets[inverse(robot, targets).status == Status.OTHER_MODE][0]
    home = read_coordinates(robot.home, robot.controlled)
    steps = home + np.linspace(0.0, 1.0, 30)[:, None] * (far - home)
    path = trace_singularity(robot, coordinates=steps)
    crossings = [step for step, finding in path.warnings if finding.code.endswith("crosses")]
    assert crossings
    assert path.solution.closed.all()
    assert_array_equal(np.flatnonzero(path.solution.status == Status.OTHER_MODE), crossings)


def test_one_start_for_each_row_is_compared_row_by_row() -> None:
    robot = load_cached_robot("linear-delta")
    targets = draw_targets(robot, 2.5)
    first = inverse(robot, targets)
    again = inverse(robot, targets + 1e-4 * robot.size, first)
    near = again.closed & first.closed
    assert near.sum() > 15
    # A small step does not leave the mode of its own start, whatever that is.
    assert again.converged[near].mean() > 0.95
