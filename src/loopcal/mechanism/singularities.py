# SPDX-License-Identifier: Apache-2.0
"""Distance of poses from singularities, and warnings along a path.

Closure without passive joints reads A y + Q dq = 0: rows in meters, columns of A for a translation
in meters and for a rotation in radians times the robot's size, so that the singular values of A
are meters per meter. The smallest one, the margin, is zero where the platform can move although
every actuator is locked (a parallel singularity). The smallest one of Q, columns of rotary
actuators per size too, is zero where an actuator moves nothing (a serial singularity). A margin has
no absolute scale, so it is compared with its median over the workspace. A chain of stages is
singular where a stage is, and where its readings do not move the controlled coordinates
independently. Derivation: docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal.engine import State
from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
from loopcal.mechanism.actuation import differentiate_unknowns_by_sums
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.chains import (
    find_carrying_actuators,
    list_carrying_stages,
    split_stage_states,
    transport_to_end,
)
from loopcal.mechanism.kinematics import compute_closure_sign, compute_readings
from loopcal.mechanism.limb_rows import linearize_limbs, reduce_to_platform
from loopcal.mechanism.mobility import list_main_freedoms
from loopcal.mechanism.model import Mechanism, ParameterUnits
from loopcal.mechanism.platform_coordinates import differentiate_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import Solution, forward, inverse, make_solution
from loopcal.mechanism.states import join_states
from loopcal.mechanism.transmission import invert_weights
from loopcal.mechanism.workspace import sample_workspace
from loopcal.numerics.statistics import compute_median
from loopcal.results.result import Result
from loopcal.typing import BoolArray, FloatArray, IntArray

# Share of the median margin below which a pose is close to a singularity (rule of thumb).
NEAR_SHARE = 0.1
SAMPLE_SIZE = 400  # positions of the workspace from which the median margins are taken


@dataclass(frozen=True, eq=False, repr=False)
class Singularity(Result):
    """Distance of n poses from singularities.

    closure_sign : (n,) sign of the determinant of A; it changes only at a singularity. 0 if A is
        not square.
    margin : (n,) smallest singular value of A [m/m]; NaN where the pose was not reached.
    direction : (n, m) least constrained motion: unit vector over the freedoms, angles times size.
    drive_margin : (n,) smallest singular value of Q [m/m]. drive : (n,) the actuator that moves the
        platform least.
    median, drive_median : of margin and drive_margin over the workspace, or their values at home if
        no workspace is stated.
    freedoms, actuators : names of the columns. solution : the poses.
    warnings : along a path, (step, finding) in its order.
    """

    closure_sign: NDArray[np.int8]
    margin: FloatArray
    direction: FloatArray
    drive_margin: FloatArray
    drive: IntArray
    median: float
    drive_median: float
    freedoms: tuple[str, ...]
    actuators: tuple[str, ...]
    solution: Solution
    warnings: tuple[tuple[int, Finding], ...] = ()

    def __repr__(self) -> str:
        text = f"<Singularity of {len(self.margin)} poses, {int(self.is_near.sum())} near or lost"
        if np.isfinite(self.margin).any():
            row = int(np.nanargmin(np.fmin(self.ratio, self.drive_ratio)))
            text += f"; smallest margin at row {row}: {self.explain(row)}"
        return text + ">"

    @property
    def ratio(self) -> FloatArray:
        """Margin (n,) in units of the workspace's median."""
        return self.margin / self.median

    @property
    def drive_ratio(self) -> FloatArray:
        """Drive margin (n,) in units of the workspace's median."""
        return self.drive_margin / self.drive_median

    @property
    def is_near(self) -> BoolArray:
        """Poses (n,) with a margin below NEAR_SHARE of its median, or not reached."""
        return ~((self.ratio >= NEAR_SHARE) & (self.drive_ratio >= NEAR_SHARE))

    def motion(self, row: int) -> tuple[str, ...]:
        """Return the freedoms of the least constrained motion, the largest component first."""
        return tuple(list_main_freedoms(self.freedoms, self.direction[row]))

    def explain(self, row: int) -> Finding:
        """Return the distance of a row from a singularity."""
        if not np.isfinite(self.margin[row]):
            reason = str(self.solution.explain(row))
            return report_finding("singularity.not-reached", row=row, reason=reason)
        weak = self.drive_ratio[row] < NEAR_SHARE
        code = "singularity.weak-actuator" if weak else "singularity.distance"
        return report_finding(code, **self._describe(row))

    def _describe(self, row: int) -> dict[str, Any]:
        """Return the numbers and names of a row that its findings state."""
        described: dict[str, Any] = {
            "row": row,
            "margin": float(self.margin[row]),
            "ratio": float(self.ratio[row]),
            "motion": self.motion(row),
            "actuator": None,
        }
        if self.drive_ratio[row] < NEAR_SHARE:
            described["actuator"] = self.actuators[self.drive[row]]
            described["drive_margin"] = float(self.drive_margin[row])
            described["drive_ratio"] = float(self.drive_ratio[row])
        return described

    def list_path_warnings(self) -> Iterator[tuple[int, Finding]]:
        """Yield steps not reached, sign changes and stretches close to a singularity."""
        closed = np.isfinite(self.margin)
        sign, near = self.closure_sign.astype(int), self.is_near & closed
        for i in range(len(sign)):
            before = sign[:i][closed[:i]][-1:]
            if closed[i] and before.size and sign[i] * before[0] < 0:
                yield i, report_finding("singularity.path-crosses", row=i)
            if not closed[i] and (i == 0 or closed[i - 1]):
                reason = str(self.solution.explain(i))
                yield i, report_finding("singularity.path-not-reached", row=i, reason=reason)
            if near[i] and not (i and near[i - 1]):
                beyond = np.flatnonzero(~near[i:])
                stretch = np.arange(i, i + int(beyond[0]) if beyond.size else len(sign))
                ratio = np.fmin(self.ratio, self.drive_ratio)[stretch]
                nearest = self._describe(int(stretch[np.argmin(ratio)]))
                last = int(stretch[-1])
                yield i, report_finding("singularity.path-near", first=i, last=last, **nearest)


