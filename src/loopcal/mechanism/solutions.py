# SPDX-License-Identifier: Apache-2.0
"""Forward and inverse kinematics and the Jacobian of a robot, with a status for every row.

A full pose that a machine with fewer freedoms cannot take is projected (`nearest_pose`). Source:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal import engine, geometry
from loopcal.engine import NEAR_GOAL, State
from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism import kinematics
from loopcal.mechanism.assembly import AXES, TWIST_UNITS
from loopcal.mechanism.chains import split_stage_states
from loopcal.mechanism.inverse import (
    close_at_coordinates,
    controls_all,
    determine_platform,
    find_nearest_reachable,
    moves_by_drives,
)
from loopcal.mechanism.limb_rows import name_passive_joints
from loopcal.mechanism.model import Mechanism, describe_gap
from loopcal.mechanism.platform_coordinates import (
    POSITION,
    differentiate_coordinates,
    read_coordinates,
    state_target,
)
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.states import Status, driven_values, is_closed, put_poses, select_poses
from loopcal.numerics.trial_batch import map_arrays
from loopcal.results.description import Field, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import SI_SYMBOLS

# Number of Newton steps -> largest distance that they leave, per distance of the start.
CONTRACTION = {1: 1 / 2, 3: 1 / 8}
FIRST_STEP, GROWTH, SHORTEST = 0.25, 2.0, 1 / 500
"""First step of a path as a share of it, its growth after a safe step, and the shortest step.

A step that is not safe is divided by the square of the growth.
"""
TRIALS = 80  # most steps of a path, safe or not
ITERATIONS = 12  # newton steps of a step of a path: a safe one needs fewer
# Largest difference of equal joints and poses: lengths per size of the robot, angles [rad].
SAME_JOINTS = 1e-6

Step = Callable[[IntArray, FloatArray, State], State]
"""Returns states (1, j) at shares (j,) of the paths of rows (j,), from states on these paths."""


def contracts(robot: Mechanism, start: State, end: State) -> BoolArray:
    """Return which steps (n,) between states (1, n | 1) and (1, n) Newton's method makes safely."""
    e, _ = robot.present
    joints, whole = driven_values(robot.program, end), measure_distance(robot, start, end)
    rows, done = np.arange(len(whole)), 0
    safe, current = np.zeros(len(whole), bool), start
    for steps, share in CONTRACTION.items():
        if not len(rows):
            break
        q, count = joints[:, rows], steps - done
        current, done = engine.solve(robot.program, e, q, current, max_iterations=count), steps
        left = measure_distance(robot, current, select_poses(end, rows))
        near = left <= share * whole[rows] + SAME_JOINTS
        safe[rows[near]] = True
        rows, current = rows[~near], select_poses(current, ~near)
    return safe


def measure_distance(robot: Mechanism, a: State, b: State) -> FloatArray:
    """Return the largest difference (n,) of poses and joints of states (1, n | 1), per size."""
    largest = np.zeros(b.T.shape[1])
    for T, other in zip((a.T, *a.others), (b.T, *b.others), strict=True):
        gap = (T - other)[0]
        chord = np.linalg.norm(gap[:, :3, :3], axis=(1, 2)) / np.sqrt(8.0)  # sine of half the angle
        moved = np.abs(gap[:, :3, 3]).max(axis=1) / robot.size
        largest = np.maximum(largest, np.maximum(2.0 * np.arcsin(chord.clip(max=1.0)), moved))
    for group, mine, other in zip(robot.program.groups, a.joints, b.joints, strict=True):
        unit = np.array([1.0 if kind == "R" else robot.size for kind in f"{group.joints}P"])
        gap = np.abs(mine - other)[0] / unit
        largest = np.maximum(largest, gap.max(axis=(1, 2), initial=0.0))
    return largest


def repeat_poses(state: State, n: int) -> State:
    """Return a state (1, 1) or (1, n) as (1, n)."""
    return map_arrays(lambda a: np.broadcast_to(a, (1, n, *a.shape[2:])), state)


def _move_readings(robot: Mechanism, first: State, last: State) -> Step:
    """Return the steps along straight paths of joint values between states (1, k)."""
    e, _ = robot.present
    origin, target = driven_values(robot.program, first), driven_values(robot.program, last)

    def step(rows: IntArray, share: FloatArray, current: State) -> State:
        q = origin[:, rows] + (target - origin)[:, rows] * share[:, None]
        return engine.solve(robot.program, e, q, current, max_iterations=ITERATIONS)

    return step


