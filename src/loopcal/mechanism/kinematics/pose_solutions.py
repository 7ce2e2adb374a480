# SPDX-License-Identifier: Apache-2.0
"""Forward and inverse kinematics and the Jacobian of a robot, with a status for every row.

A full pose that a machine with fewer freedoms cannot take is projected (`nearest_pose`). Source:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal import geometry
from loopcal.engine import State
from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.closure.limb_rows import name_passive_joints
from loopcal.mechanism.kinematics.batch_kinematics import compute_readings, forward_trials
from loopcal.mechanism.kinematics.solution_modes import reach_coordinates, solve_in_mode
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import read_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status, is_closed, select_poses
from loopcal.presentation import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SI_SYMBOLS

COMPROMISE = 1e-9
"""Residual [m] of a converged row above which its redundant readings contradict each other."""
ROTATION = 1e-6
"""Largest deviation of R'R from the identity: the rounding of a file with seven digits."""


@dataclass(frozen=True, eq=False, repr=False)
class Solution(TableResult):
    """Poses and joints of n rows.

    Attributes
    ----------
    T : (n, 4, 4) platform in base [m]. q : (n, a) readings [m or rad].
    passive : (n, j) passive joint values, limb by limb [m or rad]; `passive_names` names them.
    status : (n,) members of Status. residual : (n,) closure residual [m]. iterations : (n,) Newton
        steps. state : the same rows for the engine.
    """

    T: FloatArray
    q: FloatArray
    passive: FloatArray
    passive_names: tuple[str, ...]
    status: NDArray[np.int8]
    residual: FloatArray
    iterations: IntArray
    state: State

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        """Return counts, the largest residual and the reason of the first failure."""
        failed = np.flatnonzero(~self.converged)
        gap = self.residual[self.converged].max(initial=0.0)
        text = f"<Solution: {len(self) - len(failed)} of {len(self)} rows closed"
        if len(failed) < len(self):
            text += f", residual at most {Quantity(float(gap) * 1e3, 'mm')}"
        if len(failed):
            text += f"; row {failed[0]}: {self.explain(int(failed[0]))}"
        return text + ">"

    @property
    def converged(self) -> BoolArray:
        """Rows (n,) that are closed in the mode of the start."""
        return self.status == Status.CONVERGED

    @property
    def closed(self) -> BoolArray:
        """Rows (n,) that are closed in whatever mode."""
        return is_closed(self.status)

    def take(self, rows: NDArray[Any]) -> Solution:
        """Return these rows, by position or by a mask (n,)."""
        chosen = {
            name: getattr(self, name)[rows]
            for name in ("T", "q", "passive", "status", "residual", "iterations")
        }
        return replace(self, **chosen, state=select_poses(self.state, rows))

    def explain(self, row: int) -> Finding:
        """Return how a row ended."""
        status, gap = Status(int(self.status[row])), float(self.residual[row])
        code = status.code
        if status == Status.CONVERGED and gap > COMPROMISE:
            code = "kinematics.compromise"
        elif status == Status.NOT_CONVERGED and gap <= COMPROMISE:
            code = "kinematics.not-nearest"
        return report_finding(
            code, row=row, gap=Quantity(gap * 1e3, "mm"), iterations=int(self.iterations[row])
        )


def forward(robot: Mechanism, q: ArrayLike, start: Solution | None = None) -> Solution:
    """Solve forward kinematics by Newton's method on the loop closure, beginning at `start`.

    Parameters
    ----------
    q : (n, a) readings [m or rad], or (n, 2 a) with their directions of approach (+1, -1, 0
        unknown) behind them.
    start : a solution of one row or n rows that selects the assembly mode (default: home).

    Returns
    -------
    Solution; rows that fail are marked in `status`, never raised.

    Raises
    ------
    DataError
        Another number of columns than the robot has actuators.
    """
    a = len(robot.actuators)
    readings = np.atleast_2d(np.asarray(q, dtype=float))
    if readings.ndim != 2 or readings.shape[1] not in (a, 2 * a):
        raise DataError(
            f"{readings.shape[-1]} readings a row were given, but {robot.name} has {a} actuators "
            f"({', '.join(actuator.name for actuator in robot.actuators)}); give one reading for "
            "each"
        )
    state = forward_trials(
        robot, robot.values[None], readings[None], None if start is None else start.state
    )
    return make_solution(robot, state, readings[:, :a])


def inverse(robot: Mechanism, target: ArrayLike, start: Solution | None = None) -> Solution:
    """Solve inverse kinematics: return the readings that lead to poses.

    Parameters
    ----------
    target : (n, 4, 4) platform in base, or (n, c) controlled coordinates in the order of
        `robot.controlled` [m, rad]. A pose that the machine has too few freedoms for is projected
        to the reachable pose that minimizes |log(R R_target')|^2 size^2 + |t - t_target|^2, with
        `robot.size`. The search begins at the controlled coordinates of the target; where no pose
        has these, the row is `UNREACHABLE`.
    start : solution that selects the working mode (default: home).

    Returns
    -------
    Solution; rows that fail are marked in `status`, never raised. A row is marked `OTHER_MODE`
    where the loops close at the target, but the readings lead from the start to another pose.

    Raises
    ------
    DataError
        Another shape, or a matrix that is not a pose.
    """
    begin = None if start is None else start.state
    c = len(robot.controlled)
    shapes = f"(n, 4, 4) poses or (n, {c}) coordinates ({', '.join(robot.controlled)})"
    wanted = np.asarray(target, dtype=float)
    values = robot.values[None]
    is_pose = wanted.ndim >= 2 and wanted.shape[-2:] == (4, 4)
    if wanted.ndim == 2 and c == 4 and is_pose:
        # one pose, or four targets in four coordinates
        is_pose = bool(np.array_equal(wanted[3], np.eye(4)[3]))
    if is_pose:
        T = wanted.reshape(-1, 4, 4)
        _check_poses(T)
        state = solve_in_mode(robot, partial(_reach_pose, robot), T, begin)
    elif wanted.ndim in (1, 2) and wanted.shape[-1] == c:
        coordinates = np.atleast_2d(wanted)
        state = solve_in_mode(robot, partial(reach_coordinates, robot), coordinates, begin)
    else:
        raise DataError(f"a target of shape {wanted.shape} was given; allowed are {shapes}")
    return make_solution(robot, state, compute_readings(robot, values, state)[0])


