# SPDX-License-Identifier: Apache-2.0
"""How far poses are from a singularity, in stated units and in words, and where a path comes too
near to one.

Closure with passive joints eliminated reads A y + Q dq = 0: rows in metres, columns of A for a
shift in metres and for a turn in radians times the robot's size, so that the singular values of A
are metres per metre. The smallest one, the margin, is zero where the platform can move though every
actuator is held (a parallel singularity). The smallest one of Q, columns of turning actuators per
size too, is zero where an actuator moves nothing (a serial singularity). What is small depends on
the machine, so the margin is compared with its median over the workspace. Derivation:
docs/theory/kinematics.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loopcal import engine
from loopcal.engine import ClosureBlocks, Program, State
from loopcal.errors import DataError
from loopcal.mechanism.assembly import AXES
from loopcal.mechanism.batch_kinematics import compute_closure_sign
from loopcal.mechanism.kinematics import Solution, forward, inverse, make_solution
from loopcal.mechanism.mobility import MOTIONS
from loopcal.mechanism.model import Mechanism, Status
from loopcal.mechanism.sensitivity import stack_platform_rows
from loopcal.mechanism.states import driven_values, join_states
from loopcal.mechanism.workspace import sample_workspace
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension

NEAR_SHARE = 0.1
"""Share of the workspace's median margin below which a pose counts as near a singularity: a rule of
thumb.
"""
POSES = 400
"""Positions of the workspace whose median margin is the measure."""


@dataclass(frozen=True)
class Singularity:
    """How far each of n poses is from a singularity.

    Attributes
    ----------
    closure_sign : (n,) sign of the determinant of A; it changes only through a singularity. 0 where
        A is not square.
    margin : (n,) smallest singular value of A [m/m]; NaN where the pose was not reached.
    direction : (n, m) how the platform moves most freely: unit vector over its freedoms, turns
        times size.
    drive_margin : (n,) smallest singular value of Q [m/m]. drive : (n,) the actuator that moves the
        platform least.
    median, drive_median : of margin and drive_margin over the workspace, or their values at home if
        none is stated.
    freedoms, actuators : names to the columns. solution : the poses.
    warnings : along a path, (step, sentence) in its order.
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
    warnings: tuple[tuple[int, str], ...] = ()

    @property
    def ratio(self) -> FloatArray:
        """(n,) margin in units of the workspace's median."""
        return self.margin / self.median

    @property
    def drive_ratio(self) -> FloatArray:
        """(n,) drive_margin in units of the workspace's median."""
        return self.drive_margin / self.drive_median

    @property
    def is_near(self) -> BoolArray:
        """(n,) True where a margin is below NEAR_SHARE of its median, or the pose was not reached."""
        return ~((self.ratio >= NEAR_SHARE) & (self.drive_ratio >= NEAR_SHARE))

    def motion(self, row: int) -> str:
        """How the platform moves most freely at a row, largest component first."""
        direction = self.direction[row]
        order = [
            i
            for i in np.argsort(-np.abs(direction))
            if abs(direction[i]) > 0.3 * np.abs(direction).max()
        ]
        return " with ".join(MOTIONS[self.freedoms[i]] for i in order)

    def explain(self, row: int) -> str:
        """A row in a sentence."""
        if not np.isfinite(self.margin[row]):
            return f"row {row}: not reached ({self.solution.explain(row)})"
        loose = (
            f"row {row}: smallest singular value of closure {self.margin[row]:.3g} m/m, "
            f"{self.ratio[row]:.2g} of the median; "
            f"the platform moves most freely as a {self.motion(row)}"
        )
        if self.drive_ratio[row] >= NEAR_SHARE:
            return loose
        return (
            f"{loose}; {self.actuators[self.drive[row]]} hardly moves it "
            f"({self.drive_margin[row]:.3g} m/m, {self.drive_ratio[row]:.2g} of the median)"
        )