def _move_poses(robot: Mechanism, first: State, last: State) -> Step:
    """Return the steps along straight paths of poses between states (1, k)."""
    values = robot.values[None]
    twist = geometry.pose_difference(last.T[0], first.T[0])

    def step(rows: IntArray, share: FloatArray, current: State) -> State:
        via = geometry.apply_twist(first.T[0, rows], share[:, None] * twist[rows])
        target = read_coordinates(via, robot.controlled)
        cheap = {"follow": False, "max_iterations": ITERATIONS}
        return close_at_coordinates(robot, values, target[None], current, **cheap)

    return step


def _follow_path(robot: Mechanism, first: State, step: Step) -> tuple[State, BoolArray]:
    """Return the states (1, k) that paths from `first` end at, and which (k,) are their ends.

    The length of a step adapts to each row.
    """
    current, n = first, first.T.shape[1]
    share, length = np.zeros(n), np.full(n, FIRST_STEP)
    for _ in range(TRIALS):
        rows = np.flatnonzero((share < 1.0) & (length >= SHORTEST))
        if not len(rows):
            break
        present, wanted = select_poses(current, rows), np.minimum(1.0, share[rows] + length[rows])
        following = step(rows, wanted, present)
        safe = following.status[0] == Status.CONVERGED
        safe[safe] = contracts(robot, select_poses(present, safe), select_poses(following, safe))
        share[rows] = np.where(safe, wanted, share[rows])
        length[rows] *= np.where(safe, GROWTH, GROWTH**-2)
        current = put_poses(current, rows[safe], select_poses(following, safe))
    return current, share >= 1.0


def _is_same_pose(robot: Mechanism, a: State, b: State, tolerance: float) -> BoolArray:
    """Return which platforms (n,) are equal to a tolerance: relative to the robot's size, [rad]."""
    gap = np.abs(geometry.pose_difference(a.T[0], b.T[0])) * robot.twist_scale
    return np.asarray(gap.max(axis=1, initial=0.0) <= tolerance * robot.size)


SAME_POSE = 1e-7
"""Largest difference of equal poses: lengths relative to the robot's size, angles in radians.

Rounding grows close to a singularity, up to the square root of the machine precision.
"""

Arrives = BoolArray | None
Solver = Callable[[FloatArray, State | None], tuple[State, Arrives]]
"""Solves inverse kinematics for targets (n, ..) from a start: states (1, n), and where the engine
tells, which of them their readings are known to lead to, see `reach_coordinates`."""


def solve_in_mode(
    robot: Mechanism, solve: Solver, target: FloatArray, start: State | None
) -> State:
    """Return inverse solutions (1, n) for targets (n, ..) in the mode of `start` (default: home).

    A row whose loops close in another mode only is marked `OTHER_MODE`.
    """
    begin = start or robot.home_state
    state, arrives = solve(target, start)
    state, is_other = judge_modes(robot, state, begin, arrives)
    rows = np.flatnonzero(is_other)
    if not len(rows):
        return state
    state = replace(state, status=np.where(is_other, np.int8(Status.OTHER_MODE), state.status))
    if has_one_solution(robot) or moves_by_drives(robot):  # which follows the path itself
        return state
    begin = select_poses(repeat_poses(begin, len(is_other)), rows)
    near, arrived = _follow_path(robot, begin, _move_poses(robot, begin, select_poses(state, rows)))
    begin, rows = select_poses(begin, arrived), rows[arrived]
    if not len(rows):
        return state
    again, _ = solve(target[rows], select_poses(near, arrived))
    again, still_other = judge_modes(robot, again, begin)
    good = (again.status[0] == Status.CONVERGED) & ~still_other
    return put_poses(state, rows[good], select_poses(again, good))


def has_one_solution(robot: Mechanism) -> bool:
    """Return whether a pose has one set of readings, whatever the start: those of driven rods."""
    if robot.stages or robot.program.others or not determine_platform(robot):
        return False
    return all(g.ending == "distance" and g.actuator[-1, 0] >= 0 for g in robot.program.groups)


def compute_bend(robot: Mechanism, state: State) -> NDArray[np.int8]:
    """Return the sign (n,) of the determinant of the limbs at their platform, every joint free: it
    changes where a limb is stretched or folded, from one working mode to another.
    """
    e, _ = robot.present
    limbs, joints = robot.program.with_fixed_platform, driven_values(robot.program, state)
    return engine.solve(limbs, e, joints, state, free=True, max_iterations=0).closure_sign[0]


