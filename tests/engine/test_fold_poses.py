# SPDX-License-Identifier: Apache-2.0
"""Rows of poses are folded as if their derivatives had been written and multiplied first."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from loopcal.engine import State
from tests.engine.cases import draw_twist_rows, make_pose_rows, take_pose_rows

ROBOTS = ["hexapod-42", "ru-pus-prs", "five-bar", "cable-4", "h4"]
"""Rods alone, limbs of every ending, three freedoms, and more actuators than freedoms."""


def write_rows(engine, arguments):
    """Return the rows (t, M, p + 1) of all kinds, with derivatives that are written."""
    *given, observed = arguments
    D, _ = engine.differentiate(*given)
    parts = []
    for rows in observed:
        columns = np.matmul(rows.by_twist, D[:, rows.poses])
        whole = np.concatenate([columns, rows.residual[..., None]], axis=-1)
        parts.append(whole.reshape(len(whole), -1, whole.shape[-1]))
    return np.concatenate(parts, axis=1)


def assert_same_gram(factor, rows):
    """Assert that R'R are those of the rows, their columns scaled to length 1."""
    scale = np.linalg.norm(rows, axis=1, keepdims=True)
    scale = np.where(scale > 0.0, scale, 1.0)
    R, A = factor / scale, rows / scale
    assert_array_equal(factor, np.triu(factor))
    # rounding of the derivatives times the condition of the robots
    assert_allclose(R.swapaxes(1, 2) @ R, A.swapaxes(1, 2) @ A, atol=1e-11)


def make_zeros(arguments, t):
    """Return factors of no rows."""
    width = arguments[4].pattern.parameters + 1
    return np.zeros((t, width, width))


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize(("t", "n"), [(1, 11), (3, 4), (11, 2)])
@pytest.mark.parametrize("per_trial", [False, True])
def test_the_factor_is_that_of_written_rows(engine, name, t, n, per_trial):
    arguments = make_pose_rows(engine, name, t, n, per_trial)
    factor, is_finite = engine.fold_poses(make_zeros(arguments, t), *arguments)
    assert is_finite.shape == (t, n)
    assert is_finite.all()
    rows = write_rows(engine, arguments)
    assert_same_gram(factor, rows)
    again, _ = engine.fold_poses(factor, *arguments)
    assert_same_gram(again, np.concatenate([rows, rows], axis=1))


@pytest.mark.parametrize(("name", "n"), [("hexapod-42", 3), ("five-bar", 200), ("six-bar", 200)])
def test_trials_equal_single_trials_bit_for_bit(engine, name, n):
    arguments = make_pose_rows(engine, name, 13, n)
    together, _ = engine.fold_poses(make_zeros(arguments, 13), *arguments)
    for i in (0, 7, 8, 12):
        alone = take_pose_rows(arguments, np.array([i]))
        assert_array_equal(together[i], engine.fold_poses(make_zeros(alone, 1), *alone)[0][0])
    some = take_pose_rows(arguments, np.arange(2, 9))
    assert_array_equal(together[2:9], engine.fold_poses(make_zeros(some, 7), *some)[0])


def test_one_state_can_stand_for_all_trials(engine):
    program, e, q, state, inputs, _ = make_pose_rows(engine, "hexapod-42", 1, 6, False)
    observed = draw_twist_rows(9, 6)
    arguments = program, e, q, state, inputs, observed
    factor, is_finite = engine.fold_poses(make_zeros(arguments, 9), *arguments)
    assert is_finite.shape == (9, 6)
    one = np.zeros(9, dtype=int)
    each = take_pose_rows((program, e, q, state, inputs, draw_twist_rows(1, 6)), one)
    expected, _ = engine.fold_poses(make_zeros(arguments, 9), *each[:5], observed)
    assert_array_equal(factor, expected)


@pytest.mark.parametrize("t", [1, 9])
def test_poses_with_infinite_derivatives_are_named_and_have_no_rows(engine, t):
    arguments = make_pose_rows(engine, "hexapod-42", t, 5)
    program, e, q, state, inputs, observed = arguments
    T = state.T.copy()
    T[-1, 2] = np.nan
    lost: State = replace(state, T=T)
    factor, is_finite = engine.fold_poses(
        make_zeros(arguments, t), program, e, q, lost, inputs, observed
    )
    expected = np.ones((t, 5), dtype=bool)
    expected[-1, 2] = False
    assert_array_equal(is_finite, expected)
    rows = write_rows(engine, arguments)
    poses = np.concatenate([np.repeat(o.poses, o.residual.shape[2]) for o in observed])
    rows[-1, poses == 2] = 0.0
    assert_same_gram(factor, rows)


def test_nothing_is_folded_without_rows_poses_and_trials(engine):
    arguments = make_pose_rows(engine, "five-bar", 2, 3)
    start = np.triu(np.random.default_rng(1).normal(size=make_zeros(arguments, 2).shape))
    none = [replace(o, poses=o.poses[:0], by_twist=o.by_twist[:, :0], residual=o.residual[:, :0])
            for o in arguments[5]]  # fmt: skip
    for observed in (none, []):
        factor, is_finite = engine.fold_poses(start, *arguments[:5], observed)
        assert_allclose(np.abs(factor), np.abs(start), rtol=1e-13)
        assert is_finite.all()