def analyze_singularity(
    robot: Mechanism, poses: ArrayLike | Solution, medians: tuple[float, float] | None = None
) -> Singularity:
    """How far poses are from a singularity.

    Parameters
    ----------
    poses : a Solution, or poses (n, 4, 4) or controlled coordinates (n, c) for `inverse`.
    medians : of margin and drive margin, to compare with (default: over the workspace).
    """
    solution = poses if isinstance(poses, Solution) else inverse(robot, poses)
    margin, direction, drive_margin, drive = _margins(robot, solution.state)
    closed = (solution.status == Status.CONVERGED) | (solution.status == Status.OTHER_MODE)
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
    """The same along a path, each step solved from the one before, the first from home, with
    warnings.

    Parameters
    ----------
    readings : (n, a) [m or rad], or coordinates : (n, c) controlled coordinates [m, rad]; one of
        the two.
    medians : as in `singularity`.

    Raises
    ------
    DataError
        Both or neither are given.
    """
    if (readings is None) == (coordinates is None):
        raise DataError(
            "a path is given by its readings or by its coordinates; give one of the two"
        )
    step, points = (forward, readings) if coordinates is None else (inverse, coordinates)
    parts: list[Solution] = []
    last: Solution | None = None
    # a path is what its steps make of each other: here one row does depend on the row before
    for point in np.atleast_2d(np.asarray(points, dtype=float)):
        found = step(robot, point[None], start=last)
        parts.append(found)
        last = found if found.status[0] in (Status.CONVERGED, Status.OTHER_MODE) else last
    whole = make_solution(
        robot, join_states(*(p.state for p in parts)), np.concatenate([p.q for p in parts])
    )
    result = analyze_singularity(robot, whole, medians)
    return replace(result, warnings=tuple(_path_warnings(result)))


def compute_median_margins(robot: Mechanism) -> tuple[float, float]:
    """Median margin and drive margin over the workspace; those of home where no workspace is
    stated.
    """
    state = robot.home_state
    if set(robot.controlled) <= {
        *robot.assembly.workspace,
        *(["phi"] if "theta" in robot.assembly.workspace else []),
    }:
        state = sample_workspace(robot, POSES).solution.state
    margin, _, drive_margin, _ = _margins(robot, state)
    return float(np.median(margin)), float(np.median(drive_margin))


def _margins(robot: Mechanism, state: State) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Margin (n,), freest motion (n, m), drive margin (n,) and the weakest drive (n,) of a state
    (1, n).
    """
    program, size = robot.program, robot.size
    e, _ = robot.slots(robot.values[None])
    blocks = engine.linearize(program, e, driven_values(program, state), state)
    A = stack_platform_rows(blocks)[0] * np.array(
        [1 / size if f < 3 else 1.0 for f in program.freedoms]
    )
    Q = _drives(program, blocks) * np.array(
        [1 / size if a.dimension is Dimension.ANGLE else 1.0 for a in robot.actuators]
    )
    good = np.isfinite(A).all(axis=(1, 2)) & np.isfinite(Q).all(axis=(1, 2))
    A, Q = np.where(good[:, None, None], A, 0.0), np.where(good[:, None, None], Q, 0.0)
    _, s, V = np.linalg.svd(A)
    _, r, W = np.linalg.svd(Q)
    margin, drive_margin = (np.where(good, x[:, -1], np.nan) for x in (s, r))
    return margin, V[:, -1], drive_margin, np.abs(W[:, -1]).argmax(axis=1)


def _drives(program: Program, blocks: ClosureBlocks) -> FloatArray:
    """Closure rows against the actuated joints (n, c, a) [m/m or m/rad]."""
    parts = []
    for group, block in zip(program.groups, blocks.closure, strict=True):
        for k in range(len(group.limbs)):
            Q = np.zeros((*block.Q.shape[1:2], block.Q.shape[3], program.n_joints))
            for j, columns in enumerate(group.actuator):
                if columns[k] >= 0:
                    Q[..., columns[k]] = block.Q[0, :, k, :, j]
            parts.append(Q)
    return np.concatenate(parts, axis=1)


def _path_warnings(path: Singularity) -> Iterator[tuple[int, str]]:
    """Steps not reached, changes of the sign, and stretches too near to a singularity, in the order
    of the path.
    """
    closed = np.isfinite(path.margin)
    sign = path.closure_sign.astype(int)
    for i in range(len(sign)):
        before = sign[:i][closed[:i]][-1:]
        if closed[i] and before.size and sign[i] * before[0] < 0:
            yield (
                i,
                (
                    f"the determinant changes its sign before step {i}: the path crosses a "
                    "singularity "
                    "or jumps to another mode"
                ),
            )
        if not closed[i] and (i == 0 or closed[i - 1]):
            yield i, f"not reached from here: {path.solution.explain(i)}"
        near = path.is_near & closed
        if near[i] and not (i and near[i - 1]):
            beyond = np.flatnonzero(~near[i:])
            stretch = np.arange(i, i + int(beyond[0]) if beyond.size else len(sign))
            ratio = np.fmin(path.ratio, path.drive_ratio)[stretch]
            worst = int(stretch[np.argmin(ratio)])
            yield (
                i,
                (
                    f"steps {i} to {stretch[-1]} are near a singularity; nearest is "
                    f"{path.explain(worst)}"
                ),
            )
