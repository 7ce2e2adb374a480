# SPDX-License-Identifier: Apache-2.0
"""Engine states: their status, selection of rows, and the values of driven joints."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from loopcal.engine import Program, State
from loopcal.numerics.trial_batch import map_arrays
from loopcal.typing import BoolArray, FloatArray


class Status(IntEnum):
    """Status of a row of a solution; `code` names its entry in the catalog of findings.

    With arrays, use `value`: NumPy converts a member of an enumeration in ten times the time of a
    comparison.
    """

    CONVERGED = 0
    UNREACHABLE = 1
    NOT_CONVERGED = 2
    NOT_FINITE = 3
    OTHER_MODE = 4

    @property
    def code(self) -> str:
        """Return the code of the finding that explains this status."""
        return _CODES[self]


_CODES = {
    Status.CONVERGED: "kinematics.closed",
    Status.UNREACHABLE: "kinematics.unreachable",
    Status.NOT_CONVERGED: "kinematics.not-converged",
    Status.NOT_FINITE: "kinematics.not-finite",
    Status.OTHER_MODE: "kinematics.other-mode",
}


def is_closed(status: np.ndarray) -> BoolArray:
    """Return which rows close their loops, in whatever assembly mode."""
    return (status == Status.CONVERGED.value) | (status == Status.OTHER_MODE.value)


def make_start(
    T: FloatArray, joints: tuple[FloatArray, ...], others: tuple[FloatArray, ...] = ()
) -> State:
    """Return the state (t, n) of platforms, joints and other nodes where an iteration starts."""
    zero = np.zeros(T.shape[:2])
    none = zero.astype(np.int8)
    return State(T, joints, none, zero, zero.astype(np.int64), none, others)


def list_bodies(state: State) -> list[FloatArray]:
    """Return the poses of all bodies by their number: the platform, other nodes, the base last."""
    return [state.T, *state.others, np.eye(4)]


def select_poses(state: State, rows: np.ndarray) -> State:
    """Return poses `rows` (positions or a mask) of a state (t, n), all trials; it itself if these
    are all.
    """
    everywhere = True if rows.dtype == np.bool_ else np.arange(len(rows))
    is_whole = len(rows) == state.T.shape[1] and bool((rows == everywhere).all())
    return state if is_whole else map_arrays(lambda a: a[:, rows], state)


def without_poses(state: State, trials: int) -> State:
    """Return the arrays of a state for some trials and no pose."""
    return map_arrays(lambda a: np.zeros((trials, 0, *a.shape[2:]), a.dtype), state)


def join_states(*states: State) -> State:
    """Return states (t, n_i) one after the other, (t, sum n_i)."""
    return map_arrays(lambda *arrays: np.concatenate(arrays, axis=1), *states)


def replace_rows(state: State, trial: np.ndarray, pose: np.ndarray, new: State) -> State:
    """Return a state (t, n) whose rows (trial, pose) are those of `new` (rows, 1)."""

    def replaced(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        out = np.array(a)
        out[trial, pose] = b[:, 0]
        return out

    return map_arrays(replaced, state, new)


def put_poses(state: State, rows: np.ndarray, new: State) -> State:
    """Return a state (1, n) whose poses at rows (k,) are those of `new` (1, k)."""
    return replace_rows(state, np.zeros_like(rows), rows, map_arrays(lambda a: a[0, :, None], new))


def driven_values(program: Program, state: State) -> FloatArray:
    """Return the values of the actuated joints (t, n, a) [m or rad]."""
    return program.list_drives(state.joints)
