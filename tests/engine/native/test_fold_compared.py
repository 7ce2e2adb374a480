# SPDX-License-Identifier: Apache-2.0
"""One call gives what solving, comparing, folding and full steps give one after the other."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import loopcal as lc
from benchmarks.peers.__main__ import make_cases
from loopcal import engine as api
from loopcal.engine import ComparedPoses, Steps, TwistRows
from loopcal.estimate import pose_rows
from loopcal.numerics.trial_batch import map_arrays
from tests.engine.cases import draw_map
from tests.engine.native.instruction_sets import list_arrays, make_engines, make_robot_case
from tests.engine.test_compare_poses import draw_poses

ENGINES = list(make_engines().values())
HEIGHTS = (6, 3, 1)
NAMES = ("hexapod-42", "linear-delta", "3-rrr", "6-rus", "tricept")


def draw_measured(n: int, height: int) -> ComparedPoses:
    """Draw measurements of two poses of three, with whiteners that mix the components."""
    rng, poses = np.random.default_rng(height), np.flatnonzero(np.arange(n) % 3)
    reference = draw_poses(0.4, 1, len(poses))[1][0]
    return ComparedPoses(poses, reference, rng.normal(size=(len(poses), height, 6)))


def make_arguments(name: str, n: int):
    """Return the arguments of `fold_compared` between the factor and the measured poses."""
    case = make_robot_case(name, 1, n)
    start = map_arrays(lambda a: np.broadcast_to(a, (1, n, *a.shape[2:])), case.home)
    return case.program, case.e, case.q, start, draw_map(case.program, (1, n), False)


def stay(p: int) -> Steps:
    """Return no step from a deviation of p parameters; any residual of closure is accepted."""
    return Steps(np.zeros(p), np.zeros((0, p)))


def record_steps(case, engine, monkeypatch) -> list:
    """Return the arguments and the result of each call of an engine in a fit of a peers' case."""
    calls = []

    def fold_compared(*arguments):
        calls.append((arguments, engine.fold_compared(*arguments)))
        return calls[-1][1]

    monkeypatch.setattr(pose_rows.engine, "fold_compared", fold_compared)
    lc.identify(case.robot, case.data, lc.LeastSquares())
    return calls


@pytest.mark.parametrize("engine", ENGINES, ids=str)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("height", HEIGHTS)
def test_one_call_gives_what_three_give(engine, name, height):
    arguments, n = make_arguments(name, 21), 21
    program, e, q, start, inputs = arguments
    measured, p = draw_measured(n, height), inputs.pattern.parameters
    factor = np.triu(np.random.default_rng(1).normal(size=(1, p + 1, p + 1)))
    done = engine.fold_compared(factor, *arguments, measured, stay(p))
    state, folded, is_finite = done[:3]
    alone = engine.solve(program, e, q, start)
    for ours, theirs in zip(list_arrays(state).values(), list_arrays(alone).values(), strict=True):
        assert_array_equal(ours, theirs)
    residual, slopes = engine.compare_poses(alone.T[:, measured.poses], measured.reference[None])
    # the sums of the library, in its order
    white = np.zeros((len(measured.poses), height, 7))
    for j in range(6):
        both = np.concatenate([slopes[0, :, j], residual[0, :, j, None]], axis=1)
        white = white + measured.whitener[:, :, j, None] * both[:, None]
    rows = TwistRows(measured.poses, white[None, ..., :6], white[None, ..., 6])
    expected, known = engine.fold_poses(factor, program, e, q, alone, inputs, [rows])
    assert_array_equal(folded, expected)
    assert_array_equal(is_finite, known)


@pytest.mark.parametrize("name", NAMES)
def test_all_instruction_sets_give_the_same_bits(name):
    arguments, measured = make_arguments(name, 21), draw_measured(21, 6)
    p = arguments[4].pattern.parameters
    factor = np.zeros((1, p + 1, p + 1))
    calls = [e.fold_compared for e in ENGINES if e.fold_compared is not None]
    assert len(calls) == len(ENGINES)
    results = [fold(factor, *arguments, measured, stay(p)) for fold in calls]
    first, *others = ([*list_arrays(r[0]).values(), *r[1:3]] for r in results)
    for other in others:
        for ours, theirs in zip(first, other, strict=True):
            assert_array_equal(ours, theirs)


@pytest.mark.parametrize("engine", ENGINES, ids=str)
def test_measured_poses_of_wrong_shapes_are_refused(engine):
    arguments, measured = make_arguments("hexapod-42", 9), draw_measured(9, 6)
    p = arguments[4].pattern.parameters
    factor, white = np.zeros((1, p + 1, p + 1)), measured.whitener
    wrong = [
        ComparedPoses(measured.poses + 1, measured.reference, white),
        ComparedPoses(measured.poses - 2, measured.reference, white),
        ComparedPoses(measured.poses[::-1], measured.reference, white),
        ComparedPoses(measured.poses, measured.reference[:, :9], white),
        ComparedPoses(measured.poses, measured.reference[1:], white),
        ComparedPoses(measured.poses, measured.reference, white[..., :5]),
    ]
    for one in wrong:
        with pytest.raises(ValueError, match="poses"):
            engine.fold_compared(factor, *arguments, one, stay(p))
    with pytest.raises(ValueError, match="factor"):
        engine.fold_compared(factor[:, :-1], *arguments, measured, stay(p))
    for steps in (stay(p - 1), stay(p)._replace(penalty=np.eye(p + 1))):
        with pytest.raises(ValueError, match="penalty"):
            engine.fold_compared(factor, *arguments, measured, steps)