def make_solution(robot: Mechanism, state: State, q: FloatArray) -> Solution:
    """Return the solution of a state (1, n) with readings (n, a)."""
    names = name_passive_joints(robot)
    place, passive = {name: i for i, name in enumerate(names)}, np.zeros((len(q), len(names)))
    for group, joints in zip(robot.program.groups, state.joints, strict=True):
        for k, limb in enumerate(robot.assembly.limbs[i] for i in group.limbs):
            for j, joint in enumerate(limb.joints):
                column = place.get(f"{limb.name}.{joint.name}")
                if column is not None:
                    passive[:, column] = joints[0, :, k, j]
    return Solution(
        state.T[0],
        q,
        passive,
        names,
        state.status[0],
        state.residual[0],
        state.iterations[0],
        state,
    )


@dataclass(frozen=True, eq=False, repr=False)
class Jacobian(TableResult):
    """Derivatives of n poses in parameters and readings, labeled.

    The platform's twist has the rows `components`: rotation (rx, ry, rz) [rad] about base axes,
    then the translation (x, y, z) [m] of its origin.

    Attributes
    ----------
    parameters : (n, 6, p) per unit of each parameter. parameter_names : (p,) parameter_units : (p,)
        SI units, m, rad or 1.
    readings : (n, 6, a) per unit of each reading. reading_names : (a,) reading_units : (a,).
    solution : the poses.
    """

    parameters: FloatArray
    parameter_names: tuple[str, ...]
    parameter_units: tuple[str, ...]
    readings: FloatArray
    reading_names: tuple[str, ...]
    reading_units: tuple[str, ...]
    solution: Solution

    components = AXES

    def __repr__(self) -> str:
        n, p, a = len(self.parameters), len(self.parameter_names), len(self.reading_names)
        return (
            f"<Jacobian of {n} poses: parameters {(n, 6, p)}, readings {(n, 6, a)}; rows "
            f"{', '.join(self.components)} [rad, m] per unit of parameter or reading>"
        )

    def of(self, name: str) -> FloatArray:
        """Return the columns (n, 6) of one parameter or reading, by name."""
        for names, columns in (
            (self.parameter_names, self.parameters),
            (self.reading_names, self.readings),
        ):
            if name in names:
                return columns[..., names.index(name)]
        raise DataError(
            f"the Jacobian has no column {name!r}; its columns are the parameters of the robot and "
            f"the readings {', '.join(self.reading_names)}"
        )


def jacobian(robot: Mechanism, readings: ArrayLike, start: Solution | None = None) -> Jacobian:
    """Differentiate the poses at readings (n, a) in every parameter and reading.

    Parameters and raised errors as for `forward`. Rows that fail have NaN.
    """
    solution = forward(robot, readings, start)
    values, q = robot.values[None], np.atleast_2d(np.asarray(readings, dtype=np.float64))
    derivatives = differentiate_pose(robot, values, q[None], solution.state)  # with directions
    return Jacobian(
        derivatives.parameters[0],
        robot.parameters.names,
        tuple(SI_SYMBOLS[d] for d in robot.parameters.dimensions),
        derivatives.readings[0],
        tuple(a.name for a in robot.actuators),
        tuple(SI_SYMBOLS[a.dimension] for a in robot.actuators),
        solution,
    )


def _reach_pose(
    robot: Mechanism, T: FloatArray, start: State | None
) -> tuple[State, BoolArray | None]:
    """Return what `reach_coordinates` returns, for poses (n, 4, 4)."""
    from loopcal.mechanism.kinematics.nearest_pose import controls_all, find_nearest_reachable

    if controls_all(robot):
        return reach_coordinates(robot, read_coordinates(T, robot.controlled), start)
    return find_nearest_reachable(robot, robot.values[None], T[None], start), None


def _check_poses(T: FloatArray) -> None:
    """Refuse matrices that are not poses: name the first bad row and the reason."""
    # a row of NaN is marked in the solution, like readings that are NaN
    with np.errstate(invalid="ignore"):
        bent = geometry.measure_rotation_error(T[:, :3, :3]) > ROTATION
        bottom = np.abs(T[:, 3] - np.eye(4)[3]).max(axis=1) > ROTATION
    wrong = np.flatnonzero(np.isfinite(T).all(axis=(1, 2)) & (bent | bottom))
    if len(wrong):
        row = int(wrong[0])
        reason = (
            "its last row is not 0 0 0 1"
            if bottom[row]
            else "its upper left 3 x 3 is not a rotation (R'R = I, det +1)"
        )
        raise DataError(
            f"target {row} is not a valid pose: {reason}; give T_base_platform as (n, 4, 4) "
            "homogeneous matrices"
        )
