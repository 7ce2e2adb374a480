# SPDX-License-Identifier: Apache-2.0
"""Arrays of wrong shape are refused before the library reads them; any numbers are answered."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from loopcal.engine import (
    CONVERGED,
    NOT_FINITE,
    Engine,
    Program,
    Slot,
    State,
    Sums,
    Target,
    TwistRows,
)
from loopcal.errors import MissingPackageError
from tests.engine.cases import draw_map, draw_twist_rows, make_pose_rows
from tests.engine.native.instruction_sets import make_engines, make_robot_case
from tests.zoo import ROBOTS

NATIVE = next(iter(make_engines().values()))


def change_group(program: Program, **values) -> Program:
    """Return a program whose first group is changed."""
    return replace(program, groups=(replace(program.groups[0], **values), *program.groups[1:]))


CASE = make_robot_case("five-bar", 2, 3)
PROGRAM, E, Q, HOME = CASE.program, CASE.e, CASE.q, CASE.home
GROUP = PROGRAM.groups[0]
WRONG_CALLS = {
    "columns of e": (PROGRAM, E[:, 1:], Q, HOME),
    "trials of e": (PROGRAM, np.repeat(E, 2, axis=0), Q, HOME),
    "axes of e": (PROGRAM, E[0], Q, HOME),
    "columns of q": (PROGRAM, E, Q[..., :1], HOME),
    "trials of q": (PROGRAM, np.repeat(E[:1], 3, axis=0), Q, HOME),
    "axes of q": (PROGRAM, E, Q[0], HOME),
    "poses of the start": (PROGRAM, E, Q, replace(HOME, T=np.repeat(HOME.T, 2, axis=1))),
    "matrices of the start": (PROGRAM, E, Q, replace(HOME, T=HOME.T[..., :3, :])),
    "joints of the start": (PROGRAM, E, Q, replace(HOME, joints=(HOME.joints[0][..., :1],))),
    "groups of the start": (PROGRAM, E, Q, replace(HOME, joints=())),
    "other nodes": (PROGRAM, E, Q, replace(HOME, others=(HOME.T,))),
    "ends": (change_group(PROGRAM, to=(9,) * len(GROUP.to)), E, Q, HOME),
    "ending": (change_group(PROGRAM, ending="magnet"), E, Q, HOME),
    "rows": (change_group(PROGRAM, rows=(0, 3)), E, Q, HOME),
    "joints": (change_group(PROGRAM, joints="X"), E, Q, HOME),
    "links": (change_group(PROGRAM, links=GROUP.links[:, 1:]), E, Q, HOME),
    "actuator": (change_group(PROGRAM, actuator=GROUP.actuator + 9), E, Q, HOME),
    "slots": (change_group(PROGRAM, slots=(Slot(99, 0),) * len(GROUP.slots)), E, Q, HOME),
    "columns": (change_group(PROGRAM, columns=slice(0, 1)), E, Q, HOME),
}


@pytest.mark.parametrize(
    ("weights", "values"),
    [((1, 2, 3), (1, 3, 2)), ((3, 2, 2), (2, 3, 2)), ((1, 1, 2), (1, 3, 2)), ((1, 2, 2), (3, 2))],
)
def test_sums_of_wrong_shape_are_refused(weights, values):
    with pytest.raises(ValueError, match="sums"):
        NATIVE.solve(PROGRAM, E, Q, HOME, sums=Sums(np.ones(weights), np.ones(values)))


@pytest.mark.parametrize("what", WRONG_CALLS)
def test_arrays_of_wrong_shape_are_refused(what):
    with pytest.raises((ValueError, IndexError)):
        NATIVE.solve(*WRONG_CALLS[what])
    program, e, q, start = WRONG_CALLS[what]
    state = NATIVE.solve(PROGRAM, E, Q, HOME)
    if start is not HOME:
        state = start
    for function in (NATIVE.linearize, partial(NATIVE.differentiate, inputs=MAP)):
        with pytest.raises((ValueError, IndexError)):
            function(program, e, q, state)


MAP = draw_map(PROGRAM, (2, 3), True)
PATTERN = MAP.pattern
WRONG_MAPS = {
    "displacements": replace(MAP, displacements=MAP.displacements[:, 1:]),
    "trials of displacements": replace(MAP, displacements=np.repeat(MAP.displacements, 2, axis=0)),
    "joints": replace(MAP, joints=MAP.joints[0]),
    "functions": replace(MAP, basis=MAP.basis[..., :1]),
    "axes of the basis": replace(MAP, basis=MAP.basis[0]),
    "poses of the basis": replace(MAP, basis=MAP.basis[:, :2]),
    "readings": replace(MAP, readings=MAP.readings[..., :1]),
    "axes of the readings": replace(MAP, readings=MAP.readings[0, 0]),
    "parameters": replace(MAP, pattern=replace(PATTERN, parameters=1)),
    "negative parameters": replace(MAP, pattern=replace(PATTERN, parameters=-1)),
    "a huge count": replace(MAP, pattern=replace(PATTERN, parameters=2**40)),
    "places": replace(MAP, pattern=replace(PATTERN, displacements=PATTERN.displacements + 99)),
    "negative places": replace(MAP, pattern=replace(PATTERN, joints=PATTERN.joints - 1)),
    "axes of the pattern": replace(MAP, pattern=replace(PATTERN, joints=PATTERN.joints[:, :2])),
}


@pytest.mark.parametrize("what", WRONG_MAPS)
def test_maps_of_wrong_shape_are_refused(what):
    state = NATIVE.solve(PROGRAM, E, Q, HOME)
    with pytest.raises((ValueError, IndexError), match="the native engine expects"):
        NATIVE.differentiate(PROGRAM, E, Q, state, WRONG_MAPS[what])


RODS = make_robot_case("hexapod-42", 2, 3)
RODS_GOAL = NATIVE.solve(RODS.program, RODS.e, RODS.q, RODS.home)


@pytest.mark.parametrize(
    ("e", "start", "goal"),
    [
        (RODS.e[:, 1:], RODS.home.T, RODS_GOAL.T),
        (np.repeat(RODS.e, 2, axis=0), RODS.home.T, RODS_GOAL.T),
        (RODS.e[:0], RODS.home.T, RODS_GOAL.T),
        (RODS.e[:1], np.repeat(RODS.home.T, 2, axis=0), RODS_GOAL.T),
        (RODS.e, RODS.home.T[..., :3, :], RODS_GOAL.T),
        (RODS.e, RODS.home.T, RODS_GOAL.T[..., :3, :]),
    ],
)
def test_starts_and_goals_of_wrong_shape_are_refused(e, start, goal):
    begin, end = replace(RODS.home, T=start), replace(RODS_GOAL, T=goal)
    assert NATIVE.certify is not None
    with pytest.raises((ValueError, IndexError)):
        NATIVE.certify(RODS.program, e, begin, end)


TARGET = Target(np.zeros((2, 3, 6)), (0, 1, 2, 3, 4, 5), False, np.eye(4))
WRONG_TARGETS = {
    "axes of the values": (RODS.e, replace(TARGET, values=np.zeros((2, 6))), RODS.home),
    "trials of the values": (RODS.e, replace(TARGET, values=np.zeros((3, 3, 6))), RODS.home),
    "columns of the values": (RODS.e, replace(TARGET, values=np.zeros((2, 3, 5))), RODS.home),
    "number of columns": (RODS.e, replace(TARGET, columns=(0, 1, 2)), RODS.home),
    "base": (RODS.e, replace(TARGET, base=np.eye(3)), RODS.home),
    "columns of e": (RODS.e[:, 1:], TARGET, RODS.home),
    "trials of e": (np.repeat(RODS.e, 2, axis=0), TARGET, RODS.home),
    "start": (RODS.e, TARGET, replace(RODS.home, T=RODS.home.T[..., :3, :])),
    "sign": (RODS.e, TARGET, replace(RODS.home, closure_sign=np.ones((3, 2), np.int8))),
    "joints of the start": (RODS.e, TARGET, replace(RODS.home, joints=())),
}


@pytest.mark.parametrize("what", WRONG_TARGETS)
def test_targets_of_wrong_shape_are_refused(what):
    with pytest.raises((ValueError, IndexError)):
        NATIVE.reach(RODS.program, *WRONG_TARGETS[what])


@pytest.mark.parametrize(
    ("factor", "rows"),
    [
        ((2, 3, 4), (2, 5, 4)),
        ((2, 3, 3), (2, 5, 4)),
        ((2, 3, 3), (3, 5, 3)),
        ((3, 3), (5, 3)),
        ((2, 3, 3), (5, 3)),
    ],
)
def test_factors_of_wrong_shape_are_refused(factor, rows):
    with pytest.raises(ValueError, match="the native engine expects"):
        NATIVE.fold(np.zeros(factor), np.zeros(rows))


POSE_ROWS = make_pose_rows(NATIVE, "five-bar", 2, 3)
ROWS, OTHERS = POSE_ROWS[-1]
WRONG_ROWS = {
    "poses": replace(ROWS, poses=ROWS.poses + 1),
    "negative poses": replace(ROWS, poses=ROWS.poses - 1),
    "count of poses": replace(ROWS, poses=ROWS.poses[:-1]),
    "trials of derivatives": replace(ROWS, by_twist=np.repeat(ROWS.by_twist, 3, axis=0)),
    "columns of derivatives": replace(ROWS, by_twist=ROWS.by_twist[..., :5]),
    "rows of derivatives": replace(ROWS, by_twist=ROWS.by_twist[:, :, :5]),
    "trials of residuals": replace(ROWS, residual=np.repeat(ROWS.residual, 2, axis=0)),
    "axes of residuals": replace(ROWS, residual=ROWS.residual[0]),
}


@pytest.mark.parametrize("what", WRONG_ROWS)
@pytest.mark.parametrize("has_more", [False, True])
def test_rows_of_wrong_shape_are_refused(what, has_more):
    factor = np.zeros((2, *(POSE_ROWS[4].pattern.parameters + 1,) * 2))
    observed = [WRONG_ROWS[what], OTHERS][: 1 + has_more]
    with pytest.raises((ValueError, IndexError)):
        NATIVE.fold_poses(factor, *POSE_ROWS[:5], observed)


@pytest.mark.parametrize("shape", [(2, 3, 3), (3, 1, 1), (2, 3)])
def test_factors_of_poses_of_wrong_shape_are_refused(shape):
    with pytest.raises((ValueError, IndexError)):
        NATIVE.fold_poses(np.zeros(shape), *POSE_ROWS)


@pytest.mark.parametrize(
    ("triangle", "right"),
    [((2, 3, 3), (2, 4)), ((3, 3, 3), (2, 3)), ((2, 3, 4), (2, 3)), ((3, 3), (3,))],
)
def test_triangular_systems_of_wrong_shape_are_refused(triangle, right):
    assert NATIVE.solve_triangles is not None
    with pytest.raises(ValueError, match="the native engine expects"):
        NATIVE.solve_triangles(np.ones(triangle), np.ones(right))


@pytest.mark.parametrize(
    ("T", "reference"),
    [
        ((2, 3, 4, 4), (2, 3, 11)),
        ((2, 3, 4, 4), (3, 3, 12)),
        ((2, 3, 4, 4), (2, 4, 12)),
        ((2, 3, 3, 4), (2, 3, 12)),
        ((4, 4), (2, 3, 12)),
        ((2, 3, 4, 4), (12,)),
        ((0, 3, 4, 4), (2, 3, 12)),
    ],
)
def test_compared_poses_of_wrong_shape_are_refused(T, reference):
    assert NATIVE.compare_poses is not None
    with pytest.raises(ValueError, match="the native engine expects"):
        NATIVE.compare_poses(np.ones(T), np.ones(reference))


def test_nothing_is_solved_for_no_trials_no_poses_and_no_rows():
    assert NATIVE.solve(
        PROGRAM, E, Q[:, :0], replace(HOME, T=HOME.T[:, :0], joints=(HOME.joints[0][:, :0],))
    ).T.shape == (2, 0, 4, 4)
    assert NATIVE.fold(np.zeros((0, 3, 3)), np.zeros((0, 5, 3))).shape == (0, 3, 3)
    R = np.triu(np.random.default_rng(1).normal(size=(2, 3, 3)))
    assert_array_equal(NATIVE.fold(R, np.zeros((2, 0, 3))), R)
    assert NATIVE.fold(np.zeros((2, 0, 0)), np.zeros((2, 4, 0))).shape == (2, 0, 0)


def test_errors_of_a_task_reach_the_caller():
    def task(_T, _rows):
        raise KeyError("pose")

    for wrong in (task, lambda T, rows: (np.zeros((1, 2)), np.zeros((1, 2, 6))), lambda T, rows: 3):
        with pytest.raises((KeyError, ValueError, TypeError)):
            NATIVE.solve(PROGRAM, E, Q, HOME, wrong, free=True)


def test_an_instruction_set_that_the_processor_lacks_is_refused():
    from loopcal.engine import select_engine

    with pytest.raises(MissingPackageError, match="this processor has the instruction sets"):
        select_engine("native:v99")


def draw_any(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw numbers of every magnitude, infinities and NaN."""
    value = rng.normal(size=shape) * 10.0 ** rng.uniform(-320, 308, shape)
    special = np.array([0.0, -0.0, np.nan, np.inf, -np.inf, 1e-308, 1.7e308, 1.0, np.pi])
    return np.where(rng.uniform(size=shape) < 0.3, rng.choice(special, shape), value)


