# SPDX-License-Identifier: Apache-2.0
"""`solve` returns closed loops or marks the row, and each row is bit for bit independent of the
other rows.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.engine import CONVERGED, EXHAUSTED, NEAR_GOAL, NOT_FINITE, STALLED, Slot, Sums
from loopcal.engine.numpy_engine.newton import follow_by
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.compilation import build
from tests import zoo
from tests.engine.cases import (
    actuated_joint_values,
    closure_gap,
    displacement_units,
    draw_sums,
    make_case,
    pose_demand,
)

CLOSED = 1e-13  # of the robot's size: a hundred roundings of a coordinate
FIELDS = ("T", "status", "residual", "iterations", "closure_sign")


def assert_same(a, b):
    """Assert that two states are equal bit for bit."""
    for field in FIELDS:
        assert_array_equal(getattr(a, field), getattr(b, field), err_msg=field)
    for x, y in zip(a.joints, b.joints, strict=True):
        assert_array_equal(x, y)


def take_rows(state, trials, rows):
    """Select trials and rows of a state."""
    pick = {field: getattr(state, field)[trials][:, rows] for field in FIELDS}
    return replace(state, joints=tuple(j[trials][:, rows] for j in state.joints), **pick)


def test_every_row_converges_to_closed_loops(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    assert_array_equal(state.status, CONVERGED)
    assert state.residual.max() <= CLOSED * case.program.size
    assert closure_gap(case.program, state, case.e).max() <= CLOSED * case.program.size
    assert_allclose(
        state.T[..., :3, :3] @ state.T[..., :3, :3].swapaxes(-1, -2),
        np.broadcast_to(np.eye(3), (1, 5, 3, 3)),
        atol=1e-14,
    )
    assert state.iterations.max() <= 10


def test_rows_that_come_near_their_goal_end_there(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    ended = engine.solve(case.program, case.e, case.q, case.home, goal=state)
    assert_array_equal(ended.status, NEAR_GOAL)
    assert (ended.iterations < state.iterations).all()


def test_rows_with_a_goal_elsewhere_end_as_without_it(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    away = np.array(state.T)
    away[..., :3, 3] += case.program.size
    ended = engine.solve(case.program, case.e, case.q, case.home, goal=replace(state, T=away))
    assert_same(ended, state)


def test_actuated_joints_have_the_given_values(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    assert_array_equal(actuated_joint_values(case.program, state), case.q)


def test_sums_of_driven_joints_lead_where_the_joints_do(engine, case):
    sums, start = draw_sums(case), case.program.list_drives(case.home.joints)
    state = engine.solve(case.program, case.e, start, case.home, sums=sums)
    expected = engine.solve(case.program, case.e, case.q, case.home)
    assert_array_equal(state.status, CONVERGED)
    # [1] and [m]: rounding times the condition of these robots and of the weights
    assert_allclose(state.T, expected.T, atol=1e-13)
    assert_allclose(actuated_joint_values(case.program, state), case.q, atol=1e-13)
    alone = Sums(sums.weights, sums.values[:, 2:3])
    assert_same(
        take_rows(state, [0], [2]), engine.solve(case.program, case.e, start, case.home, sums=alone)
    )


def follow(engine, *arguments, **options):
    """Solve poses one after the other, as `loopcal.engine.follow` does by this engine."""
    own = engine.follow or partial(follow_by, engine.solve)
    return own(*arguments, **options)


@pytest.mark.parametrize("has_sums", [False, True])
def test_poses_in_a_chain_begin_at_the_one_before(engine, has_sums):
    one = make_case(zoo.mixed_hexapod(), t=3)
    sums, start, states = draw_sums(one) if has_sums else None, one.home, []
    chain = follow(engine, one.program, one.e, one.q, one.home, sums=sums)
    for i in range(one.q.shape[1]):
        q, given = one.q[:, i : i + 1], None
        if sums is not None:
            q = one.program.list_drives(start.joints)
            given = Sums(sums.weights, sums.values[:, i : i + 1])
        start = engine.solve(one.program, one.e, q, start, sums=given)
        states.append(start)
    for i, state in enumerate(states):
        assert_same(take_rows(chain, [0, 1, 2], [i]), state)


def test_a_chain_may_end_at_the_first_pose_that_does_not_converge(engine):
    one = make_case(zoo.hexapod(), t=3)
    q = one.q.copy()
    q[1, 2] = np.nan
    chain = follow(engine, one.program, one.e, q, one.home, ends=True)
    whole = follow(engine, one.program, one.e, one.q, one.home)
    assert_array_equal(chain.status[1], [CONVERGED, CONVERGED, NOT_FINITE, NOT_FINITE, NOT_FINITE])
    assert_same(take_rows(chain, [0, 2], np.arange(5)), take_rows(whole, [0, 2], np.arange(5)))
    assert_same(take_rows(chain, [1], [0, 1]), take_rows(whole, [1], [0, 1]))


def test_a_task_and_fewer_sums_lead_where_all_sums_do(engine):
    one = make_case(zoo.hexapod())
    sums, start = draw_sums(one), one.program.list_drives(one.home.joints)
    expected = engine.solve(one.program, one.e, one.q, one.home)
    wanted = expected.T.reshape(-1, 4, 4)

    def place_height(T, rows):
        slopes = np.zeros((len(rows), 2, 6))
        slopes[:, [0, 1], [4, 5]] = 1.0
        return T[:, 1:3, 3] - wanted[rows, 1:3, 3], slopes

    few = Sums(sums.weights[:, 2:], sums.values[..., 2:])
    state = engine.solve(one.program, one.e, start, one.home, place_height, sums=few)
    assert_array_equal(state.status, CONVERGED)
    assert_allclose(state.T, expected.T, atol=1e-12)  # [1] and [m]: rounding times a condition


def test_platform_moves_in_its_freedoms_only(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    others = [i for i in range(6) if i not in case.program.freedoms]
    assert_allclose(
        geometry.pose_difference(state.T, np.broadcast_to(case.home.T, state.T.shape))[..., others],
        0.0,
        atol=1e-16,
    )


def test_converged_state_is_a_fixed_point(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    again = engine.solve(case.program, case.e, case.q, state)
    # [1] and [m]: rounding times the condition of these robots
    assert_allclose(again.T, state.T, atol=2e-14)
    assert again.iterations.max() <= 2


def test_solving_for_a_pose_recovers_the_actuated_joints(engine):
    for robot in (zoo.mixed_hexapod(), zoo.hexapod()):
        one = make_case(robot)
        # near enough for the working mode of home
        one = replace(one, q=one.home_q + 0.1 * (one.q - one.home_q))
        state = engine.solve(one.program, one.e, one.q, one.home)
        task = pose_demand(state.T.reshape(-1, 4, 4), one.program.size)
        back = engine.solve(
            one.program, one.e, np.broadcast_to(one.home_q, one.q.shape), one.home, task, free=True
        )
        assert_array_equal(back.status, CONVERGED)
        # [m, rad] rounding times a condition near 10
        assert_allclose(actuated_joint_values(one.program, back), one.q, atol=1e-13)
        assert_allclose(back.T, state.T, atol=1e-14)


def has_square_limbs(program):
    """Return whether every limb alone determines its joints."""
    return all(len(g.rows) == len(g.unknown_joints(free=True)) for g in program.groups)


@pytest.mark.parametrize("robot", ["mixed_hexapod", "hexapod", "delta", "five_bar", "planar_rrr"])
def test_limbs_close_alone_where_the_platform_is_given(engine, robot):
    case = make_case(getattr(zoo, robot)(), t=3)
    assert has_square_limbs(case.program)
    q = case.home_q + 0.1 * (case.q - case.home_q)  # near enough for the working mode of home
    state = engine.solve(case.program, case.e, q, case.home)
    given = replace(case.home, T=state.T)
    back = engine.solve(case.program.with_fixed_platform, case.e, case.home_q, given, free=True)
    assert_array_equal(back.status, CONVERGED)
    assert_array_equal(back.T, state.T)
    assert closure_gap(case.program, back, case.e).max() <= CLOSED * case.program.size
    for mine, theirs in zip(back.joints, state.joints, strict=True):
        assert_allclose(mine, theirs, atol=1e-13)  # [m, rad] rounding times a condition near 10
    alone = engine.solve(
        case.program.with_fixed_platform,
        case.e[1:2],
        case.home_q,
        replace(case.home, T=state.T[1:2, 2:3]),
        free=True,
    )
    assert_same(take_rows(back, [1], [2]), alone)


@pytest.fixture(scope="module", params=["6-pus", "linear-delta"])
def sliding(request):
    """Robots whose drives are slides at the feet of rods."""
    return make_case(load_robot(request.param), n=1)


def test_a_slide_stays_on_the_side_of_its_rod_where_it_started(engine, sliding):
    limbs, home = sliding.program.with_fixed_platform, sliding.home
    first = engine.solve(limbs, sliding.e, sliding.home_q, home, free=True)
    beyond = sliding.home_q + 2 * sliding.program.size * np.array([[[1.0], [-1.0]]])
    sides = engine.solve(
        limbs, sliding.e, beyond, replace(home, T=np.repeat(home.T, 2, axis=1)), free=True
    )
    assert_array_equal(sides.status, CONVERGED)
    signs, limb_count = sides.closure_sign[0], sum(len(g.limbs) for g in limbs.groups)
    assert signs[0] * signs[1] == (-1) ** limb_count
    assert closure_gap(limbs, sides, sliding.e).max() <= CLOSED * limbs.size
    upper, lower = actuated_joint_values(limbs, sides)[0]
    assert (upper > lower + 1e-3 * limbs.size).all()
    mine = actuated_joint_values(limbs, first)[0, 0]
    assert (np.isclose(mine, upper, atol=1e-12) | np.isclose(mine, lower, atol=1e-12)).all()


def test_a_given_platform_out_of_reach_is_marked_with_the_open_gap(engine, sliding):
    limbs, T = sliding.program.with_fixed_platform, np.repeat(sliding.home.T, 3, axis=1)
    T[0, 0, :3, 3] += 100 * limbs.size
    T[0, 1, 0, 0] = np.nan
    given = replace(sliding.home, T=T)
    state = engine.solve(limbs, sliding.e, sliding.home_q, given, free=True)
    assert_array_equal(state.status, [[STALLED, NOT_FINITE, CONVERGED]])
    gap = closure_gap(limbs, take_rows(state, [0], [0]), sliding.e)
    assert_allclose(state.residual[:, :1], gap, rtol=1e-12)


@pytest.mark.parametrize("robot", ["mixed_hexapod", "three_prs", "delta"])
def test_solved_trials_equal_single_trials_bit_for_bit(engine, robot):
    case = make_case(getattr(zoo, robot)(), t=7)
    together = engine.solve(case.program, case.e, case.q, case.home)
    for i in range(7):
        alone = engine.solve(case.program, case.e[i : i + 1], case.q[i : i + 1], case.home)
        assert_same(take_rows(together, [i], slice(None)), alone)


def test_trials_with_shared_readings_equal_trials_with_copies(engine):
    case = make_case(zoo.mixed_hexapod(), t=3)
    shared = engine.solve(case.program, case.e, case.q[:1], case.home)
    own = engine.solve(case.program, case.e, np.repeat(case.q[:1], 3, axis=0), case.home)
    assert_same(shared, own)


def test_row_equals_the_same_row_solved_alone_bit_for_bit(engine, case):
    together = engine.solve(case.program, case.e, case.q, case.home)
    for r in range(case.q.shape[1]):
        alone = engine.solve(case.program, case.e, case.q[:, [r]], case.home)
        assert_same(take_rows(together, [0], [r]), alone)


@pytest.mark.parametrize(
    ("name", "n", "rows"),
    [
        ("mixed_hexapod", 6000, (0, 2999, 3000, 5999)),  # NumPy solves two parts of 3000 rows
        ("excavator", 10, range(10)),  # eight equations and more
        ("arm-6r", 10, range(10)),
    ],
)
def test_rows_of_large_batches_and_limbs_equal_single_rows_bit_for_bit(engine, name, n, rows):
    robot = zoo.mixed_hexapod() if name == "mixed_hexapod" else load_robot(name)
    case = make_case(robot, n=n)
    together = engine.solve(case.program, case.e, case.q, case.home)
    for r in rows:
        alone = engine.solve(case.program, case.e, case.q[:, [r]], case.home)
        assert_same(take_rows(together, [0], [r]), alone)


def test_rows_not_finite_are_marked_and_do_not_change_other_rows(engine, case):
    bad = np.repeat(case.q, 2, axis=1)
    bad[:, 1, 0], bad[:, 3, -1], bad[:, 5, 0], bad[:, 7, :] = np.nan, np.inf, -np.inf, np.nan
    state = engine.solve(case.program, case.e, bad, case.home)
    assert_array_equal(state.status[0, [1, 3, 5, 7]], NOT_FINITE)
    good = [0, 2, 4, 6, 8, 9]
    assert_same(
        take_rows(state, [0], good), engine.solve(case.program, case.e, bad[:, good], case.home)
    )


def test_displacements_not_finite_mark_their_trial(engine):
    case = make_case(zoo.mixed_hexapod(), t=3)
    e = np.array(case.e)
    e[1, 5] = np.nan
    state = engine.solve(case.program, e, case.q, case.home)
    assert_array_equal(state.status[1], NOT_FINITE)
    assert_array_equal(state.status[[0, 2]], CONVERGED)


def test_unreachable_rows_are_marked_with_their_residual(engine, case):
    far = np.repeat(case.home_q, 4, axis=1)
    far += (
        np.where(np.arange(case.program.n_joints) == 0, 1.0, 0.0)
        * case.program.size
        * np.array([3.0, -3.0, 30.0, 1e6])[:, None]
    )
    state = engine.solve(case.program, case.e, far, case.home)
    if case.name in ("five-bar", "3-RRR"):  # a crank can turn by any angle
        assert np.isin(state.status, [CONVERGED, STALLED, EXHAUSTED, NOT_FINITE]).all()
        return
    lost = state.status != CONVERGED
    closed = closure_gap(case.program, state, case.e)
    assert (closed[~lost] <= CLOSED * case.program.size).all()
    assert lost[0, 2:].all()
    assert (state.residual[lost & np.isfinite(state.residual)] > 1e-6 * case.program.size).all()


def test_rod_of_zero_length_is_marked_without_an_exception(engine):
    case = make_case(zoo.hexapod())
    T = np.array(case.home.T)
    T[0, 0, :3, 3] = zoo.HEXAPOD_BASE[0] * zoo.MM - zoo.HEXAPOD_PLATFORM[0] * zoo.MM
    state = engine.solve(case.program, 0 * case.e, case.q, replace(case.home, T=T))
    assert_array_equal(state.status, NOT_FINITE)


def test_singular_start_raises_no_exception(engine):
    # platform congruent to the base, all legs parallel: three freedoms are free
    base = zoo.HEXAPOD_BASE * zoo.MM
    case = make_case(zoo.gough("regular", base, 0.6 * base[[1, 0, 3, 2, 5, 4]], 0.3, 0.3))
    links = np.array(case.program.groups[0].links)
    links[:, 1] = links[:, 0]
    program = replace(case.program, groups=(replace(case.program.groups[0], links=links),))
    state = engine.solve(program, 0 * case.e, np.full((1, 2, 6), 0.01), case.home)
    assert state.status.shape == (1, 2)
    assert (state.status != CONVERGED).all() or np.isfinite(state.T).all()


def test_exhausted_iterations_are_marked(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home, max_iterations=1)
    assert_array_equal(state.status, EXHAUSTED)
    assert_array_equal(state.iterations, 1)


def test_solve_does_not_change_its_arguments(engine, case):
    e, q, T = np.array(case.e), np.array(case.q), np.array(case.home.T)
    engine.solve(case.program, case.e, case.q, case.home)
    assert_array_equal(case.e, e)
    assert_array_equal(case.q, q)
    assert_array_equal(case.home.T, T)


def test_mirrored_assembly_mode_has_the_opposite_closure_sign(engine):
    # a linear delta's nozzle above its carriages is the mirrored mode; between the two lies a
    # singularity
    case = make_case(zoo.delta())
    T = np.array(case.home.T)
    T[0, 0, 2, 3] += 2 * 0.24  # [m] from below to above the carriages
    above = engine.solve(case.program, case.e, case.q, replace(case.home, T=T))
    below = engine.solve(case.program, case.e, case.q, case.home)
    assert_array_equal(above.status, CONVERGED)
    assert_array_equal(above.closure_sign, -below.closure_sign)


@pytest.mark.parametrize("seed", range(5))
def test_random_limbs_of_every_kind_converge(engine, seed):
    robot = build(zoo.mixed_hexapod_assembly(seed))
    case = make_case(robot, n=4, seed=seed)
    small = case.home_q + 0.3 * (case.q - case.home_q)
    state = engine.solve(case.program, case.e, small, case.home)
    assert_array_equal(state.status, CONVERGED)
    assert closure_gap(case.program, state, case.e).max() <= CLOSED * case.program.size


def test_mixed_hexapod_has_displacements_at_every_element_of_a_limb():
    program = zoo.mixed_hexapod().program
    assert {g.ending for g in program.groups} == {"rigid", "ball", "distance"}
    for group in program.groups:
        expected = {
            Slot(element, axis) for element in range(len(group.joints) + 2) for axis in range(6)
        }
        assert expected <= set(group.slots)
    assert (
        len(displacement_units(program))
        == program.n_displacements
        == len(zoo.mixed_hexapod().parameters) - 12
    )


def test_four_threads_give_equal_results_bit_for_bit(engine, case):
    def run(_: int) -> tuple[np.ndarray, ...]:
        state = engine.solve(case.program, case.e, case.q, case.home)
        blocks = engine.linearize(case.program, case.e, case.q, state)
        arrays = [a for b in (*blocks.closure, *blocks.passive) for a in (b.U, b.A, b.E, b.Q)]
        return state.T, *state.joints, state.residual, state.status, *arrays

    alone = run(0)
    with ThreadPoolExecutor(4) as pool:
        for together in pool.map(run, range(8)):
            for a, b in zip(alone, together, strict=True):
                assert_array_equal(a, b)