def reach_coordinates(
    robot: Mechanism, target: FloatArray, start: State | None = None
) -> tuple[State, BoolArray | None]:
    """Solve inverse kinematics like `close_at_coordinates`, for coordinates (n, c).

    Return states (1, n), and the rows (n,) whose readings are known to lead from the start to their
    pose; where these are not None, the states have closure signs.
    """
    values, target = robot.values[None], target[None]
    is_plain = not (robot.is_serial or moves_by_drives(robot) or robot.program.idle_groups)
    if not (is_plain and robot.program.is_square and target.shape[1] and determine_platform(robot)):
        return close_at_coordinates(robot, values, target, start), None
    goal = state_target(target, robot.controlled, robot.home)
    reached = engine.reach(robot.program, robot.present[0], goal, start or robot.home_state)
    return reached.state, reached.arrives[0]


def judge_modes(
    robot: Mechanism, state: State, begin: State, arrives: Arrives = None, has_signs: bool = False
) -> tuple[State, BoolArray]:
    """Return a state (1, n) with closure signs, and its closed rows that `begin` does not lead to.

    arrives : as of `reach_coordinates`. The engine proves most rows. For the others the sign is
    computed, unless the state has it, and those of the right sign are solved by forward kinematics
    up to their pose.
    """
    if robot.stages:
        return _judge_stages(robot, state, begin)
    if robot.is_serial:
        return state, np.zeros(state.T.shape[1], bool)
    begin, n = kinematics.clear_sign(robot, begin), state.T.shape[1]
    closed = state.status[0] == Status.CONVERGED
    if arrives is not None:
        sign, is_sure = state.closure_sign[0], arrives
    else:
        sign = np.zeros(n, np.int8)
        if not robot.has_open_sums:
            e, _ = robot.present
            sign = engine.certify(robot.program, e, begin, state)[0]
        is_sure = sign != 0
        if has_signs or moves_by_drives(robot):
            sign = np.where(is_sure, sign, state.closure_sign[0])
        elif not is_sure.all():
            unsure = select_poses(state, ~is_sure)
            sign[~is_sure] = kinematics.compute_closure_sign(robot, robot.values[None], unsure)[0]
        state = replace(state, closure_sign=sign[None])
    is_other = closed & (sign != begin.closure_sign[0])
    # limbs that are closed one by one at a pose may have several readings there
    has_bends = not (moves_by_drives(robot) or has_one_solution(robot)) and determine_platform(
        robot
    )
    if has_bends and closed.any():
        is_other |= closed & (compute_bend(robot, state) != compute_bend(robot, begin))
    rows = np.flatnonzero(closed & ~is_other & ~is_sure)
    if not len(rows):
        return state, is_other
    first = select_poses(begin, rows) if begin.T.shape[1] == n > 1 else begin
    judged, is_other[rows] = _judge_paths(robot, first, select_poses(state, rows))
    return put_poses(state, rows, judged), is_other


def _judge_stages(robot: Mechanism, state: State, begin: State) -> tuple[State, BoolArray]:
    """Return what `judge_modes` returns, of a chain: another mode is one of any of its stages."""
    is_other, signs = np.zeros(state.T.shape[1], bool), list[NDArray[np.int8]]()
    parts = split_stage_states(robot, state), split_stage_states(robot, begin)
    for machine, own, first in zip(robot.present_stages, *parts, strict=True):
        part, is_part_other = judge_modes(machine, own, first, has_signs=True)
        signs.append(part.closure_sign)
        is_other |= is_part_other
    whole = np.multiply.reduce(signs, dtype=np.int8)
    return replace(state, closure_sign=whole, signs=tuple(signs)), is_other


