# SPDX-License-Identifier: Apache-2.0
"""`reach` closes the loops at stated poses, and names only poses that `solve` reaches from the
start.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.engine import CONVERGED, NOT_FINITE, Target
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.platform_coordinates import pose_from_coordinates, state_target
from tests import zoo
from tests.engine.cases import actuated_joint_values, make_case

ALL = ("x", "y", "z", "roll", "pitch", "yaw")
TILTED = ("psi", "x", "theta", "z", "phi", "y")  # in any order


def draw_target(robot, names, wide, t=1, n=60, seed=5):
    """Return a target around home: `wide` is its largest angle [rad] and shift in sizes."""
    step = wide * np.random.default_rng(seed).uniform(-1, 1, (t, n, len(names)))
    home = dict(zip("xyz", robot.home[:3, 3], strict=True))
    center = np.array([home.get(name, 0.0) for name in names])
    unit = np.array([robot.size if name in home else 1.0 for name in names])
    return state_target(center + unit * step, names, robot.home)


@pytest.mark.parametrize("names", [ALL, TILTED, ("z", "x"), ("yaw",), ("phi", "theta"), ("psi",)])
def test_poses_are_those_of_the_coordinates(engine, names):
    robot = load_robot("hexapod-42")
    target, case = draw_target(robot, names, 0.2, t=3, n=11), make_case(robot, t=3)
    reached = engine.reach(case.program, case.e, target, case.home)
    expected = pose_from_coordinates(target.values, names, robot.home)
    assert_allclose(reached.state.T, expected, atol=1e-15)  # [1, m] rounding of a few products


@pytest.mark.parametrize("wide", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("name", ["hexapod-42", "hexapod-octahedral"])
def test_joints_close_the_loops_and_lead_to_the_poses_that_are_named(engine, name, wide):
    robot = load_robot(name)
    case, target = make_case(robot, t=2, n=60), draw_target(robot, ALL, wide, t=2)
    reached = engine.reach(case.program, case.e, target, case.home)
    q = actuated_joint_values(case.program, reached.state)
    still = engine.solve(case.program, case.e, q, reached.state, max_iterations=0)
    assert_array_equal(reached.state.status, CONVERGED)
    assert_array_equal(reached.state.iterations, 0)
    assert_allclose(still.residual, 0.0, atol=1e-14)  # [m] rounding
    assert_array_equal(reached.state.closure_sign, still.closure_sign)
    forward = engine.solve(case.program, case.e, q, case.home)
    same = np.abs(forward.T - reached.state.T).max(axis=(2, 3)) < 1e-9
    same &= reached.state.closure_sign == case.home.closure_sign
    # a row is named only if Newton's method arrives; the others are nearly all elsewhere
    assert not (reached.arrives & ~same).any()
    assert (reached.arrives != same).mean() < 0.05
    if wide < 0.1:
        assert reached.arrives.all()


def test_machines_with_joints_in_their_limbs_are_closed_limb_by_limb(engine):
    for robot in (zoo.three_prs(), zoo.planar_rrr()):
        case = make_case(robot, t=1, n=4)
        at = engine.solve(case.program, case.e, case.q, case.home)
        base = at.T[0, 1]
        none = Target(np.zeros((1, 3, 0)), (-1,) * 6, False, base)
        reached = engine.reach(case.program, case.e, none, case.home)
        q = actuated_joint_values(case.program, reached.state)
        assert_allclose(reached.state.T, np.broadcast_to(base, (1, 3, 4, 4)))
        assert_allclose(q, np.broadcast_to(case.q[:, 1:2], q.shape), atol=1e-10)  # [m, rad]
        assert_array_equal(reached.state.closure_sign, at.closure_sign[0, 1])
        assert reached.arrives.all()


def test_targets_that_are_not_finite_arrive_nowhere(engine):
    robot = load_robot("hexapod-42")
    case, target = make_case(robot), draw_target(robot, ALL, 0.1, n=5)
    values = target.values.copy()
    values[0, 1, 0], values[0, 2, 4] = np.inf, np.nan
    reached = engine.reach(case.program, case.e, replace(target, values=values), case.home)
    lost = np.array([False, True, True, False, False])
    assert_array_equal(reached.state.status[0] == NOT_FINITE, lost)
    assert_array_equal(reached.arrives[0], ~lost)
    start = replace(case.home, T=np.full((1, 1, 4, 4), np.nan))
    assert not engine.reach(case.program, case.e, target, start).arrives.any()


def test_rows_of_another_sign_are_not_followed(engine):
    robot = load_robot("hexapod-42")
    case, target = make_case(robot, n=40), draw_target(robot, ALL, 0.3, n=40)
    other = replace(case.home, closure_sign=-case.home.closure_sign)
    reached = engine.reach(case.program, case.e, target, other)
    # a proof does not ask for the sign of the start
    proven = np.zeros((1, 40), bool)
    if engine.certify is not None:
        proven = engine.certify(case.program, case.e, case.home, reached.state) != 0
    assert proven.sum() < 40
    assert_array_equal(reached.arrives, proven)


def test_rows_do_not_depend_on_their_neighbors(engine):
    robot = load_robot("hexapod-42")
    case, target = make_case(robot, t=3, n=37), draw_target(robot, ALL, 0.5, t=3, n=37)
    whole = engine.reach(case.program, case.e, target, case.home)
    assert 0 < whole.arrives.mean() < 1
    for i, rows in ((0, slice(0, 1)), (1, slice(5, 19)), (2, slice(30, 37))):
        part = replace(target, values=target.values[i : i + 1, rows])
        alone = engine.reach(case.program, case.e[i : i + 1], part, case.home)
        assert_array_equal(alone.state.T[0], whole.state.T[i, rows])
        assert_array_equal(alone.state.joints[0][0], whole.state.joints[0][i, rows])
        assert_array_equal(alone.state.closure_sign[0], whole.state.closure_sign[i, rows])
        assert_array_equal(alone.arrives[0], whole.arrives[i, rows])
    many = draw_target(robot, ALL, 0.5, t=1, n=6000)  # NumPy closes two parts of 3000
    whole = engine.reach(case.program, case.e[:1], many, case.home)
    for row in (0, 2999, 3000, 5999):
        part = replace(many, values=many.values[:, [row]])
        alone = engine.reach(case.program, case.e[:1], part, case.home)
        assert_array_equal(alone.state.T[0, 0], whole.state.T[0, row])
        assert_array_equal(alone.state.joints[0][0, 0], whole.state.joints[0][0, row])
        assert alone.arrives[0, 0] == whole.arrives[0, row]


def test_poses_of_the_start_change_joints_by_rounding_only(engine):
    robot = load_robot("hexapod-42")
    case, target = make_case(robot, t=3, n=37), draw_target(robot, ALL, 0.5, t=3, n=37)
    whole = engine.reach(case.program, case.e, target, case.home)
    each = replace(case.home, T=np.repeat(case.home.T, 37, axis=1))
    own = engine.reach(case.program, case.e, target, each)
    assert_allclose(own.state.joints[0], whole.state.joints[0], atol=1e-15)  # [m] rounding
    assert_array_equal(own.state.closure_sign, whole.state.closure_sign)
    assert not (whole.arrives & ~own.arrives).any()
