# SPDX-License-Identifier: Apache-2.0
"""What `solve` promises: closed loops or a mark, and for every row the same bits whatever stands
beside it.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal import geometry
from loopcal.engine.program import EXHAUSTED, NOT_FINITE, STALLED, Slot  # what all engines share
from loopcal.mechanism import build
from tests import zoo
from tests.engine.cases import case, driven, open_by, pose_demand, unit_of_displacements

CLOSED = 1e-13  # of the robot's size: a hundred roundings of a coordinate
FIELDS = ("T", "status", "residual", "iterations", "closure_sign")


def assert_same(a, b):
    """Two states agree bit for bit."""
    for field in FIELDS:
        assert_array_equal(getattr(a, field), getattr(b, field), err_msg=field)
    for x, y in zip(a.joints, b.joints, strict=True):
        assert_array_equal(x, y)


def rows_of(state, trials, rows):
    """Chosen trials and rows of a state."""
    pick = {field: getattr(state, field)[trials][:, rows] for field in FIELDS}
    return replace(state, joints=tuple(j[trials][:, rows] for j in state.joints), **pick)


def test_every_row_converges_and_its_loops_are_closed(engine, some):
    state = engine.solve(some.program, some.e, some.q, some.home)
    assert_array_equal(state.status, engine.CONVERGED)
    assert state.residual.max() <= CLOSED * some.program.size
    assert open_by(some.program, state, some.e).max() <= CLOSED * some.program.size
    assert_allclose(
        state.T[..., :3, :3] @ state.T[..., :3, :3].swapaxes(-1, -2),
        np.broadcast_to(np.eye(3), (1, 5, 3, 3)),
        atol=1e-14,
    )
    assert state.iterations.max() <= 10


def test_actuated_joints_hold_the_values_asked_for(engine, some):
    state = engine.solve(some.program, some.e, some.q, some.home)
    assert_array_equal(driven(some.program, state), some.q)


def test_the_platform_moves_in_its_freedoms_only(engine, some):
    state = engine.solve(some.program, some.e, some.q, some.home)
    others = [i for i in range(6) if i not in some.program.freedoms]
    assert_allclose(
        geometry.pose_difference(state.T, np.broadcast_to(some.home.T, state.T.shape))[..., others],
        0.0,
        atol=1e-16,
    )


def test_a_converged_state_is_a_fixed_point(engine, some):
    state = engine.solve(some.program, some.e, some.q, some.home)
    again = engine.solve(some.program, some.e, some.q, state)
    assert_allclose(
        again.T, state.T, atol=2e-14
    )  # [1] and [m]: rounding times the condition of these robots
    assert again.iterations.max() <= 2


def test_free_joints_come_back_from_the_pose(engine):
    for robot in (zoo.mixed_hexapod(), zoo.hexapod()):
        one = case(robot)
        one = replace(
            one, q=one.home_q + 0.1 * (one.q - one.home_q)
        )  # near enough for the working mode of home
        state = engine.solve(one.program, one.e, one.q, one.home)
        task = pose_demand(state.T.reshape(-1, 4, 4), one.program.size)
        back = engine.solve(
            one.program, one.e, np.broadcast_to(one.home_q, one.q.shape), one.home, task, free=True
        )
        assert_array_equal(back.status, engine.CONVERGED)
        assert_allclose(
            driven(one.program, back), one.q, atol=1e-13
        )  # [m, rad] rounding times a condition near 10
        assert_allclose(back.T, state.T, atol=1e-14)


@pytest.mark.parametrize("robot", ["mixed_hexapod", "three_prs", "delta"])
def test_seven_trials_in_one_call_equal_seven_calls_bit_for_bit(engine, robot):
    some = case(getattr(zoo, robot)(), t=7)
    together = engine.solve(some.program, some.e, some.q, some.home)
    for i in range(7):
        alone = engine.solve(some.program, some.e[i : i + 1], some.q[i : i + 1], some.home)
        assert_same(rows_of(together, [i], slice(None)), alone)


def test_trials_that_share_readings_equal_trials_with_their_own(engine):
    some = case(zoo.mixed_hexapod(), t=3)
    shared = engine.solve(some.program, some.e, some.q[:1], some.home)
    own = engine.solve(some.program, some.e, np.repeat(some.q[:1], 3, axis=0), some.home)
    assert_same(shared, own)


def test_a_row_does_not_depend_on_its_neighbours_bit_for_bit(engine, some):
    together = engine.solve(some.program, some.e, some.q, some.home)
    for r in range(some.q.shape[1]):
        alone = engine.solve(some.program, some.e, some.q[:, [r]], some.home)
        assert_same(rows_of(together, [0], [r]), alone)


def test_the_order_of_rows_does_not_matter_bit_for_bit(engine, some):
    order = np.array([3, 1, 4, 0, 2])
    together = engine.solve(some.program, some.e, some.q, some.home)
    assert_same(
        rows_of(together, [0], order),
        engine.solve(some.program, some.e, some.q[:, order], some.home),
    )


def test_thousands_of_rows_equal_a_few_alone_bit_for_bit(engine):
    some = case(zoo.mixed_hexapod(), n=6000)
    together = engine.solve(some.program, some.e, some.q, some.home)
    for r in (0, 2047, 2048, 4095, 4096, 5999):
        assert_same(
            rows_of(together, [0], [r]),
            engine.solve(some.program, some.e, some.q[:, [r]], some.home),
        )


def test_failing_rows_are_marked_and_leave_the_others_alone(engine, some):
    bad = np.repeat(some.q, 2, axis=1)
    bad[:, 1, 0], bad[:, 3, -1], bad[:, 5, 0], bad[:, 7, :] = np.nan, np.inf, -np.inf, np.nan
    state = engine.solve(some.program, some.e, bad, some.home)
    assert_array_equal(state.status[0, [1, 3, 5, 7]], NOT_FINITE)
    good = [0, 2, 4, 6, 8, 9]
    assert_same(
        rows_of(state, [0], good), engine.solve(some.program, some.e, bad[:, good], some.home)
    )


def test_displacements_that_are_not_finite_mark_their_trial(engine):
    some = case(zoo.mixed_hexapod(), t=3)
    e = np.array(some.e)
    e[1, 5] = np.nan
    state = engine.solve(some.program, e, some.q, some.home)
    assert_array_equal(state.status[1], NOT_FINITE)
    assert_array_equal(state.status[[0, 2]], engine.CONVERGED)


def test_unreachable_rows_are_marked_with_the_gap_that_stays(engine, some):
    far = np.repeat(some.home_q, 4, axis=1)
    far += (
        np.where(np.arange(some.program.n_joints) == 0, 1.0, 0.0)
        * some.program.size
        * np.array([3.0, -3.0, 30.0, 1e6])[:, None]
    )
    state = engine.solve(some.program, some.e, far, some.home)
    if some.name in ("five-bar", "3-RRR"):  # a crank that turns by a metre of radians is somewhere
        assert np.isin(state.status, [engine.CONVERGED, STALLED, EXHAUSTED, NOT_FINITE]).all()
        return
    lost = state.status != engine.CONVERGED
    closed = open_by(some.program, state, some.e)
    assert (closed[~lost] <= CLOSED * some.program.size).all()
    assert lost[0, 2:].all()
    assert (state.residual[lost & np.isfinite(state.residual)] > 1e-6 * some.program.size).all()


def test_a_rod_of_no_length_is_not_an_exception(engine):
    some = case(zoo.hexapod())
    T = np.array(some.home.T)
    T[0, 0, :3, 3] = zoo.HEXAPOD_BASE[0] * zoo.MM - zoo.HEXAPOD_PLATFORM[0] * zoo.MM
    state = engine.solve(some.program, 0 * some.e, some.q, replace(some.home, T=T))
    assert_array_equal(state.status, NOT_FINITE)


def test_a_singular_start_is_not_an_exception(engine):
    # platform congruent to the base, all legs parallel: three freedoms are free
    base = zoo.HEXAPOD_BASE * zoo.MM
    some = case(zoo.gough("regular", base, 0.6 * base[[1, 0, 3, 2, 5, 4]], 0.3, 0.3))
    links = np.array(some.program.groups[0].links)
    links[:, 1] = links[:, 0]
    program = replace(some.program, groups=(replace(some.program.groups[0], links=links),))
    state = engine.solve(program, 0 * some.e, np.full((1, 2, 6), 0.01), some.home)
    assert state.status.shape == (1, 2)
    assert (state.status != engine.CONVERGED).all() or np.isfinite(state.T).all()


def test_too_few_steps_are_said(engine, some):
    state = engine.solve(some.program, some.e, some.q, some.home, max_iterations=1)
    assert_array_equal(state.status, EXHAUSTED)
    assert_array_equal(state.iterations, 1)


def test_arguments_are_left_alone(engine, some):
    e, q, T = np.array(some.e), np.array(some.q), np.array(some.home.T)
    engine.solve(some.program, some.e, some.q, some.home)
    assert_array_equal(some.e, e)
    assert_array_equal(some.q, q)
    assert_array_equal(some.home.T, T)


def test_orientation_changes_sign_with_the_mirrored_mode(engine):
    # a linear delta's nozzle above its carriages is the mirrored mode; between the two lies a
    # singularity
    some = case(zoo.delta())
    T = np.array(some.home.T)
    T[0, 0, 2, 3] += 2 * 0.24  # [m] from below to above the carriages
    above = engine.solve(some.program, some.e, some.q, replace(some.home, T=T))
    below = engine.solve(some.program, some.e, some.q, some.home)
    assert_array_equal(above.status, engine.CONVERGED)
    assert_array_equal(above.closure_sign, -below.closure_sign)


@pytest.mark.parametrize("seed", range(5))
def test_random_limbs_of_every_kind_close(engine, seed):
    robot = build(zoo.mixed_hexapod_assembly(seed))
    some = case(robot, n=4, seed=seed)
    small = some.home_q + 0.3 * (some.q - some.home_q)
    state = engine.solve(some.program, some.e, small, some.home)
    assert_array_equal(state.status, engine.CONVERGED)
    assert open_by(some.program, state, some.e).max() <= CLOSED * some.program.size


def test_slots_of_the_menagerie_cover_every_place_of_a_limb():
    program = zoo.mixed_hexapod().program
    assert {g.ending for g in program.groups} == {"rigid", "ball", "distance"}
    for group in program.groups:
        expected = {
            Slot(element, axis) for element in range(len(group.joints) + 2) for axis in range(6)
        }
        assert expected <= set(group.slots)
    assert (
        len(unit_of_displacements(program))
        == program.n_displacements
        == len(zoo.mixed_hexapod().parameters) - 12
    )


def test_four_threads_obtain_the_same_bits(engine, some):
    def run(_: int) -> tuple[np.ndarray, ...]:
        state = engine.solve(some.program, some.e, some.q, some.home)
        blocks = engine.linearize(some.program, some.e, some.q, state)
        arrays = [a for b in (*blocks.closure, *blocks.passive) for a in (b.U, b.A, b.E, b.Q)]
        return state.T, *state.joints, state.residual, state.status, *arrays

    alone = run(0)
    with ThreadPoolExecutor(4) as pool:
        for together in pool.map(run, range(8)):
            for a, b in zip(alone, together, strict=True):
                assert_array_equal(a, b)