def analyze_singularity(
    robot: Mechanism, poses: ArrayLike | Solution, medians: tuple[float, float] | None = None
) -> Singularity:
    """Return the distance from singularities of a Solution, poses (n, 4, 4) or coordinates (n, c).

    medians : of margin and drive margin, to compare with (default: over the workspace).
    """
    solution = poses if isinstance(poses, Solution) else inverse(robot, poses)
    margin, direction, drive_margin, drive = _compute_margins(robot, solution.state)
    closed = solution.closed
    sign = compute_closure_sign(robot, robot.values[None], solution.state)[0]
    return Singularity(
        np.where(closed, sign, 0).astype(np.int8),
        np.where(closed, margin, np.nan),
        direction,
        np.where(closed, drive_margin, np.nan),
        drive,
        *(compute_median_margins(robot) if medians is None else medians),
        tuple(AXES[f] for f in robot.program.freedoms),
        tuple(a.name for a in robot.actuators),
        solution,
    )


def trace_singularity(
    robot: Mechanism,
    *,
    readings: ArrayLike | None = None,
    coordinates: ArrayLike | None = None,
    medians: tuple[float, float] | None = None,
) -> Singularity:
    """Return the distance from singularities along a path, with warnings.

    Each step is solved from the step before, the first one from home.

    Parameters
    ----------
    readings : (n, a) [m or rad], or coordinates : (n, c) controlled coordinates [m, rad]; one of
        the two.
    medians : as in `analyze_singularity`.

    Raises
    ------
    DataError : both or neither are given.
    """
    if (readings is None) == (coordinates is None):
        raise DataError("give a path by exactly one of readings and coordinates")
    solve, points = (forward, readings) if coordinates is None else (inverse, coordinates)
    steps: list[Solution] = []
    last: Solution | None = None
    # along a path a row depends on the row before
    for point in np.atleast_2d(np.asarray(points, dtype=float)):
        step = solve(robot, point[None], start=last)
        steps.append(step)
        last = step if step.closed[0] else last
    state = join_states(*(step.state for step in steps))
    path = make_solution(robot, state, np.concatenate([step.q for step in steps]))
    result = analyze_singularity(robot, path, medians)
    return replace(result, warnings=tuple(result.list_path_warnings()))


def find_near_singularity(
    robot: Mechanism, state: State, least: tuple[float, float], asked: BoolArray, steps: int = 1
) -> BoolArray:
    """Return which rows (n,) of a state (1, n) have a margin or a drive margin below the least, or
    are not asked for.

    Rows are n / steps paths of so many steps each, one after the other. Of each path they are exact
    up to its first row that is near. A singular value changes at most as much as its matrix (Weyl),
    so that most rows of a path need no decomposition.
    """
    loops, drives, _ = _list_matrices(robot, state)
    is_near = ~asked.reshape(-1, steps)
    for (matrix, good), bound in (*((own, least[0]) for own in loops.values()), (drives, least[1])):
        is_near |= ~good.reshape(is_near.shape)
        paths = matrix.reshape(-1, steps, matrix.shape[1] * matrix.shape[2])
        left, row = np.flatnonzero(~is_near[:, 0]), np.int64(0)
        while len(left):
            known = paths[left, row]
            singular_values = np.linalg.svd(known.reshape(-1, *matrix.shape[1:]), compute_uv=False)
            margin = singular_values[:, -1]
            is_near[left, row] |= ~(margin >= bound)
            change = np.linalg.norm(paths[left] - known[:, None], axis=2)
            is_open = ~(margin[:, None] - change > bound * (1.0 + 1e-9))
            is_open &= np.arange(steps) > np.reshape(row, (-1, 1))
            going = is_open.any(axis=1) & ~is_near[left, row]
            left, row = left[going], is_open[going].argmax(axis=1)
    return is_near.ravel()


