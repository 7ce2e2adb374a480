# SPDX-License-Identifier: Apache-2.0
"""Groups of poses whose points lie on a plane and on a line perpendicular to it, as candidates.

A group has k points: p_0 lies on plane and line, p_1 on the line, the others in the plane. The line
runs along one axis of the base. A coordinate measuring machine checks it by two held coordinates,
the plane by the third. The plan chooses the positions of the points in the workspace and the
orientations of the platform there. The instrument shows only that the held coordinates agree, so
the direction, height and shifts of the surfaces are nuisance parameters of the group. Readings of
the robot count as exact.

To first order, with levers L_i = p_i - p_0, the direction n of the line, t_1 and t_2 across it, and
its rotations (u_1, u_2):

    plane, p_0 p_2 .. p_(k-1)    n'dp_i + (t_1'L_i) u_1 + (t_2'L_i) u_2 - height
    line, p_0 and p_1            t_j'dp_i - (n'L_i) u_j - shift_j,   j = 1, 2

These are k + 3 rows. Five determine the surfaces; k - 2 remain for the machine. See
docs/theory/constraint.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from loopcal import geometry
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.findings import report_finding
from loopcal.mechanism import (
    POSITION,
    Mechanism,
    differentiate_pose,
    evaluate_limits,
    inverse,
    pose_from_coordinates,
    workspace_ranges,
)
from loopcal.numerics.column_elimination import eliminate_columns
from loopcal.planning.constraints import ConstraintChecker
from loopcal.typing import BoolArray, FloatArray, IntArray

AXIS = 3
"""Column of the axis in a design."""

LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Levels of every coordinate, in half ranges from the middle of the workspace."""

SHORTEST = 0.25
"""Shortest allowed line, in half ranges of the workspace: a shorter one is hard to tell from a
point.
"""

SHRINKAGE, ROUNDS = 0.85, 12
"""Groups out of reach are drawn anew in a workspace smaller by this factor, so many times."""

SURFACE = 5
"""Nuisance parameters of a group: two rotations, a height, two shifts."""


