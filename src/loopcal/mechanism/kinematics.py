# SPDX-License-Identifier: Apache-2.0
"""Forward and inverse kinematics of any mechanism: one solution type, a status for every row."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.engine import State
from loopcal.errors import DataError
from loopcal.mechanism.batch_kinematics import compute_readings, forward_trials, inverse_trials
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.projection import find_nearest_reachable
from loopcal.mechanism.states import select_poses
from loopcal.typing import BoolArray, FloatArray, IntArray

APART = 1e-9
"""Gap [m] above which a converged row, which then has redundant readings, is not called closed."""


ROTATION = 1e-6
"""How far R'R may be from the identity: what a file with seven digits leaves."""


@dataclass(frozen=True, repr=False)
class Solution:
    """Poses and joints of n rows.

    Attributes
    ----------
    T : (n, 4, 4) platform in base [m]. q : (n, a) readings [m or rad].
    passive : (n, j) passive joint values, limb by limb [m or rad]; `passive_names` names them.
    status : (n,) members of Status. residual : (n,) closure residual [m]. iterations : (n,) Newton
        steps.
    """

    T: FloatArray
    q: FloatArray
    passive: FloatArray
    passive_names: tuple[str, ...]
    status: NDArray[np.int8]
    residual: FloatArray
    iterations: IntArray
    state: State

    def __repr__(self) -> str:
        lost = int((~self.converged).sum())
        first = f"; {self.explain(int(np.flatnonzero(~self.converged)[0]))}" if lost else ""
        gap = self.residual[self.converged].max(initial=0.0)
        return f"Solution of {len(self.q)} rows, {lost} not closed, the others to {gap * 1e3:.2g} mm{first}"

    @property
    def converged(self) -> BoolArray:
        """(n,) True where the loops are closed in the mode of the start."""
        return self.status == Status.CONVERGED

    def take(self, rows: NDArray[Any]) -> Solution:
        """These rows, by position or by a mask (n,)."""
        cut = {
            name: getattr(self, name)[rows]
            for name in ("T", "q", "passive", "status", "residual", "iterations")
        }
        return replace(self, **cut, state=select_poses(self.state, rows))

    def explain(self, row: int) -> str:
        """What became of a row, in a sentence."""
        status = Status(int(self.status[row]))
        apart = status == Status.CONVERGED and self.residual[row] > APART
        sentence = "as near as contradicting readings allow" if apart else status.sentence
        return f"row {row}: {sentence} ({self.residual[row] * 1e3:.3g} mm open after {self.iterations[row]} steps)"


def forward(robot: Mechanism, q: ArrayLike, start: Solution | None = None) -> Solution:
    """Poses that readings lead to, by Newton on the loop closure from `start` (default: home).

    Parameters
    ----------
    q : (n, a) readings [m or rad], or (n, 2 a) with their directions of approach (+1, -1, 0
        unknown) behind them.
    start : a solution of one row or n rows that chooses the assembly mode.

    Returns
    -------
    Solution; rows that fail are marked in `status`, never raised.

    Raises
    ------
    DataError
        q has another number of columns than the robot has actuators.
    """
    readings = np.atleast_2d(np.asarray(q, dtype=float))
    if readings.ndim != 2 or readings.shape[1] not in (
        len(robot.actuators),
        2 * len(robot.actuators),
    ):
        raise DataError(
            f"{readings.shape[-1]} readings a row were given, but {robot.name} has "
            f"{len(robot.actuators)} actuators "
            f"({', '.join(a.name for a in robot.actuators)})"
        )
    state = forward_trials(
        robot, robot.values[None], readings[None], None if start is None else start.state
    )
    return make_solution(robot, state, readings[:, : len(robot.actuators)])


def inverse(robot: Mechanism, target: ArrayLike, start: Solution | None = None) -> Solution:
    """Readings that lead to poses.

    Parameters
    ----------
    target : (n, 4, 4) platform in base, or (n, c) controlled coordinates in the order of
        `robot.controlled` [m, rad]. A pose that the machine has too few freedoms for is projected:
        of the reachable poses the one is taken that minimises |log(R R_target')|^2 size^2 + |t -
        t_target|^2, with `robot.size`.
    start : solution that chooses the working mode (default: home).

    Returns
    -------
    Solution; rows that fail are marked in `status`.

    Raises
    ------
    DataError
        The target has another shape.
    """
    wanted = np.asarray(target, dtype=float)
    c = len(robot.controlled)
    values, begin = robot.values[None], None if start is None else start.state
    if wanted.ndim >= 2 and wanted.shape[-2:] == (4, 4):
        T = wanted.reshape(-1, 4, 4)
        _check_poses(T)
        state = find_nearest_reachable(robot, values, T[None], begin)
    elif wanted.ndim in (1, 2) and wanted.shape[-1] == c:
        state = inverse_trials(robot, values, np.atleast_2d(wanted)[None], begin)
    else:
        raise DataError(
            f"a target of shape {wanted.shape} was given; allowed are (n, 4, 4) poses or (n, {c}) "
            "coordinates "
            f"({', '.join(robot.controlled)})"
        )
    return make_solution(robot, state, compute_readings(robot, values, state)[0])


def _check_poses(T: FloatArray) -> None:
    """Refuse matrices that are no pose: the first bad row and why."""
    R = T[:, :3, :3]
    finite = np.asarray(np.isfinite(T).all(axis=(1, 2)))
    turned = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2)) <= ROTATION
    proper = turned & (np.linalg.det(np.where(finite[:, None, None], R, np.eye(3))) > 0)
    bottom = np.abs(T[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1) <= ROTATION
    # a row of NaN is marked in the solution, like readings that are NaN
    wrong = np.flatnonzero(finite & ~(proper & bottom))
    if len(wrong):
        row = int(wrong[0])
        reason = (
            "its last row is not 0 0 0 1"
            if not bottom[row]
            else "its upper left 3 x 3 is not a rotation (R'R = I, det +1)"
        )
        raise DataError(
            f"target {row} is no pose: {reason}; give T_base_platform as (n, 4, 4) homogeneous "
            "matrices"
        )


def make_solution(robot: Mechanism, state: State, q: FloatArray) -> Solution:
    """The solution of a state (1, n) and its readings (n, a)."""
    names, columns = [], []
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        for k, limb in enumerate(group.limbs):
            for j, joint in enumerate(robot.assembly.limbs[limb].joints):
                if joint.actuator is None:
                    names.append((limb, f"{robot.assembly.limbs[limb].name}.{joint.name}"))
                    columns.append(joints[0, :, k, j])
    order = sorted(range(len(names)), key=lambda i: names[i][0])
    passive = np.stack([columns[i] for i in order], axis=-1) if order else np.zeros((len(q), 0))
    return Solution(
        state.T[0],
        q,
        passive,
        tuple(names[i][1] for i in order),
        state.status[0],
        state.residual[0],
        state.iterations[0],
        state,
    )
