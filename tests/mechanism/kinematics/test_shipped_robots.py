# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of every shipped robot: random rows within its strokes return to their
assembly mode, or the result states why not (1e5 rows of each robot are evidence); the pentapod
against its closed form, which also tells the working mode of distant poses.

A new file in src/loopcal/robots is included automatically.
"""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from loopcal import geometry
from loopcal.apply.compensation import Reach, compensate
from loopcal.mechanism.inverse import inverse_trials
from loopcal.mechanism.kinematics import compute_readings
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.solutions import Solution, forward, inverse, jacobian
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests.zoo import ROBOTS, load_cached_robot

Array = NDArray[np.float64]


ROWS, MANY_ROWS, BLOCK = 1_000, 100_000, 1_500

SHARE = 0.999  # of rows that must return to the mode they came from

FAR = 20.0  # times the workspace: no machine reaches all of it


def draw_coordinates(
    machine: Mechanism, rng: np.random.Generator, n: int, wide: float = 1.0
) -> Array:
    """Draw coordinates (n, c) evenly from the workspace, widened `wide` times about its middle."""
    low, high = np.array([machine.assembly.workspace[name] for name in machine.controlled]).T
    middle, half = (low + high) / 2, (high - low) / 2
    return middle + wide * half * rng.uniform(-1.0, 1.0, (n, len(low)))


def list_strokes(machine: Mechanism) -> Array:
    """Return the strokes (a, 2) of readings; the load of an elastic drive has none."""
    return np.array([actuator.stroke or (-500.0, 500.0) for actuator in machine.actuators])


def is_within_strokes(machine: Mechanism, q: Array) -> NDArray[np.bool_]:
    """Return the rows whose readings are within every stroke."""
    low, high = list_strokes(machine).T
    return ((q >= low) & (q <= high)).all(axis=1)


def generate_reachable_rows(machine: Mechanism, seed: int, rows: int) -> Iterator[Solution]:
    """Yield blocks of solutions within strokes; at least half of the workspace must be."""
    rng, result, tried = np.random.default_rng(seed), 0, 0
    while result < rows:
        solution = inverse(machine, draw_coordinates(machine, rng, BLOCK))
        tried += BLOCK
        some = solution.take(
            np.flatnonzero(solution.converged & is_within_strokes(machine, solution.q))[
                : rows - result
            ]
        )
        result += len(some.q)
        assert result >= 0.5 * min(tried, rows)
        yield some


def has_returned(there: Solution, back: Solution) -> NDArray[np.bool_]:
    """Return the rows that converged to their original pose."""
    # [rad, m] Newton stops below 1e-13 of the size; the rest is the condition of the mechanism
    return back.converged & (np.abs(geometry.pose_difference(back.T, there.T)).max(axis=1) < 1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("rows", [ROWS, pytest.param(MANY_ROWS, marks=pytest.mark.evidence)])
@pytest.mark.parametrize("name", ROBOTS)
def test_rows_within_the_strokes_return_to_their_mode_or_state_why_not(name, rows):
    machine, total, home = load_cached_robot(name), 0, 0
    for solution in generate_reachable_rows(machine, 20, rows):
        back = forward(machine, solution.q)
        good = has_returned(solution, back)
        total, home = total + len(good), home + int(good.sum())
        elsewhere = np.flatnonzero(~good & back.converged)
        if len(elsewhere):
            # another true mode: the loops are closed there by the same readings
            other = back.take(elsewhere)
            again = inverse(machine, other.T, start=other)
            assert_allclose(again.q, solution.q[elsewhere], rtol=0, atol=1e-8)
        for row in np.flatnonzero(~back.converged):
            assert back.explain(int(row)).code == Status(int(back.status[row])).code
    assert total == rows
    assert home >= SHARE * total


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_unreachable_coordinates_are_marked_without_an_exception(name: str) -> None:
    machine = load_cached_robot(name)
    solution = inverse(machine, draw_coordinates(machine, np.random.default_rng(21), 20, wide=FAR))
    # a converged row is closed, for any target
    assert solution.residual[solution.converged].max(initial=0.0) <= 1e-9 * machine.size
    for row in np.flatnonzero(~solution.converged)[:20]:
        assert Status(int(solution.status[row])) is not Status.CONVERGED
        assert solution.explain(int(row))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_readings_beyond_strokes_or_not_finite_are_marked_without_an_exception(name: str) -> None:
    machine = load_cached_robot(name)
    low, high = list_strokes(machine).T
    q = np.random.default_rng(22).uniform(
        low - 3 * (high - low), high + 3 * (high - low), (40, len(low))
    )
    q[0], q[1] = np.nan, np.inf
    back = forward(machine, q)
    assert back.status[0] == back.status[1] == Status.NOT_FINITE
    assert np.isfinite(back.T[back.converged]).all()
    if len(machine.actuators) == len(
        machine.controlled
    ):  # contradicting readings of redundant actuators leave a residual
        assert back.residual[back.converged].max(initial=0.0) <= 1e-9 * machine.size
    for row in np.flatnonzero(~back.converged):
        assert back.explain(int(row))


@pytest.mark.parametrize("name", ROBOTS)
def test_inverse_of_many_machines_with_one_start_equals_that_of_each_machine(name):
    robot, n = load_cached_robot(name), 3
    rng = np.random.default_rng(4)
    values = robot.values + 1e-4 * rng.standard_normal((2, len(robot.parameters)))
    home = read_coordinates(np.repeat(robot.home[None, None], n, axis=1), robot.controlled)
    target = home + 1e-3 * rng.standard_normal((2, n, len(robot.controlled)))
    start = inverse_trials(robot, robot.values[None], home)
    together = inverse_trials(robot, values, target, start)
    for i in range(2):
        alone = inverse_trials(robot, values[i : i + 1], target[i : i + 1], start)
        both = compute_readings(robot, values, together)[i]
        expected = compute_readings(robot, values[i : i + 1], alone)[0]
        assert_allclose(both, expected, rtol=0, atol=1e-12)
        assert np.abs(both - compute_readings(robot, robot.values[None], start)[0]).max() > 1e-5


@pytest.mark.parametrize("name", ROBOTS)
def test_no_poses_have_no_readings(name):
    robot = load_cached_robot(name)
    for target in (np.zeros((0, 4, 4)), np.zeros((0, len(robot.controlled)))):
        assert inverse(robot, target).q.shape == (0, len(robot.actuators))


AZIMUTH = np.radians([0, 72, 144, 216, 288])

ON_CIRCLE = np.column_stack([0.7 * np.cos(AZIMUTH), 0.7 * np.sin(AZIMUTH), [0, 0.6, 0, 0.6, 0]])

BASE = ON_CIRCLE.round(6)  # as the file gives them, to a micrometer

HEIGHT = np.array([0.3, 0.4, 0.2, 0.1, 0.0])

RADIUS = 0.08


@pytest.fixture(scope="module")
def robot() -> Mechanism:
    return load_cached_robot("pentapod")


def solve_closed_form(coordinates: Array) -> tuple[Array, Array]:
    """Return poses (n, 4, 4) and lengths (n, 5) at x, y, z, phi, theta (n, 5)."""
    p, (phi, theta) = coordinates[:, None, :3], coordinates[:, 3:].T
    normal = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1
    )
    gap = BASE - p
    across = gap - (gap @ normal[..., None]) * normal[:, None]
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    hinge = p + HEIGHT[:, None] * normal[:, None] + RADIUS * across
    held, turn = across[:, 4], np.cross(normal, across[:, 4])
    c, s = np.cos(AZIMUTH[4]), np.sin(AZIMUTH[4])
    rotation = np.stack([c * held - s * turn, s * held + c * turn, normal], axis=-1)
    return geometry.make_pose(rotation, p[:, 0]), np.linalg.norm(hinge - BASE, axis=-1)


def draw_distant(n: int, seed: int) -> Array:
    """Draw coordinates (n, 5) three times as far from home as the workspace, tilts up to 70 deg."""
    low = np.array([-0.36, -0.36, 0.65, -np.pi, 0.0])
    high = np.array([0.36, 0.36, 1.1, np.pi, 1.2])
    return np.random.default_rng(seed).uniform(low, high, (n, 5))


def test_readings_and_pose_are_those_of_the_closed_form(robot: Mechanism) -> None:
    target = sample_workspace(robot, 20, seed=2).coordinates
    solution = inverse(robot, target)
    T, q = solve_closed_form(target)
    assert solution.converged.all()
    assert_allclose(solution.q, q, atol=1e-9)
    assert_allclose(solution.T, T, atol=1e-9)
    back = forward(robot, solution.q)
    assert np.abs(back.T - solution.T).max() < 1e-9


def test_distant_poses_are_in_the_mode_of_home_or_marked(robot: Mechanism) -> None:
    # The first target is one for which Newton's method jumps to another solution and back.
    target = np.concatenate([draw_distant(60, 6)[[23]], draw_distant(8, 3)])
    solution = inverse(robot, target)
    T, q = solve_closed_form(target)
    good = solution.converged
    assert solution.status[0] == Status.OTHER_MODE  # was CONVERGED, 114 mm from the closed form
    assert good.sum() > 4
    assert_allclose(solution.q[good], q[good], atol=1e-9)
    assert_allclose(solution.T[good], T[good], atol=1e-9)
    assert compensate(robot, target[:1]).reach == (Reach.OTHER_MODE,)


def test_sensitivities_are_finite_differences(robot: Mechanism) -> None:
    q = inverse(robot, sample_workspace(robot, 2, seed=5).coordinates).q
    exact, step = jacobian(robot, q), 1e-6
    for j in range(0, len(robot.parameters), 7):
        ends = []
        for sign in (1.0, -1.0):
            values = robot.values.copy()
            values[j] += sign * step
            ends.append(forward(robot.with_values(values), q).T)
        slope = geometry.pose_difference(*ends) / (2 * step)
        assert_allclose(exact.parameters[..., j], slope, atol=1e-7)
