# SPDX-License-Identifier: Apache-2.0
"""Derivatives of the platform agree with the blocks of `linearize` and with central differences of
the solver.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.engine import CONVERGED
from loopcal.geometry import pose_difference
from loopcal.io.robot.robot_file import load_robot
from tests.engine.cases import (
    Array,
    Case,
    displacement_units,
    draw_map,
    make_case,
    spread_map,
    stack_dense_rows,
)
from tests.jacobians import check_jacobian

# of the largest entry: rounding of a few hundred operations times the condition
ROUNDING = 1e-11


def derivatives_by_blocks(engine, case: Case, state, inputs) -> tuple[Array, Array]:
    """Return the derivatives (t, n, 6, p) and (t, n, 6, a) by the rows of `linearize`."""
    program = case.program
    blocks = engine.linearize(program, case.e, case.q, state)
    A, E, Q = stack_dense_rows(program, blocks.closure)
    if program.sigma is not None:
        drive = np.abs(Q).max(axis=-1)
        weight = 1.0 / (drive * np.array(program.sigma)[np.abs(Q).argmax(axis=-1)])
        A, E, Q = (rows * weight[..., None] for rows in (A, E, Q))
    of_e, of_q = spread_map(program, inputs, state.T.shape[:2])
    freedoms = list(program.freedoms)
    twists = []
    for right in (E @ of_e + Q @ of_q, Q * inputs.readings[:, :, None]):
        twist = np.zeros((*right.shape[:2], 6, right.shape[-1]))
        twist[:, :, freedoms] = -np.linalg.pinv(A) @ right
        twists.append(twist)
    return twists[0], twists[1]


def assert_agree(actual, expected):
    for mine, reference in zip(actual, expected, strict=True):
        assert_allclose(mine, reference, atol=ROUNDING * np.abs(reference).max())


@pytest.mark.parametrize("trials", [1, 3])
@pytest.mark.parametrize("per_trial", [False, True])
def test_derivatives_are_those_of_the_linearized_rows(engine, case, trials, per_trial):
    robot = make_case_of(case, trials)
    state = engine.solve(robot.program, robot.e, robot.q, robot.home)
    inputs = draw_map(robot.program, robot.q.shape[:2], per_trial)
    actual = engine.differentiate(robot.program, robot.e, robot.q, state, inputs)
    assert_agree(actual, derivatives_by_blocks(engine, robot, state, inputs))


def make_case_of(case: Case, trials: int) -> Case:
    """Return the case with displacements and joint values of several trials."""
    rng, p = np.random.default_rng(trials), case.program
    e = case.e * rng.uniform(0.5, 1.0, (trials, p.n_displacements))
    off = rng.uniform(0.5, 1.0, (trials, *case.q.shape[1:]))
    return replace(case, e=e, q=case.home_q + off * (case.q - case.home_q))


@pytest.mark.parametrize("name", ["cable-4", "ru-pus-prs", "rotary-delta"])
def test_redundant_and_mixed_limbs_of_shipped_robots_agree_with_the_rows(engine, name):
    case = make_case(load_robot(name), t=2, n=3)
    state = engine.solve(case.program, case.e, case.q, case.home)
    inputs = draw_map(case.program, case.q.shape[:2], True)
    actual = engine.differentiate(case.program, case.e, case.q, state, inputs)
    assert_agree(actual, derivatives_by_blocks(engine, case, state, inputs))


@pytest.mark.slow
def test_derivatives_agree_with_central_differences(engine, case):
    p, q = case.program, case.q[:, :2]
    state = engine.solve(p, case.e, q, case.home)
    assert_array_equal(state.status, CONVERGED)
    inputs = draw_map(p, q.shape[:2], False)
    of_e, of_q = spread_map(p, inputs, (1, 2))
    of_e = of_e[:, 0] * displacement_units(p)[:, None]  # one parameter moves many slots alike
    moved = np.ascontiguousarray(of_e[0].T), np.moveaxis(of_q[0], -1, 0)
    scaled = replace(
        inputs, displacements=inputs.displacements * displacement_units(p)[places_of(inputs)]
    )
    twist, _ = engine.differentiate(p, case.e, q, state, scaled)

    def solved(x):
        there = engine.solve(p, case.e + x[0] * moved[0], q + x[0] * moved[1], state)
        return pose_difference(there.T, np.broadcast_to(state.T, there.T.shape))[
            ..., list(p.freedoms)
        ]

    check_jacobian(
        solved, twist[0][:, list(p.freedoms)].transpose(2, 0, 1)[..., None], np.zeros(1),
        scale=0.01, atol=3e-9, atol_reason="closure of two states over the step",
    )  # fmt: skip


def places_of(inputs):
    """Return the displacement of each pair of a map."""
    return inputs.pattern.displacements[:, 0]


def test_a_trial_does_not_depend_on_the_others_bit_for_bit(engine, case):
    robot = make_case_of(case, 3)
    state = engine.solve(robot.program, robot.e, robot.q, robot.home)
    inputs = draw_map(robot.program, robot.q.shape[:2], True)
    together = engine.differentiate(robot.program, robot.e, robot.q, state, inputs)
    for i in range(3):
        one = slice(i, i + 1)
        own = replace(state, T=state.T[one], joints=tuple(a[one] for a in state.joints))
        part = replace(
            inputs,
            displacements=inputs.displacements[one],
            joints=inputs.joints[one],
            basis=inputs.basis[one],
            readings=inputs.readings[one],
        )
        alone = engine.differentiate(robot.program, robot.e[one], robot.q[one], own, part)
        for mine, whole in zip(alone, together, strict=True):
            assert_array_equal(mine[0], whole[i])


def test_singular_and_failed_poses_do_not_change_the_others(engine, case):
    state = engine.solve(case.program, case.e, case.q, case.home)
    inputs = draw_map(case.program, case.q.shape[:2], False)
    expected, _ = engine.differentiate(case.program, case.e, case.q, state, inputs)
    T = np.array(state.T)
    T[0, 1] = np.nan
    T[0, 3, :3, :3] = 0.0  # no direction determines the platform
    broken = replace(state, T=T)
    actual, _ = engine.differentiate(case.program, case.e, case.q, broken, inputs)
    assert not np.isfinite(actual[0, 1]).all()
    assert_array_equal(actual[0, [0, 2, 4]], expected[0, [0, 2, 4]])


def test_no_poses_and_no_parameters_give_empty_arrays(engine, case):
    none = replace(
        case.home, T=case.home.T[:, :0], joints=tuple(a[:, :0] for a in case.home.joints)
    )
    inputs = draw_map(case.program, (1, 1), False)
    by_parameter, _ = engine.differentiate(case.program, case.e, case.q[:, :0], none, inputs)
    assert by_parameter.shape == (1, 0, 6, inputs.pattern.parameters)
    empty = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
    inputs = replace(
        inputs,
        pattern=replace(inputs.pattern, parameters=0, displacements=empty[0], joints=empty[1]),
        displacements=np.zeros((1, 0)),
        joints=np.zeros((1, 0)),
    )
    state = engine.solve(case.program, case.e, case.q, case.home)
    by_parameter, by_reading = engine.differentiate(case.program, case.e, case.q, state, inputs)
    assert by_parameter.shape == (1, 5, 6, 0)
    assert np.isfinite(by_reading).all()
