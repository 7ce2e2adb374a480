# SPDX-License-Identifier: Apache-2.0
"""The native engine agrees with the engine in NumPy on every shipped robot, and has the same bits
for every instruction set.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.engine import select_engine
from loopcal.io.robot.robot_file import load_robot
from loopcal.mechanism.platform_coordinates import read_coordinates, state_target
from tests.engine.cases import displacement_units, draw_map, draw_sums, make_pose_rows, pose_demand
from tests.engine.native.instruction_sets import list_arrays, make_engines, make_robot_case
from tests.engine.test_compare_poses import draw_poses
from tests.engine.test_triangles import make_systems
from tests.zoo import FEW_ROBOTS, ROBOTS

ENGINES = make_engines()
NATIVE, NUMPY = next(iter(ENGINES.values())), select_engine("numpy")

ROUNDING = 2e-14  # of a coordinate in sizes: rounding times the condition of these robots


def assert_same_bits(results):
    """Assert that results of several instruction sets are equal bit for bit."""
    first, *others = (list_arrays(result) for result in results)
    for other in others:
        for name, array in first.items():
            assert_array_equal(other[name], array, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 21), (5, 17), (9, 3)])
def test_states_agree_with_numpy_and_between_instruction_sets(name, t, n):
    case = make_robot_case(name, t, n)
    solved = [e.solve(case.program, case.e, case.q, case.home) for e in ENGINES.values()]
    expected, actual = NUMPY.solve(case.program, case.e, case.q, case.home), solved[0]
    for field in ("status", "iterations", "closure_sign"):
        assert_array_equal(getattr(actual, field), getattr(expected, field))
    scale = np.ones((4, 4))
    scale[:3, 3] = case.program.size
    assert_allclose(actual.T / scale, expected.T / scale, atol=ROUNDING)
    for mine, theirs in zip(actual.joints, expected.joints, strict=True):
        assert_allclose(mine, theirs, atol=ROUNDING * max(case.program.size, 1.0))
    assert_same_bits(solved)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 9), (5, 3)])
def test_states_at_sums_agree_with_numpy_and_between_instruction_sets(name, t, n):
    case = make_robot_case(name, t, n)
    start, sums = case.program.list_drives(case.home.joints), draw_sums(case)
    arguments = case.program, case.e, start, case.home, None, False, 60, None, sums
    expected, solved = NUMPY.solve(*arguments), [e.solve(*arguments) for e in ENGINES.values()]
    for field in ("status", "iterations", "closure_sign"):
        assert_array_equal(getattr(solved[0], field), getattr(expected, field))
    # [1] and [m]: rounding times the condition of these robots and of the weights
    assert_allclose(solved[0].T, expected.T, atol=1e-13)
    for mine, theirs in zip(solved[0].joints, expected.joints, strict=True):
        assert_allclose(mine, theirs, atol=1e-13)
    assert_same_bits(solved)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("free", [False, True])
def test_blocks_agree_with_numpy_and_between_instruction_sets(name, free):
    case = make_robot_case(name, 3, 5)
    state = NUMPY.solve(case.program, case.e, case.q, case.home)
    calls = [e.linearize(case.program, case.e, case.q, state, free) for e in ENGINES.values()]
    expected = NUMPY.linearize(case.program, case.e, case.q, state, free)
    atol = 1e-14 * max(a.max() for a in map(np.abs, list_arrays(expected).values()) if a.size)
    pairs = ((calls[0].closure, expected.closure), (calls[0].passive, expected.passive))
    for mine, theirs in (each for pair in pairs for each in zip(*pair, strict=True)):
        fields = [(getattr(mine, field), getattr(theirs, field)) for field in "UAEQ"]
        # a reflection of a column that begins with rounding has the sign of this rounding
        along = sum((a * b).sum(axis=-1, keepdims=True) for a, b in fields)
        for a, b in fields:
            assert_allclose(np.where(along < 0.0, -a, a), b, atol=atol)
    assert calls[0].joints == tuple(tuple(g.unknown_joints(free)) for g in case.program.groups)
    assert_same_bits(calls)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 21), (5, 17), (9, 3)])
@pytest.mark.parametrize("per_trial", [False, True])
def test_derivatives_agree_with_numpy_and_between_instruction_sets(name, t, n, per_trial):
    case = make_robot_case(name, t, n)
    state = NUMPY.solve(case.program, case.e, case.q, case.home)
    arguments = case.program, case.e, case.q, state, draw_map(case.program, (t, n), per_trial)
    calls = [e.differentiate(*arguments) for e in ENGINES.values()]
    for mine, theirs in zip(calls[0], NUMPY.differentiate(*arguments), strict=True):
        assert_allclose(mine, theirs, atol=1e-12 * np.abs(theirs).max())
    assert_same_bits(calls)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 21), (13, 5)])
def test_folded_poses_agree_with_numpy_and_between_instruction_sets(name, t, n):
    arguments = make_pose_rows(NUMPY, name, t, n)
    zeros = np.zeros((t, *(arguments[4].pattern.parameters + 1,) * 2))
    calls = [e.fold_poses(zeros, *arguments) for e in ENGINES.values()]
    expected, is_finite = NUMPY.fold_poses(zeros, *arguments)
    assert_array_equal(calls[0][1], is_finite)
    gram, known = (R.swapaxes(1, 2) @ R for R in (calls[0][0], expected))
    assert_allclose(gram, known, atol=1e-12 * np.abs(known).max())
    assert_same_bits(calls)


@pytest.mark.parametrize("name", ["hexapod-42", "6-pus", "3-rrr"])
def test_inverse_solutions_agree_with_numpy_and_between_instruction_sets(name):
    case = make_robot_case(name, 1, 2100)  # two chunks of rows that share a call of the task
    q = case.home_q + 0.1 * (case.q - case.home_q)
    reached = NUMPY.solve(case.program, case.e, q, case.home)
    whole = pose_demand(reached.T.reshape(-1, 4, 4), case.program.size)
    freedoms = list(case.program.freedoms)

    def task(T, rows):
        square = np.zeros((len(T), 4, 4))
        square[:, :3], square[:, 3, 3] = T, 1.0
        residual, slopes = whole(square, rows)
        return residual[:, freedoms], slopes[:, freedoms]

    guess = np.broadcast_to(case.home_q, q.shape)
    arguments = case.program, case.e, guess, case.home, task, True
    solved = [e.solve(*arguments) for e in ENGINES.values()]
    expected = NUMPY.solve(*arguments)
    assert_array_equal(solved[0].status, expected.status)
    for mine, theirs in zip(solved[0].joints, expected.joints, strict=True):
        assert_allclose(mine, theirs, atol=ROUNDING * max(case.program.size, 1.0))
    assert_same_bits(solved)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW_ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 21), (9, 3)])
def test_limbs_of_a_given_platform_agree_with_numpy_and_between_instruction_sets(name, t, n):
    case = make_robot_case(name, t, n)
    limbs = case.program.with_fixed_platform
    if any(len(g.unknown_joints(True)) > len(g.rows) for g in limbs.groups):
        pytest.skip("temperatures move joints of its limbs, which no platform determines")
    given = NUMPY.solve(case.program, case.e, case.q, case.home)
    given = replace(case.home, T=given.T)
    arguments = limbs, case.e, case.home_q, given, None, True
    solved = [e.solve(*arguments) for e in ENGINES.values()]
    expected = NUMPY.solve(*arguments)
    for field in ("T", "status", "iterations", "closure_sign"):
        assert_array_equal(getattr(solved[0], field), getattr(expected, field), err_msg=field)
    for mine, theirs in zip(solved[0].joints, expected.joints, strict=True):
        assert_allclose(mine, theirs, atol=ROUNDING * max(case.program.size, 1.0))
    assert_same_bits(solved)


@pytest.mark.parametrize("name", ["hexapod-42", "hexapod-nategh-agheli"])
@pytest.mark.parametrize(("t", "n"), [(1, 500), (7, 5)])
def test_proofs_agree_between_instruction_sets(name, t, n):
    case = make_robot_case(name, t, n)
    goal = NUMPY.solve(case.program, case.e, case.q, case.home)
    arguments = case.program, case.e, case.home, goal
    proven = [e.certify(*arguments) for e in ENGINES.values() if e.certify is not None]
    assert (proven[0] != 0).any()
    for other in proven[1:]:
        assert_array_equal(other, proven[0])


@pytest.mark.parametrize("name", ["hexapod-42", "hexapod-nategh-agheli", "linear-delta"])
@pytest.mark.parametrize(("t", "n"), [(1, 300), (7, 5)])
def test_reached_poses_agree_with_numpy_and_between_instruction_sets(name, t, n):
    robot, case = load_robot(name), make_robot_case(name, t, n)
    step = 0.1 * np.random.default_rng(n).uniform(-1, 1, (t, n, len(robot.controlled)))
    values = read_coordinates(robot.home, robot.controlled) + step
    target = state_target(values, robot.controlled, robot.home)
    arguments = case.program, case.e, target, case.home
    calls, expected = [e.reach(*arguments) for e in ENGINES.values()], NUMPY.reach(*arguments)
    assert_array_equal(calls[0].arrives, expected.arrives)
    assert expected.arrives.any()
    mine, theirs = list_arrays(calls[0]), list_arrays(expected)
    for field in ("status", "iterations", "closure_sign"):
        assert_array_equal(mine[field], theirs[field], err_msg=field)
    for field in ("T", "joints"):
        assert_allclose(mine[field], theirs[field], atol=2 * ROUNDING, err_msg=field)
    assert_same_bits(calls)


@pytest.mark.parametrize("columns", [1, 2, 7, 43])
@pytest.mark.parametrize("trials", [1, 3, 8, 13])
def test_factors_agree_with_numpy_and_between_instruction_sets(columns, trials):
    rng = np.random.default_rng(columns * trials)
    rows = rng.normal(size=(trials, 5 * columns + 3, columns))
    rows[:, : len(rows[0]) // 2, : columns // 2] = 0.0  # as rows of other parameters
    start = np.triu(rng.normal(size=(trials, columns, columns)))
    for factor in (np.zeros_like(start), start):
        folded = [e.fold(factor, rows) for e in ENGINES.values()]
        expected = NUMPY.fold(factor, rows)
        gram, known = (R.swapaxes(1, 2) @ R for R in (folded[0], expected))
        assert_allclose(gram, known, atol=1e-13 * np.abs(known).max())
        assert_array_equal(folded[0], np.triu(folded[0]))
        assert_same_bits(folded)
        alone = [ENGINES["baseline"].fold(factor[[i]], rows[[i]])[0] for i in range(trials)]
        assert_array_equal(folded[0], np.array(alone))


@pytest.mark.parametrize("rows", [32 * 7, 32 * 7 + 5, 1000])
def test_many_rows_are_folded_by_parts_with_the_same_bits(rows):
    rng = np.random.default_rng(rows)
    matrix, start = rng.normal(size=(9, rows, 7)), np.triu(rng.normal(size=(9, 7, 7)))
    folded = [e.fold(start, matrix) for e in ENGINES.values()]
    expected = start.swapaxes(1, 2) @ start + matrix.swapaxes(1, 2) @ matrix
    assert_allclose(folded[0].swapaxes(1, 2) @ folded[0], expected, atol=1e-13 * expected.max())
    assert_array_equal(folded[0], np.triu(folded[0]))
    assert_same_bits(folded)
    alone = [NATIVE.fold(start[[i]], matrix[[i]])[0] for i in range(9)]
    assert_array_equal(folded[0], np.array(alone))


@pytest.mark.parametrize("angle", [1e-9, 0.01, 0.7, 1.3, 2.0, 3.1])
def test_compared_poses_have_the_same_bits_for_every_instruction_set(angle):
    T, reference = draw_poses(angle)
    functions = [e.compare_poses for e in ENGINES.values() if e.compare_poses is not None]
    assert len(functions) == len(ENGINES)
    assert_same_bits([compare(T, reference) for compare in functions])


def test_triangular_systems_have_the_same_bits_for_every_instruction_set():
    triangle, right = make_systems(5, 42)
    functions = [e.solve_triangles for e in ENGINES.values() if e.solve_triangles is not None]
    assert len(functions) == len(ENGINES)
    assert_same_bits([solve(triangle, right) for solve in functions])


def test_bits_do_not_depend_on_which_rows_share_lanes():
    case = make_robot_case("ru-pus-prs", 11, 9)
    together = NATIVE.solve(case.program, case.e, case.q, case.home)
    for trial, pose in ((0, 0), (7, 8), (10, 3)):
        row = slice(trial, trial + 1), slice(pose, pose + 1)
        alone = NATIVE.solve(case.program, case.e[row[0]], case.q[row], case.home)
        assert_array_equal(alone.T[0, 0], together.T[trial, pose])
        own = replace(case.home, T=alone.T, joints=alone.joints)
        whole = NATIVE.linearize(case.program, case.e, case.q, together)
        part = NATIVE.linearize(case.program, case.e[row[0]], case.q[row], own)
        for mine, other in zip(part.closure, whole.closure, strict=True):
            assert_array_equal(mine.E[0, 0], other.E[trial, pose])
    for pose in range(2):  # lanes for trials in place of poses
        few = NATIVE.solve(case.program, case.e, case.q[:, pose : pose + 1], case.home)
        assert_array_equal(few.T[:, 0], together.T[:, pose])


@pytest.mark.parametrize(("t", "n"), [(1, 21), (5, 17), (9, 3)])
def test_rows_that_share_their_start_have_the_bits_of_rows_with_one_each(t, n):
    case = make_robot_case("hexapod-42", t, n)
    each = replace(case.home, T=np.repeat(case.home.T, n, axis=1))
    for engine in ENGINES.values():
        shared = engine.solve(case.program, case.e, case.q, case.home)
        assert_same_bits([shared, engine.solve(case.program, case.e, case.q, each)])


def test_angles_of_many_turns_are_those_of_few():
    case = make_robot_case("3-rrr", 1, 6)
    turned = case.q + 2 * np.pi * np.array([0.0, 1.0, -7.0, 1e3, -1e4, 1e5])[:, None]
    few = NATIVE.solve(case.program, case.e, case.q, case.home)
    many = NATIVE.solve(case.program, case.e, turned, case.home)
    allowed = 1e-15 * np.abs(turned).max(axis=2)[0] + 1e-14  # rounding of the angles
    assert (np.abs(many.T - few.T).max(axis=(0, 2, 3)) <= 10 * allowed).all()


def test_displacements_are_as_large_as_in_numpy():
    case = make_robot_case("ru-pus-prs", 40, 1)
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-12, -1, (40, 1))
    e = size * rng.normal(size=case.e.shape) * displacement_units(case.program)
    mine = NATIVE.linearize(
        case.program,
        e,
        case.q[:1],
        NATIVE.solve(case.program, e, case.q[:1], case.home, max_iterations=0),
    )
    state = NUMPY.solve(case.program, e, case.q[:1], case.home, max_iterations=0)
    theirs = list_arrays(NUMPY.linearize(case.program, e, case.q[:1], state))
    for name, array in list_arrays(mine).items():
        assert_allclose(array, theirs[name], atol=1e-13, err_msg=name)
