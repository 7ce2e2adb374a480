# SPDX-License-Identifier: Apache-2.0
"""`certify` names only goals that `solve` reaches from the start, with the sign it finds there."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.engine import CONVERGED, select_engine
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.modes import find_assembly_modes
from tests import zoo
from tests.engine.cases import actuated_joint_values, make_case
from tests.engine.conftest import ENGINES

HEXAPODS = ("hexapod-42", "hexapod-nategh-agheli", "hexapod-octahedral")


@pytest.fixture(params=ENGINES[1:])  # NumPy proves nothing
def engine(request):
    return select_engine(request.param)


def draw_goals(engine, robot, wide, t=3, n=200):
    """Return a case and the solutions (t, n) with the platform at poses around home.

    wide : largest shift relative to the robot's size, and angle [rad].
    """
    case, rng = make_case(robot, t=t, n=n), np.random.default_rng(int(10 * wide))
    twist = wide * rng.uniform(-1, 1, (t, n, 6)) * np.repeat([1.0, case.program.size], 3)
    T = geometry.apply_twist(np.broadcast_to(robot.home, (t, n, 4, 4)), twist)
    limbs = case.program.with_fixed_platform
    goal = engine.solve(limbs, case.e, case.home_q, replace(case.home, T=T), free=True)
    return case, goal


@pytest.mark.parametrize("name", HEXAPODS)
@pytest.mark.parametrize("wide", [0.1, 0.3, 1.0, 2.5])
def test_goals_that_are_proven_are_reached_without_a_change_of_sign(engine, name, wide):
    case, goal = draw_goals(engine, load_robot(name), wide)
    sign = engine.certify(case.program, case.e, case.home, goal)
    sure = sign != 0
    q = actuated_joint_values(case.program, goal)
    reached = engine.solve(case.program, case.e, q, case.home)
    assert_array_equal(reached.status[sure], CONVERGED)
    assert_array_equal(reached.closure_sign[sure], sign[sure])
    gap = geometry.pose_difference(reached.T[sure], goal.T[sure])
    assert_allclose(gap, 0.0, atol=1e-11)  # [rad, m] rounding times the condition of far poses
    if wide == 0.1:
        assert sure.mean() > 0.8


def test_most_poses_of_a_workspace_are_proven(engine):
    robot = load_robot("hexapod-42")
    ranges = np.array([robot.assembly.workspace[name] for name in robot.controlled])
    shift, angle = ranges[:3, 1].copy(), ranges[3:, 1]
    shift[2] -= robot.home[2, 3]
    rng = np.random.default_rng(0)
    twist = rng.uniform(-1, 1, (1, 500, 6)) * np.concatenate([angle, shift])
    T = geometry.apply_twist(np.broadcast_to(robot.home, (1, 500, 4, 4)), twist)
    case = make_case(robot, t=1, n=500)
    sign = engine.certify(case.program, case.e, case.home, replace(case.home, T=T))
    assert (sign != 0).mean() > 0.85


def test_other_modes_of_the_same_readings_are_not_proven(engine):
    robot = load_robot("hexapod-42")
    modes = find_assembly_modes(robot, np.zeros(6)).solution
    case = make_case(robot, t=1, n=len(modes))
    e = np.zeros((1, case.program.n_displacements))
    sign = engine.certify(case.program, e, case.home, modes.state)[0]
    away = np.abs(modes.T - robot.home).max(axis=(1, 2)) > 1e-6
    assert away.sum() > 1
    assert_array_equal(sign[away], 0)
    assert_array_equal(sign[~away], case.home.closure_sign[0])


def test_goals_that_are_not_finite_are_not_proven(engine):
    case, goal = draw_goals(engine, load_robot("hexapod-42"), 0.1, t=1, n=5)
    T = goal.T.copy()
    T[0, 1, 0, 3], T[0, 2, 0, 0], T[0, 3] = np.nan, np.inf, 0.0
    sign = engine.certify(case.program, case.e, case.home, replace(goal, T=T))
    assert_array_equal(sign[0] != 0, [True, False, False, False, True])
    lost = replace(case.home, T=np.full((1, 1, 4, 4), np.nan))
    assert_array_equal(engine.certify(case.program, case.e, lost, goal), 0)


def test_nothing_is_proven_for_a_start_in_a_singularity(engine):
    case, goal = draw_goals(engine, load_robot("hexapod-42"), 0.01, t=1, n=4)
    flat = np.eye(4)[None, None]  # all legs lie in the plane of base and platform
    sign = engine.certify(case.program, 0 * case.e, replace(case.home, T=flat), goal)
    assert_array_equal(sign, 0)


def test_nothing_is_proven_for_other_structures_and_starts_of_many_poses(engine):
    for robot in (zoo.delta(), zoo.mixed_hexapod(), zoo.planar_rrr()):
        case = make_case(robot)
        state = engine.solve(case.program, case.e, case.q, case.home)
        assert_array_equal(engine.certify(case.program, case.e, case.home, state), 0)
    case, goal = draw_goals(engine, load_robot("hexapod-42"), 0.1, t=1, n=5)
    assert_array_equal(engine.certify(case.program, case.e, goal, goal), 0)
    none = replace(goal, T=goal.T[:, :0])
    assert engine.certify(case.program, case.e, case.home, none).shape == (1, 0)


def test_proofs_of_trials_are_those_of_single_trials(engine):
    case, goal = draw_goals(engine, load_robot("hexapod-42"), 0.4, t=5, n=21)
    together = engine.certify(case.program, case.e, case.home, goal)
    assert 0 < (together != 0).mean() < 1
    for i in range(5):
        alone = replace(goal, T=goal.T[i : i + 1, 7:9])
        sign = engine.certify(case.program, case.e[i : i + 1], case.home, alone)
        assert_array_equal(together[i, 7:9], sign[0])
    case, goal = draw_goals(engine, load_robot("hexapod-42"), 0.4, t=1, n=6000)
    together = engine.certify(case.program, case.e, case.home, goal)
    for row in (0, 2999, 3000, 5999):
        alone = replace(goal, T=goal.T[:, [row]])
        assert engine.certify(case.program, case.e, case.home, alone)[0, 0] == together[0, row]