def test_a_measured_pose_gives_a_residual_of_zero_at_itself():
    program, e, q, start, inputs = make_arguments("hexapod-42", 9)
    T = api.solve(program, e, q, start).T[0]
    reference = np.concatenate([T[:, :3, :3].reshape(9, 9), T[:, :3, 3]], axis=1)
    whitener = np.broadcast_to(np.eye(6), (9, 6, 6))
    p = inputs.pattern.parameters
    for engine in ENGINES:
        measured = ComparedPoses(np.arange(9), reference, whitener)
        zeros = np.zeros((1, p + 1, p + 1))
        assert engine.fold_compared is not None
        given = program, e, q, start, inputs, measured, stay(p)
        factor = engine.fold_compared(zeros, *given).factor
        assert_allclose(factor[0, :, p], 0.0, atol=1e-14)  # [rad, m]: rounding of poses


@pytest.mark.parametrize("key", ["hexapod", "delta"])
def test_steps_have_the_same_bits_for_every_instruction_set(key, monkeypatch):
    case = make_cases()[key]
    (first, *_), *others = (record_steps(case, engine, monkeypatch) for engine in ENGINES)
    assert len(first[1].costs) > 2  # a hexapod takes two steps and a delta three
    for other, *_ in others:
        for ours, theirs in zip(first[1][1:], other[1][1:], strict=True):
            assert_array_equal(ours, theirs)
        for name, array in list_arrays(first[1].state).items():
            assert_array_equal(array, list_arrays(other[1].state)[name])


FROM = (("hexapod", 0.1, 3), ("hexapod", 600.0, 5), ("delta", 0.1, 3), ("delta", 70.0, 4))
"""Starts, in tolerances and with the seed of their direction. From the far ones the engine refuses
a step behind the first, and the descent goes on with damping."""


@pytest.mark.parametrize(("key", "far", "seed"), FROM)
@pytest.mark.parametrize("method", [lc.LeastSquares(), lc.MAP(), lc.Ridge(2.0)], ids=repr)
def test_steps_of_the_engine_are_those_of_the_descent(key, far, seed, method, monkeypatch):
    case = make_cases()[key]
    free = case.robot.parameters.free
    start = case.robot.values.copy()
    start[free] += far * np.random.default_rng(seed).normal(size=free.sum()) * case.unit
    options = lc.FitOptions(start=start)
    fit = lc.identify(case.robot, case.data, method, options=options)
    monkeypatch.setattr(pose_rows.engine, "fold_compared", lambda *_: None)
    other = lc.identify(case.robot, case.data, method, options=options)
    assert fit.history.iterations == other.history.iterations
    assert fit.history.status == other.history.status
    assert_allclose(fit.history.cost, other.history.cost, rtol=1e-6)
    # 1e-9 standard deviations: rounding of rows at 1e-16 of the size of the robot
    sd = fit.standard_deviations.min()
    assert_allclose(fit.estimate, other.estimate, rtol=0, atol=1e-9 * sd)


def test_an_error_of_the_map_passes_through_the_engine(monkeypatch):
    case = make_cases()["delta"]
    (arguments, _), *_ = record_steps(case, ENGINES[0], monkeypatch)

    def fail(_):
        raise KeyError("no map")

    steps = arguments[-1]._replace(move=fail)
    fold_compared = ENGINES[0].fold_compared
    assert fold_compared is not None
    with pytest.raises(KeyError, match="no map"):
        fold_compared(*arguments[:-1], steps)


@pytest.mark.parametrize("key", ["hexapod", "delta"])
def test_a_fit_of_exact_poses_needs_no_other_call(key, monkeypatch):
    case = make_cases()[key]
    expected = lc.identify(case.robot, case.data, lc.LeastSquares())
    monkeypatch.setattr(pose_rows, "fold_pose_rows", None)
    fit = lc.identify(case.robot, case.data, lc.LeastSquares())
    assert_array_equal(fit.estimate, expected.estimate)


@pytest.mark.parametrize("key", ["hexapod", "delta"])
def test_a_fit_by_one_call_is_that_by_three(key, monkeypatch):
    case = make_cases()[key]
    fit = lc.identify(case.robot, case.data, lc.LeastSquares())
    monkeypatch.setattr(pose_rows.engine, "fold_compared", lambda *_: None)
    other = lc.identify(case.robot, case.data, lc.LeastSquares())
    # 1e-11 standard deviations: rounding of whitened rows
    assert_allclose(
        fit.estimate, other.estimate, rtol=0, atol=1e-11 * fit.standard_deviations.min()
    )