def compute_median_margins(robot: Mechanism) -> tuple[float, float]:
    """Return the median margin and drive margin over the workspace.

    Without a stated workspace they are those of home.
    """
    state, stated = robot.home_state, set(robot.assembly.workspace)
    if "theta" in stated:
        stated.add("phi")
    if set(robot.controlled) <= stated:
        state = sample_workspace(robot, SAMPLE_SIZE).solution.state
    margin, _, drive_margin, _ = _compute_margins(robot, state)
    return compute_median(margin), compute_median(drive_margin)


def _compute_margins(
    robot: Mechanism, state: State
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Return margin (n,), least constrained motion (n, m), drive margin (n,), weakest drive (n,).

    The state is (1, n).
    """
    loops, (slope, good), moving = _list_matrices(robot, state)
    chain, n = robot.stages, state.T.shape[1]
    carried = transport_to_end(robot, state, -1) if chain else [(0, np.eye(6)[None])]
    transports = {i: to_end[0] for i, to_end in carried}
    margin, direction = np.full(n, 1.0 if chain else np.inf), np.tile(np.eye(6)[0], (n, 1))
    for i, (A, is_known) in loops.items():
        block = robot.blocks[i].robot
        _, s, V = np.linalg.svd(A)
        least, twist = np.where(is_known, s[:, -1], np.nan), np.zeros((n, 6))
        freedoms = list(block.program.freedoms)
        twist[:, freedoms] = V[:, s.shape[1] - 1] / block.twist_scale[freedoms]
        twist = np.matmul(transports[i], twist[..., None])[..., 0] * robot.twist_scale
        length = np.linalg.norm(twist, axis=1, keepdims=True)
        is_less = ~(margin <= least)
        margin = np.where(is_less, least, margin)
        direction = np.where(is_less[:, None], twist / np.maximum(length, 1e-300), direction)
    _, r, W = np.linalg.svd(slope)
    weakest = moving[np.abs(W[:, r.shape[1] - 1]).argmax(axis=1)]
    own = direction[:, list(robot.program.freedoms)]
    return margin, own, np.where(good, r[:, -1], np.nan), weakest


Matrix = tuple[FloatArray, BoolArray]
"""A matrix (n, .., ..) whose smallest singular value is a margin, and where it is finite (n,); it
is zero elsewhere."""


def _list_matrices(robot: Mechanism, state: State) -> tuple[dict[int, Matrix], Matrix, IntArray]:
    """Return A of the blocks with loops that carry the platform, by number; Q, or of a chain the
    derivatives C D of the controlled coordinates by readings; and the places of its drives.
    """
    if not robot.stages:
        A, Q, good = _scale_closure(robot, state)
        return {0: (A, good)}, (Q, good), np.arange(Q.shape[2])
    own, loops, values = split_stage_states(robot, state), dict[int, Matrix](), robot.values[None]
    for i in list_carrying_stages(robot):
        if not (stage := robot.present_stages[i]).is_serial:
            A, _, good = _scale_closure(stage, own[i])
            loops[i] = A, good
    q = compute_readings(robot, values, state)
    none = ParameterUnits(robot.slots, np.zeros(0, np.int64), np.zeros(0))
    D = differentiate_pose(robot, values, q, state, none).readings[0]
    columns = differentiate_coordinates(state.T[0], robot.controlled, robot.size)
    moving, (_, drives) = find_carrying_actuators(robot), robot.present
    turned = np.abs(drives.differentiate_by_readings(q)[0]).sum(axis=1)
    units = robot.drive_units * np.where(turned, turned, 1.0)  # of a reading
    slope = np.matmul(columns, D[..., moving]) / units[:, None, moving]
    good = np.isfinite(slope).all(axis=(1, 2))
    return loops, (np.where(good[:, None, None], slope, 0.0), good), moving


def _scale_closure(robot: Mechanism, state: State) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return A (n, c, m) and Q (n, c, a) in meters at a state (1, n) of a machine without stages,
    zero where a number is not finite, and where all are finite (n,).
    """
    program, limbs = robot.program, linearize_limbs(robot, robot.values[None], state)
    parts = [reduce_to_platform(program, blocks) for _, blocks in limbs]
    A, Q = (np.concatenate(rows, axis=1)[0] for rows in zip(*parts, strict=True))
    if robot.has_sums:
        e, drives = robot.present
        weights, chosen = drives.weights, ~drives.fixed_rows  # sums of commanded readings
        assert weights is not None
        if robot.has_open_sums:  # dy/ds^+ dy - ds = 0
            moved = differentiate_unknowns_by_sums(robot, e, state, weights)[0]
            own = moved[:, : A.shape[2], chosen]
            A = np.linalg.pinv(np.nan_to_num(own, posinf=0.0, neginf=0.0))
            Q = np.tile(-np.eye(A.shape[1]), (len(A), 1, 1))
        else:
            Q = np.matmul(Q, invert_weights(weights))[..., chosen]
    A = A / robot.twist_scale[list(program.freedoms)]
    Q = Q / robot.drive_units[: Q.shape[2]]
    good = np.asarray(np.isfinite(A).all(axis=(1, 2)) & np.isfinite(Q).all(axis=(1, 2)))
    return np.where(good[:, None, None], A, 0.0), np.where(good[:, None, None], Q, 0.0), good