def disturb(rng: np.random.Generator, array: np.ndarray, share: float) -> np.ndarray:
    """Replace a share of the entries by any numbers."""
    return np.where(rng.uniform(size=array.shape) < share, draw_any(rng, array.shape), array)


def draw_rows(t: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw derivatives and residuals of the rows of one pose."""
    rows = draw_twist_rows(t, 1)[0]
    return np.repeat(rows.by_twist, t, axis=0), rows.residual


def check_any_numbers(native: Engine, name: str, rows: int, seed: int) -> int:
    """Solve, linearize and fold rows with wrong numbers; return how many were solved."""
    rng = np.random.default_rng(seed)
    case = make_robot_case(name, rows, 1)
    share = rng.choice([0.001, 0.02, 0.3, 1.0])
    start = State(
        disturb(rng, np.repeat(case.home.T, rows, axis=0), share / 10),
        tuple(disturb(rng, np.repeat(a, rows, axis=0), share / 10) for a in case.home.joints),
        case.home.status,
        case.home.residual,
        case.home.iterations,
        case.home.closure_sign,
        tuple(disturb(rng, np.repeat(a, rows, axis=0), share / 10) for a in case.home.others),
    )
    e, q = disturb(rng, case.e, share), disturb(rng, case.q, share)
    state = native.solve(case.program, e, q, start)
    closed = state.status == CONVERGED
    assert np.isfinite(state.T[closed]).all()
    assert set(np.unique(state.status)) <= {0, 1, 2, 3}
    assert native.certify is not None
    sign = native.certify(case.program, e, case.home, state)
    assert set(np.unique(sign)) <= {-1, 0, 1}
    target = Target(disturb(rng, np.zeros((rows, 2, 6)), share), tuple(range(6)), False, np.eye(4))
    reached = native.reach(case.program, e, target, case.home)
    assert not (reached.arrives & (reached.state.status != CONVERGED)).any()
    blocks = native.linearize(case.program, e, q, state)
    native.linearize(case.program, e, q, state, free=True)
    inputs = draw_map(case.program, (rows, 1), True)
    wrong = [disturb(rng, a, share) for a in (inputs.displacements, inputs.basis)]
    native.differentiate(
        case.program, e, q, state, replace(inputs, displacements=wrong[0], basis=wrong[1])
    )
    folded = TwistRows(np.zeros(1, int), *(disturb(rng, a[:, :1], share) for a in draw_rows(rows)))
    zeros = np.zeros((rows, *(inputs.pattern.parameters + 1,) * 2))
    native.fold_poses(zeros, case.program, e, q, state, inputs, [folded])
    largest = max((block.E for block in blocks.closure), key=np.size)
    matrix = largest.reshape(rows, -1, largest.shape[-1])
    factor = native.fold(np.zeros((rows, *matrix.shape[2:] * 2)), matrix)
    assert np.isfinite(
        factor[
            np.isfinite(matrix).all(axis=(1, 2))
            & (np.abs(matrix).max(axis=(1, 2), initial=0.0) < 1e100)
        ]
    ).all()
    return int(closed.sum())


@pytest.mark.parametrize("name", ROBOTS)
def test_any_numbers_are_answered(name):
    with np.errstate(all="ignore"):
        check_any_numbers(NATIVE, name, 300, 1)


def test_a_position_that_no_equation_contains_must_be_finite(engine):
    case = make_robot_case("agile-eye", 2, 1)  # the loops of a spherical machine leave it out
    T = np.repeat(case.home.T, 2, axis=0)
    T[1, 0, 0, 3] = np.inf
    joints = tuple(np.repeat(a, 2, axis=0) for a in case.home.joints)
    state = engine.solve(case.program, case.e, case.q, replace(case.home, T=T, joints=joints))
    assert state.status[:, 0].tolist() == [CONVERGED, NOT_FINITE]


@pytest.mark.evidence
@pytest.mark.parametrize("name", ROBOTS)
def test_a_million_wrong_inputs_are_answered(name):
    rows = 1000
    with np.errstate(all="ignore"):
        for seed in range(-(-1_000_000 // rows // len(ROBOTS))):
            check_any_numbers(NATIVE, name, rows, seed)