def _judge_paths(robot: Mechanism, first: State, goal: State) -> tuple[State, BoolArray]:
    """Return goals (1, k) of the right sign with the passive joints at the end of a path, and which
    of them `first` (1, k | 1) does not lead to.

    Newton's method must lead to the pose of a goal from its readings, and a safe path too, where
    readings determine the joints.
    """
    loops = kinematics.Loops.place(robot)
    back = loops.close(loops.read(goal), first, goal=goal)
    is_other = back.status[0] != NEAR_GOAL
    if is_other.any():
        is_same = _is_same_pose(robot, back, goal, SAME_POSE)
        is_other &= (back.status[0] != Status.CONVERGED) | ~is_same
    rows = np.flatnonzero(~is_other & (loops.weights is None))
    start = repeat_poses(first, len(is_other))
    rows = rows[~contracts(robot, select_poses(start, rows), select_poses(goal, rows))]
    for path in (_move_readings, _move_poses):
        if not len(rows):
            break
        begin, end = select_poses(start, rows), select_poses(goal, rows)
        last, arrived = _follow_path(robot, begin, path(robot, begin, end))
        arrived &= _is_same_pose(robot, last, end, SAME_JOINTS)
        differs = arrived & (measure_distance(robot, end, last) > SAME_JOINTS)
        at_end = select_poses(last, differs)
        new = replace(select_poses(end, differs), T=at_end.T, joints=at_end.joints)
        goal = put_poses(goal, rows[differs], new)
        is_other[rows] = ~arrived
        rows = rows[~arrived]
    return goal, is_other


# Residual [m] of a converged row above which its redundant readings contradict each other.
COMPROMISE = 1e-9
# Largest deviation of R'R from the identity: the rounding of a file with seven digits.
ROTATION = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Solution(TableResult):
    """Poses and joints of n rows.

    Attributes
    ----------
    T : (n, 4, 4) platform in base [m]. q : (n, a) readings [m or rad].
    passive : (n, j) passive joint values, limb by limb [m or rad]; `passive_names` names them.
    status : (n,) members of Status. residual : (n,) closure residual [m]. iterations : (n,) Newton
        steps. state : the same rows for the engine. gap_scale : that of the robot.
    """

    T: FloatArray
    q: FloatArray
    passive: FloatArray
    passive_names: tuple[str, ...]
    status: NDArray[np.int8]
    residual: FloatArray
    iterations: IntArray
    state: State
    gap_scale: float = 0.0

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field(
            "status", lambda s: [Status(k).name.lower().replace("_", " ") for k in s.status], "pose"
        ),
        Field("platform", lambda solution: solution.T[:, :3, 3], "pose axis", "m"),
        Field("reading", "q", "pose actuator", "m or rad"),
        Field("residual", axes="pose", unit="m"),
        Field("passive", axes="pose joint", unit="m or rad"),
        Field("T_base_platform", "T", "pose row column", "m"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(axis=POSITION, joint="passive_names")

    def __len__(self) -> int:
        return len(self.q)

    def __repr__(self) -> str:
        """Return counts, the largest residual and the reason of the first failure."""
        failed = np.flatnonzero(~self.converged)
        gap = self.residual[self.converged].max(initial=0.0)
        text = f"<Solution: {len(self) - len(failed)} of {len(self)} rows closed"
        if len(failed) < len(self):
            text += f", residual at most {describe_gap(float(gap), self.gap_scale)}"
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
            code,
            row=row,
            gap=describe_gap(gap, self.gap_scale),
            iterations=int(self.iterations[row]),
        )


def forward(robot: Mechanism, q: ArrayLike, start: Solution | None = None) -> Solution:
    """Solve forward kinematics by Newton's method on the loop closure, beginning at `start`.

    Parameters
    ----------
    q : (n, a) readings [m or rad], or (n, 2 a) with their directions of approach (+1, -1, 0
        unknown) behind them. Rows of commanded readings alone are those at today's conditions, see
        `Mechanism.with_conditions`.
    start : a solution of one row or n rows that selects the assembly mode (default: home).

    Rows that fail are marked in `status`, never raised.

    Raises
    ------
    DataError : another number of columns than the robot has actuators.
    """
    begin, a = _check_start(start), len(robot.actuators)
    readings = np.atleast_2d(np.asarray(q, dtype=float))
    is_short = readings.ndim == 2 and readings.shape[1] < a
    if is_short and readings.shape[1] == (commanded := robot.is_commanded).sum():
        known, references = readings, [actuator.reference or 0.0 for actuator in robot.actuators]
        readings = np.tile(references, (len(known), 1))
        readings[:, commanded] = known
        if robot.is_elastic:
            wrench = np.array(robot.assembly.load.wrench)
            readings = kinematics.load_readings(robot, robot.values[None], readings[None], wrench)[
                0
            ]
    if readings.ndim != 2 or readings.shape[1] not in (a, 2 * a):
        raise DataError(
            f"{readings.shape[-1]} readings a row do not fit: {robot.name} has {a} actuators "
            f"({', '.join(actuator.name for actuator in robot.actuators)}). Give one reading for "
            "each"
        )
    state = kinematics.forward_trials(robot, robot.values[None], readings[None], begin)
    return make_solution(robot, state, readings[:, :a])