@dataclass(frozen=True, eq=False)
class PlaneLineGroups:
    """All groups of one size: their designs, their points, and their rows.

    A design of u groups is (u, c): fractions of the half ranges of the workspace, from -1 to 1,
    except for the axis, which is 0, 1 or 2.

    Parameters
    ----------
    robot : moves in x, y and z, and states a workspace.
    points : k, at least 4. sigma : of a held coordinate [m].
    axes : along which lines may run.
    shortest : least length of a line, in half ranges; a line of no length is none.

    Raises
    ------
    EstimationError
        Too few points for a plane, no axis, or a robot that cannot move in x, y and z.
    MechanismError
        The robot states no range for a coordinate.
    """

    robot: Mechanism
    points: int
    sigma: float
    axes: tuple[str, ...] = POSITION
    shortest: float = SHORTEST

    def __post_init__(self) -> None:
        if self.points < 4:
            raise EstimationError(
                f"{self.points} points in a group; give at least 4: one on plane and line, one on "
                "the line, two more in the plane"
            )
        if not self.sigma > 0.0:
            raise EstimationError(
                f"sigma of a held coordinate is {self.sigma} m; give a number above 0"
            )
        if not self.axes or not set(self.axes) <= set(POSITION):
            raise EstimationError(
                f"lines along {', '.join(self.axes) or 'no axis'}; choose from "
                f"{', '.join(POSITION)}"
            )
        missing = tuple(name for name in POSITION if name not in self.robot.controlled)
        if missing:
            raise EstimationError(
                report_finding("plan.surfaces-not-followed", robot=self.robot.name, missing=missing)
            )

    @cached_property
    def free(self) -> FreeParameters:
        """The free parameters of the machine, p of them."""
        return select_free_parameters(self.robot)

    @cached_property
    def orientation_names(self) -> tuple[str, ...]:
        """The m controlled coordinates that do not place the point."""
        return tuple(name for name in self.robot.controlled if name not in POSITION)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the c coordinates of a design."""
        turns = self.orientation_names
        names = [*(f"p0.{n}" for n in POSITION), "axis", *(f"p0.{n}" for n in turns)]
        names += ["p1.along", *(f"p1.{n}" for n in turns)]
        for i in range(2, self.points):
            names += [f"p{i}.a", f"p{i}.b", *(f"p{i}.{n}" for n in turns)]
        return tuple(names)

    def list_levels(self, fractions: Sequence[float] = LEVELS) -> tuple[FloatArray, ...]:
        """Return the levels to try, coordinate by coordinate."""
        axis = np.array([POSITION.index(name) for name in self.axes], dtype=np.float64)
        return tuple(
            axis if name == "axis" else np.asarray(fractions, dtype=np.float64)
            for name in self.names
        )

    def draw(self, groups: int, seed: int | np.random.Generator = 0) -> FloatArray:
        """Draw a design (u, c): points and orientations anywhere in the workspace, each line along
        any of the axes.

        Lines are drawn long enough. Groups with a pose out of reach are drawn anew, nearer and
        nearer to the middle.

        Raises
        ------
        EstimationError
            No group near the middle of the workspace is allowed.
        """
        rng = np.random.default_rng(seed)
        design, left = np.zeros((groups, len(self.names))), np.arange(groups)
        for i in range(ROUNDS):
            half = SHRINKAGE**i
            new = rng.uniform(-half, half, (len(left), len(self.names)))
            new[:, AXIS] = rng.choice(self.list_levels()[AXIS], len(left))
            new[:, 4 + len(self.orientation_names)] = self._draw_line_ends(new, half, rng)
            design[left] = new
            left = left[np.isnan(self.linearize(new)).any(axis=(1, 2))]
            if not len(left):
                return design
        raise EstimationError(
            report_finding("plan.surfaces-out-of-reach", robot=self.robot.name, points=self.points)
        )

    def place_points(self, design: FloatArray) -> FloatArray:
        """Return controlled coordinates (u, k, c) [m, rad] that bring the origin of the tool to the
        points of designs (u, c).
        """
        u, k, m = len(design), self.points, len(self.orientation_names)
        each = np.arange(u)
        axis = self._axis(design)
        place = np.repeat(design[:, None, :3], k, axis=1)
        turn = np.empty((u, k, m))
        turn[:, 0] = design[:, 4 : 4 + m]
        place[each, 1, axis] = design[:, 4 + m]
        turn[:, 1] = design[:, 5 + m : 5 + 2 * m]
        rest = design[:, 5 + 2 * m :].reshape(u, k - 2, 2 + m)
        for j in (1, 2):
            place[each, 2:, (axis + j) % 3] = rest[:, :, j - 1]
        turn[:, 2:] = rest[:, :, 2:]
        bounds, names = workspace_ranges(self.robot), (*POSITION, *self.orientation_names)
        low, high = np.array([bounds[name] for name in names]).T
        fractions = np.concatenate([place, turn], axis=2)
        coordinates = 0.5 * (high + low) + 0.5 * (high - low) * fractions
        order = [names.index(name) for name in self.robot.controlled]
        return self._shift_to_platform(coordinates[:, :, order])

    def linearize(self, design: FloatArray, checker: ConstraintChecker | None = None) -> FloatArray:
        """Return the rows of groups for the machine, the surfaces eliminated.

        Parameters
        ----------
        design : (u, c). checker : further constraints on the poses.

        Returns
        -------
        rows : (u, k - 2, p) divided by sigma, by deviations in tolerances; NaN for a group with a
            pose that is out of reach or not allowed, too short a line, or points that do not
            determine the surfaces.
        """
        x = self.place_points(design)
        different, back = np.unique(x.reshape(-1, x.shape[2]), axis=0, return_inverse=True)
        T, J, reached = self._linearize_points(different, checker)
        back = back.reshape(x.shape[:2])
        points = (T[:, :3, :3] @ self.robot.tool[:3, 3] + T[:, :3, 3])[back]
        F, A = linearize_surfaces(points, J[back], self._axis(design))
        rows, determined = eliminate_surfaces(F, A)
        allowed = determined & reached[back].all(axis=1)
        allowed &= self._line_length(design) >= self.shortest
        return np.where(allowed[:, None, None], rows / self.sigma, np.nan)

    def _axis(self, design: FloatArray) -> IntArray:
        return np.rint(design[:, AXIS]).astype(np.int64)

    def _draw_line_ends(
        self, design: FloatArray, half: float, rng: np.random.Generator
    ) -> FloatArray:
        """Draw the ends of lines (u,), evenly from what is `shortest` or more from p_0 and within
        `half` of the middle.

        Where nothing is, because `half` is small, the line has its least length.
        """
        foot, limit = (
            design[np.arange(len(design)), self._axis(design)],
            min(max(half, self.shortest), 1.0),
        )
        below = np.maximum(limit + foot - self.shortest, 0.0)
        above = np.maximum(limit - foot - self.shortest, 0.0)
        share = rng.uniform(0.0, 1.0, len(design)) * (below + above)
        return np.where(share < below, share - limit, limit - (below + above) + share)

    def _line_length(self, design: FloatArray) -> FloatArray:
        """Return the length (u,) of the lines in half ranges."""
        end = design[:, 4 + len(self.orientation_names)]
        return np.abs(end - design[np.arange(len(design)), self._axis(design)])

    def _shift_to_platform(self, x: FloatArray) -> FloatArray:
        """Return coordinates (.., c) of the platform that put the origin of the tool at x."""
        names, tool = self.robot.controlled, self.robot.tool[:3, 3]
        if not tool.any():
            return x
        moved = x.copy()
        offset = pose_from_coordinates(x, names, self.robot.home)[..., :3, :3] @ tool
        moved[..., [names.index(name) for name in POSITION]] -= offset
        return moved

    def _linearize_points(
        self, x: FloatArray, checker: ConstraintChecker | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return poses (n, 4, 4), derivatives (n, 3, p) of the origin of the tool by deviations in
        tolerances, and which rows of x (n, c) are reached and allowed.
        """
        robot, free, values = self.robot, self.free, self.robot.values[None]
        solution = inverse(robot, x)
        state, q = solution.state, solution.q[None]
        reached = solution.converged
        for limit in evaluate_limits(robot, values, q, state):
            reached = reached & (limit.margin[0] >= 0.0)
        if checker is not None:
            reached = reached & checker.check_poses(solution).allowed
        D = differentiate_pose(robot, values, q, state).parameters[0][..., free.places]
        reached = reached & np.isfinite(D).all(axis=(1, 2))
        T = np.where(reached[:, None, None], solution.T, np.eye(4))
        D = np.where(reached[:, None, None], D * free.tolerance, 0.0)
        arm = T[:, :3, :3] @ robot.tool[:3, 3]
        return T, D[:, 3:] - geometry.hat(arm) @ D[:, :3], reached


