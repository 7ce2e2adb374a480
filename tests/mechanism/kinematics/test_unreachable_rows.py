# SPDX-License-Identifier: Apache-2.0
"""Targets that a robot does not reach: the sphere that links span, and the effort of a row."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from loopcal import engine, geometry
from loopcal.mechanism import chains as chain_inverse
from loopcal.mechanism.chains import bound_platform
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import differentiate_by_coordinates, forward, inverse
from loopcal.mechanism.states import Status
from loopcal.mechanism.workspace import sample_workspace
from tests.zoo import load_cached_robot

Array = NDArray[np.float64]


def draw_machines(robot: Mechanism, n: int) -> Array:
    """Draw values (n, p) of all parameters, 20 tolerances from the nominal ones."""
    errors = np.random.default_rng(3).standard_normal((n, len(robot.parameters)))
    return robot.parameters.nominal + 20 * errors * robot.parameters.tolerance


@pytest.mark.parametrize("name", ["arm-6r", "excavator", "palletizer"])
def test_no_pose_of_any_machine_is_outside_its_sphere(name: str) -> None:
    robot = load_cached_robot(name)
    low, high = np.array([a.stroke for a in robot.actuators]).T
    q = np.random.default_rng(1).uniform(low, high, (100, len(low)))
    for values in draw_machines(robot, 4):
        machine = robot.with_values(values)
        solution = forward(machine, q)
        center, radius = bound_platform(machine, values[None])
        assert np.isfinite(radius[0])
        far = np.linalg.norm(solution.T[solution.closed, :3, 3] - center[0], axis=1)
        assert len(far) > 20
        assert far.max() < radius[0] + 1e-12  # [m] rounding
        assert far.max() > 0.6 * radius[0]  # the sphere is of the size of the robot


@pytest.mark.parametrize("name", ["tricept", "linear-delta-6", "belt-4", "hexapod-42"])
def test_slides_and_driven_rods_have_no_sphere(name: str) -> None:
    robot = load_cached_robot(name)
    assert np.isinf(bound_platform(robot, robot.values[None])[1]).all()


def count_calls(monkeypatch: pytest.MonkeyPatch, owner: object, name: str) -> list[int]:
    """Return a list that grows by one for each call of a function."""
    calls: list[int] = []
    function: Callable[..., object] = getattr(owner, name)

    def counted(*args: object, **options: object) -> object:
        calls.append(1)
        return function(*args, **options)

    monkeypatch.setattr(owner, name, counted)
    return calls


def test_targets_beyond_the_sphere_take_a_single_evaluation(monkeypatch):
    robot = load_cached_robot("arm-6r")
    target = sample_workspace(robot, 3, seed=1).coordinates
    far = target + np.array([8.0, 0, 0, 0, 0, 0])
    calls = count_calls(monkeypatch, chain_inverse._Rows, "evaluate")
    solution = inverse(robot, np.concatenate([far, target]))
    reached = len(calls)
    assert (solution.status[:3] == Status.UNREACHABLE).all()
    assert solution.converged[3:].all()
    assert 7.0 < solution.residual[0] < 9.0  # [m] how far away the target stays
    calls.clear()
    inverse(robot, far)
    assert len(calls) == 1 < reached


# Within the sphere: at the foot of the excavator, and behind the base of the Tricept.
NEAR_BASE = {"excavator": [0.3, 0.2, 0.5, 1.0], "tricept": [0.1, 0.1, -1.5, 0.0, 0.8, 0.0]}


@pytest.mark.parametrize("name", NEAR_BASE)
def test_a_row_out_of_reach_takes_at_most_ten_times_the_evaluations(name, monkeypatch):
    robot = load_cached_robot(name)
    target = sample_workspace(robot, 1, seed=1).coordinates
    calls = count_calls(monkeypatch, chain_inverse._Rows, "evaluate")
    assert inverse(robot, target).converged.all()
    reached = len(calls)
    calls.clear()
    assert not inverse(robot, [NEAR_BASE[name]]).converged.any()
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
