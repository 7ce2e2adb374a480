# SPDX-License-Identifier: Apache-2.0
"""Rows of states: pick some, put them back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from loopcal.engine import Program, State
from loopcal.typing import FloatArray


def _each(make: Callable[..., np.ndarray], *states: State) -> State:
    """A state whose every array is made from the arrays of the given states."""
    found = {}
    for f in fields(State):
        parts = [getattr(s, f.name) for s in states]
        found[f.name] = (
            tuple(make(*g) for g in zip(*parts, strict=True))
            if f.name == "joints"
            else make(*parts)
        )
    return State(**found)


def select_rows(state: State, shape: tuple[int, int], trial: np.ndarray, pose: np.ndarray) -> State:
    """Rows (trial, pose) of a state that broadcasts to `shape` = (t, n), as (rows, 1)."""
    return _each(lambda a: np.broadcast_to(a, (*shape, *a.shape[2:]))[trial, pose][:, None], state)


def select_poses(state: State, rows: np.ndarray) -> State:
    """Poses `rows` (positions or a mask) of a state (t, n), every trial."""
    return _each(lambda a: a[:, rows], state)


def join_states(*parts: State) -> State:
    """States (t, n_i) one after the other, (t, sum n_i)."""
    return _each(lambda *arrays: np.concatenate(arrays, axis=1), *parts)


def replace_rows(state: State, trial: np.ndarray, pose: np.ndarray, new: State) -> State:
    """A copy of a state (t, n) whose rows (trial, pose) are those of `new` (rows, 1)."""

    def replaced(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        out = np.array(a)
        out[trial, pose] = b[:, 0]
        return out

    return _each(replaced, state, new)


def driven_values(program: Program, state: State) -> FloatArray:
    """Values of the actuated joints (t, n, a) [m or rad]."""
    out = np.zeros((*state.T.shape[:2], program.n_joints))
    for group, joints in zip(program.groups, state.joints, strict=True):
        for j, columns in enumerate(group.actuator):
            if columns[0] >= 0:
                out[..., columns] = joints[..., j]
    return out