def _check_start(start: Solution | None) -> State | None:
    """Return the state of a start, None without one."""
    if start is None:
        return None
    if not isinstance(start, Solution):
        got = type(start).__name__
        raise DataError(f"start is of type {got}. Give a Solution, as from forward or inverse")
    return start.state


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

    Rows that fail are marked in `status`, never raised. A row is marked `OTHER_MODE` where the
    loops close at the target, but the readings lead from the start to another pose.

    Raises
    ------
    DataError : another shape, or a matrix that is not a pose.
    """
    begin = _check_start(start)
    c = len(robot.controlled)
    shapes = f"(n, 4, 4) poses or (n, {c}) coordinates ({', '.join(robot.controlled)})"
    wanted = np.asarray(target, dtype=float)
    values = robot.values[None]
    if are_poses(robot, wanted):
        T = wanted.reshape(-1, 4, 4)
        _check_poses(T)

        def reach_pose(T: FloatArray, start: State | None) -> tuple[State, BoolArray | None]:
            if controls_all(robot):
                return reach_coordinates(robot, read_coordinates(T, robot.controlled), start)
            return find_nearest_reachable(robot, values, T[None], start), None

        state = solve_in_mode(robot, reach_pose, T, begin)
    elif wanted.ndim in (1, 2) and wanted.shape[-1] == c:
        coordinates = np.atleast_2d(wanted)
        state = solve_in_mode(robot, partial(reach_coordinates, robot), coordinates, begin)
    else:
        raise DataError(f"a target has the shape {wanted.shape}. Allowed: {shapes}")
    q = kinematics.compute_readings(robot, values, state)[0]
    lost = (state.status == Status.CONVERGED) & ~np.isfinite(q).all(axis=-1)
    status = np.where(lost, np.int8(Status.UNREACHABLE), state.status)
    return make_solution(robot, replace(state, status=status), q)


def are_poses(robot: Mechanism, targets: ArrayLike) -> bool:
    """Return whether targets of `inverse` are poses (.., 4, 4), not four targets."""
    shape = np.shape(targets)
    if shape == (4, 4) and len(robot.controlled) == 4:
        return np.array_equal(np.asarray(targets)[3], np.eye(4)[3])
    return shape[-2:] == (4, 4)


def make_solution(robot: Mechanism, state: State, q: FloatArray) -> Solution:
    """Return the solution of a state (1, n) with readings (n, a)."""
    names = name_passive_joints(robot)
    passive = [robot.select_joint(state, name)[0] for name in names]
    return Solution(
        state.T[0],
        q,
        np.reshape(passive, (len(names), len(q))).T,
        names,
        state.status[0],
        state.residual[0],
        state.iterations[0],
        state,
        robot.gap_scale,
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

    FIELDS: ClassVar[tuple[Field, ...]] = (
        Field("pose", lambda j: np.repeat(range(1, len(j.parameters) + 1), len(AXES)), "row"),
        Field("component", lambda j: AXES * len(j.parameters), "row"),
        Field("unit", lambda j: TWIST_UNITS * len(j.parameters), "row"),
        Field(
            "by",
            lambda j: j.parameters.reshape(-1, len(j.parameter_names)),
            "row parameter",
            units=lambda j: [f"unit per {unit}" for unit in j.parameter_units],
        ),
        Field(
            "by_reading",
            lambda j: j.readings.reshape(-1, len(j.reading_names)),
            "row actuator",
            units=lambda j: [f"unit per {unit}" for unit in j.reading_units],
        ),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(
        parameter="parameter_names", actuator="reading_names"
    )

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
            f"target {row} is not a valid pose: {reason}. Give T_base_platform as (n, 4, 4) "
            "homogeneous matrices"
        )


def differentiate_by_coordinates(robot: Mechanism, values: FloatArray, state: State) -> FloatArray:
    """Return d twist / d coordinate (t, n, 6, c) [1/m, 1], every actuator free, in the units of
    `compare_coordinates`.
    """
    names, flat = robot.controlled, state.T.reshape(-1, 4, 4)
    columns = differentiate_coordinates(flat, names, robot.size)
    columns = columns.reshape(*state.T.shape[:2], len(names), 6)
    D = differentiate_pose(
        robot, values, kinematics.compute_readings(robot, values, state), state
    ).readings
    return np.matmul(D, np.linalg.pinv(np.nan_to_num(np.matmul(columns, D))))
