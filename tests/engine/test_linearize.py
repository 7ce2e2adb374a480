# SPDX-License-Identifier: Apache-2.0
"""Columns of `linearize` agree with central differences of the solver and with jax on an
independent closure.
"""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.engine import BASE, CONVERGED, PLATFORM, Group
from tests import zoo
from tests.engine.cases import (
    actuated_joint_values,
    dense_derivatives,
    displacement_units,
    homogeneous,
    limb_residual,
    make_case,
    measure_motion,
    pose_demand,
    rotation,
    unknown_joint_values,
)
from tests.jacobians import check_jacobian, compile_quickly

# [size per size]: closure of 1e-13 times a condition of some tens, over a step of some 1e-4
RESIDUAL = 3e-8

SCALE = 0.1  # [rad] and [size]: over this, the mechanisms bend noticeably


def jax_derivatives(case, state, row, free=False):
    """d (platform, unknown joints) / d (displacements, joint values) of one row by jax and a dense
    solution; as `slopes`.
    """
    p, m = case.program, len(case.program.freedoms)
    F, G, place = [], [], m
    n_unknown = m + unknown_joint_values(p, state, free).shape[-1]
    for group, joints in zip(p.groups, state.joints, strict=True):
        columns = np.arange(p.n_displacements)[group.columns].reshape(len(group.limbs), -1)
        unknown = group.unknown_joints(free)
        for k in range(len(group.limbs)):
            J = jax_limb_derivatives(p, group, k, state.T[0, row], joints[0, row, k], case.e[0])
            f, g = np.zeros((len(J), n_unknown)), np.zeros((len(J), p.n_displacements + p.n_joints))
            f[:, :m] = J[:, list(p.freedoms)]
            theta, own = np.split(J[:, 6:], [len(group.joints) + 1], axis=1)
            f[:, place : place + len(unknown)] = theta[:, unknown]
            place += len(unknown)
            g[:, columns[k]] = own
            for j, drives in enumerate(group.actuator):
                if drives[0] >= 0:
                    g[:, p.n_displacements + drives[k]] = theta[:, j]
            F.append(f)
            G.append(g)
    F, G = np.concatenate(F), np.concatenate(G)
    if not free:
        return -np.linalg.solve(F, G)
    return np.concatenate(
        [np.zeros((m, p.n_displacements)), -np.linalg.solve(F[:, m:], G[:, : p.n_displacements])]
    )


def jax_limb_derivatives(program, group, k, T, theta, e):
    """Rows of a limb against the platform's twist (6), its joints (J + 1) and its own
    displacements, by jax.
    """
    own = e[group.columns].reshape(len(group.limbs), -1)[k]
    derivative = compile_limb_derivative(
        group.joints, group.ending, group.rows, group.slots, program.size
    )
    numbers = group.links[k : k + 1], group.pitch[k : k + 1], group.length[k : k + 1]
    return np.asarray(derivative(np.concatenate([np.zeros(6), theta, own]), T, *numbers))