def linearize_surfaces(
    points: FloatArray, J: FloatArray, axis: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return rows of groups by the parameters of the surfaces and of the machine.

    The four rows of the line come first, then those of the plane.

    Parameters
    ----------
    points : (u, k, 3) [m]. J : (u, k, 3, p) their derivatives. axis : (u,) 0, 1 or 2, along which
        the lines run.

    Returns
    -------
    F : (u, k + 3, 5) by two rotations, height and two shifts. A : (u, k + 3, p).
    """
    u, k = points.shape[:2]
    each = np.arange(u)
    n, *across = ((axis + j) % 3 for j in range(3))
    lever = points - points[:, :1]
    plane = np.r_[0, 2:k]
    F, A = np.zeros((u, k + 3, SURFACE)), np.empty((u, k + 3, J.shape[3]))
    for j, t in enumerate(across):
        rows = slice(2 * j, 2 * j + 2)
        A[:, rows] = J[each, :2, t]
        F[:, rows, j] = -lever[each, :2, n]
        F[:, rows, 3 + j] = -1.0
        F[:, 4:, j] = lever[each, :, t][:, plane]
    A[:, 4:] = J[each, :, n][:, plane]
    F[:, 4:, 2] = -1.0
    return F, A


def eliminate_surfaces(F: FloatArray, A: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return rows A (u, m, p) projected onto the complement of F (u, m, 5), and where F has full
    rank: (u, m - 5, p) and (u,).
    """
    done = eliminate_columns(np.concatenate([F, A], axis=2), SURFACE)
    return done.rest[:, SURFACE:], done.rank == SURFACE