@cache
def compile_limb_derivative(letters, ending, chosen, slots, size):
    """Derivative of a limb's rows, compiled once for all limbs of a structure."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    count = len(letters) + 1

    def rows(v, T, links, pitch, length):
        limb = Group(
            (0,),
            letters,
            np.empty((0, 1), np.int64),
            (),
            ending,
            chosen,
            links,
            pitch,
            length,
            slots,
            slice(0),
            (BASE,),
            (PLATFORM,),
        )
        twist, joints, own = v[:6], v[6 : 6 + count], v[6 + count :]
        moved = homogeneous(jnp, rotation(jnp, twist[:3]) @ T[:3, :3], T[:3, 3] + twist[3:])
        return limb_residual(jnp, limb, 0, size, moved, joints, own)

    return compile_quickly(jax.jacfwd(rows))


@pytest.mark.slow
@pytest.mark.parametrize(
    "robot",
    ["mixed_hexapod"]
    + [
        pytest.param(name, marks=pytest.mark.evidence)
        for name in ("three_prs", "delta", "five_bar", "planar_rrr")
    ],
)
def test_derivatives_by_displacements_and_joints_agree_with_differences_and_jax(engine, robot):
    case = make_case(getattr(zoo, robot)(), n=2)
    p = case.program
    state = engine.solve(p, case.e, case.q, case.home)
    assert_array_equal(state.status, CONVERGED)
    analytic = dense_derivatives(p, engine.linearize(p, case.e, case.q, state))[0]
    s, a = p.n_displacements, p.n_joints
    turning = [
        g.actuator[j, k]
        for g in p.groups
        for j in range(len(g.joints))
        if g.joints[j] == "R"
        for k in range(len(g.limbs))
    ]
    unit = np.concatenate([displacement_units(p), np.full(a, p.size)])
    unit[[s + i for i in turning if i >= 0]] = 1.0
    moved = np.eye(s + a) * unit  # one trial a column, all moved by the same fraction of their unit

    def solved(x):
        e, q = case.e + x[0] * moved[:, :s], case.q + x[0] * moved[:, None, s:]
        return measure_motion(p, engine.solve(p, e, q, state), state)

    check_jacobian(
        solved,
        (analytic * unit).transpose(2, 0, 1)[..., None],
        np.zeros(1),
        scale=SCALE,
        atol=RESIDUAL * SCALE,
        atol_reason="closure of two states over the step",
    )
    for row in range(2):
        assert_close_columns(analytic[row], jax_derivatives(case, state, row), unit)


@pytest.mark.parametrize("robot", ["mixed_hexapod"])
def test_derivatives_of_free_actuators_agree_with_differences_and_jax(engine, robot):
    case = make_case(getattr(zoo, robot)(), n=2)
    p = case.program
    state = engine.solve(p, case.e, case.q, case.home)
    s, m = p.n_displacements, 6
    analytic = dense_derivatives(
        p, engine.linearize(p, case.e, case.q, state, free=True), free=True
    )[0][:, m:, m:]
    unit = displacement_units(p)
    moved = np.eye(s) * unit
    task = pose_demand(np.broadcast_to(state.T, (s, 2, 4, 4)).reshape(-1, 4, 4), p.size)

    def solved(x):
        back = engine.solve(
            p, case.e + x[0] * moved, actuated_joint_values(p, state), state, task, free=True
        )
        return measure_motion(p, back, state, free=True)[..., m:]

    check_jacobian(
        solved, (analytic * unit).transpose(2, 0, 1)[..., None], np.zeros(1), scale=SCALE,
        atol=RESIDUAL * SCALE, atol_reason="closure of two states over the step",
    )  # fmt: skip
    for row in range(2):
        assert_close_columns(analytic[row], jax_derivatives(case, state, row, free=True)[m:], unit)


def assert_close_columns(actual, reference, unit):
    """Assert that columns agree to rounding of the largest entry.

    Rounding is that of a few hundred operations times the condition.
    """
    assert_allclose(actual * unit, reference * unit, atol=1e-11 * np.abs(reference * unit).max())


def test_blocks_of_stacked_trials_equal_single_trials_bit_for_bit(engine):
    case = make_case(zoo.mixed_hexapod(), t=3)
    state = engine.solve(case.program, case.e, case.q, case.home)
    together = engine.linearize(case.program, case.e, case.q, state)
    for i in range(3):
        e, q = case.e[i : i + 1], case.q[i : i + 1]
        alone = engine.linearize(case.program, e, q, engine.solve(case.program, e, q, case.home))
        for kind in ("closure", "passive"):
            for mine, other in zip(getattr(together, kind), getattr(alone, kind), strict=True):
                for name in ("U", "A", "E", "Q"):
                    assert_array_equal(getattr(mine, name)[i], getattr(other, name)[0])


def test_failed_rows_do_not_change_blocks_of_other_rows(engine):
    case = make_case(zoo.mixed_hexapod())
    q = np.array(case.q)
    q[0, 2] = np.nan
    state = engine.solve(case.program, case.e, q, case.home)
    blocks = engine.linearize(case.program, case.e, q, state)
    clean = engine.linearize(
        case.program, case.e, case.q, engine.solve(case.program, case.e, case.q, case.home)
    )
    for mine, other in zip(blocks.closure, clean.closure, strict=True):
        assert_array_equal(mine.E[:, [0, 1, 3, 4]], other.E[:, [0, 1, 3, 4]])
