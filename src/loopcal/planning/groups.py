# SPDX-License-Identifier: Apache-2.0
"""Groups of poses with one point of the platform on a plane and on a line perpendicular to it, for
planning.

A group has k points: the foot p_0, which lies on both, p_1 on the line, the others in the plane.
The line runs along one axis of the base and is reached by holding two coordinates of a coordinate
measuring machine, the plane by holding the third. What is planned is where in the workspace each
point lies and how the platform is turned there; what the instrument shows is only that the held
coordinates agree, so direction, height and shifts of the surfaces are unknowns of the group.
Readings of the robot count as exact.

To first order, with levers L_i = p_i - p_0, the line's direction n, t_1 and t_2 across it, and its
turns (u_1, u_2):

    plane, p_0 p_2 .. p_(k-1)    n'dp_i + (t_1'L_i) u_1 + (t_2'L_i) u_2 - height
    line, p_0 and p_1            t_j'dp_i - (n'L_i) u_j - shift_j,   j = 1, 2

k + 3 rows, of which five are spent on the surfaces and k - 2 tell of the machine. See
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
from loopcal.mechanism import (
    POSITION,
    Mechanism,
    Status,
    compute_closure_sign,
    compute_readings,
    differentiate_pose,
    evaluate_limits,
    inverse_trials,
    pose_from_coordinates,
    workspace_ranges,
)
from loopcal.typing import BoolArray, FloatArray, IntArray

AXIS = 3
"""Place of the axis among the coordinates of a design."""

LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Of every coordinate, in half ranges from the middle of the workspace."""

SHORTEST = 0.25
"""Length of a line, in half ranges of the workspace, below which it is not told apart from its
foot.
"""

NEARER, ROUNDS = 0.85, 12
"""Groups out of reach are drawn anew in a workspace this much narrower, so many times."""

SURFACE = 5
"""FreeParameters of a group's surfaces: two turns, a height, two shifts."""

DEGENERATE = 1e-10
"""Share of a column of the surfaces' unknowns, after those before it, below which the points do not
show it.
"""


@dataclass(frozen=True, eq=False)
class PlaneAndLine:
    """How the design of one group is written in numbers, and what a group tells.

    A design is (u, c): fractions of the half ranges of the workspace, from -1 to 1, but for the
    axis, which is 0, 1 or 2.

    Parameters
    ----------
    robot : moves in x, y and z, and states a workspace. points : k, at least 4. sigma : of a held
        coordinate [m].
    axes : along which lines may run. shortest : least length of a line, in half ranges; a line of
        no length is none.

    Raises
    ------
    EstimationError
        Too few points for a plane, no axis, or a robot that cannot be sent to x, y and z.
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
                f"{self.points} points a group: give at least 4, the foot, one on the line, two "
                "more in the plane"
            )
        if not self.sigma > 0.0:
            raise EstimationError(
                f"the sigma of a held coordinate is {self.sigma} m; give a number above 0"
            )
        if not self.axes or not set(self.axes) <= set(POSITION):
            raise EstimationError(
                f"lines along {', '.join(self.axes) or 'nothing'}: choose from "
                f"{', '.join(POSITION)}"
            )
        missing = [name for name in POSITION if name not in self.robot.controlled]
        if missing:
            raise EstimationError(
                f"{self.robot.name} is not sent to {', '.join(missing)}, so its point cannot "
                "follow a plane and a line"
                " along the base's axes; plan for another instrument"
            )

    @cached_property
    def free_parameters(self) -> FreeParameters:
        """The machine's, p of them."""
        return select_free_parameters(self.robot)

    @cached_property
    def turning(self) -> tuple[str, ...]:
        """The m controlled coordinates that do not place the point."""
        return tuple(name for name in self.robot.controlled if name not in POSITION)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What each of the c coordinates is."""
        found = [
            *(f"p0.{name}" for name in POSITION),
            "axis",
            *(f"p0.{name}" for name in self.turning),
        ]
        found += ["p1.along", *(f"p1.{name}" for name in self.turning)]
        for i in range(2, self.points):
            found += [f"p{i}.a", f"p{i}.b", *(f"p{i}.{name}" for name in self.turning)]
        return tuple(found)

    @cached_property
    def _home(self) -> int:
        """Orientation at home: another one lies beyond a singularity."""
        return int(
            compute_closure_sign(self.robot, self.robot.values[None], self.robot.home_state)[0, 0]
        )

    def levels(self, fractions: Sequence[float] = LEVELS) -> tuple[FloatArray, ...]:
        """Values to try, coordinate by coordinate."""
        axis = np.array([POSITION.index(name) for name in self.axes], dtype=np.float64)
        return tuple(
            axis if name == "axis" else np.asarray(fractions, dtype=np.float64)
            for name in self.names
        )

    def random(self, groups: int, seed: int | np.random.Generator = 0) -> FloatArray:
        """Draw a design (u, c): points and turns anywhere in the workspace, each line along any of
        the axes.

        Lines are drawn long enough. Groups that are not allowed all the same, because a pose is out
        of reach, are drawn anew, ever nearer to the middle.

        Raises
        ------
        EstimationError
            No group near the middle of the workspace is allowed.
        """
        rng = np.random.default_rng(seed)
        design, wrong = np.zeros((groups, len(self.names))), np.arange(groups)
        for i in range(ROUNDS):
            half = NEARER**i
            drawn = rng.uniform(-half, half, (len(wrong), len(self.names)))
            drawn[:, AXIS] = rng.choice(self.levels()[AXIS], len(wrong))
            drawn[:, 4 + len(self.turning)] = self._ends(drawn, half, rng)
            design[wrong] = drawn
            wrong = wrong[np.isnan(self.rows(drawn)).any(axis=(1, 2))]
            if not len(wrong):
                return design
        raise EstimationError(
            f"{self.robot.name} reaches no group of {self.points} points on a plane and a line; "
            "narrow its workspace, or"
            " plan fewer points a group"
        )

    def coordinates(self, design: FloatArray) -> FloatArray:
        """Return controlled coordinates (u, k, c) [m, rad] that bring the tool's origin to the
        points of designs (u, c).
        """
        u, k, m = len(design), self.points, len(self.turning)
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
        wide = workspace_ranges(self.robot)
        low, high = np.array([wide[name] for name in (*POSITION, *self.turning)]).T
        given = 0.5 * (high + low) + 0.5 * (high - low) * np.concatenate([place, turn], axis=2)
        order = [(*POSITION, *self.turning).index(name) for name in self.robot.controlled]
        return self._for_tool(given[:, :, order])

    def rows(self, design: FloatArray) -> FloatArray:
        """Return what groups tell of the machine, their surfaces eliminated.

        Parameters
        ----------
        design : (u, c).

        Returns
        -------
        rows : (u, k - 2, p) divided by sigma, by deviations in tolerances; NaN for a group with a
            pose out of reach, too short a line, or points that do not show where its surfaces are.
        """
        x = self.coordinates(design)
        different, back = np.unique(x.reshape(-1, x.shape[2]), axis=0, return_inverse=True)
        T, J, reached = self._seen(different)
        back = back.reshape(x.shape[:2])
        at, J = (T[:, :3, :3] @ self.robot.tool[:3, 3] + T[:, :3, 3])[back], J[back]
        F, A = surface_rows(at, J, self._axis(design))
        told, shown = without_surfaces(F, A)
        allowed = shown & reached[back].all(axis=1) & (self._length(design) >= self.shortest)
        return np.where(allowed[:, None, None], told / self.sigma, np.nan)

    def evaluate(self, which: IntArray, design: FloatArray) -> FloatArray:
        """Return `rows` of designs, as coordinate exchange asks for them: all groups are alike,
        whichever they are.
        """
        del which
        return self.rows(design)

    def _axis(self, design: FloatArray) -> IntArray:
        return np.rint(design[:, AXIS]).astype(np.int64)

    def _ends(self, design: FloatArray, half: float, rng: np.random.Generator) -> FloatArray:
        """Draw where lines end (u,), evenly from what lies `shortest` or more from their foot and
        within `half` of the middle.

        Where that is nothing, because `half` is small, the line is as long as it must be.
        """
        foot, wide = (
            design[np.arange(len(design)), self._axis(design)],
            min(max(half, self.shortest), 1.0),
        )
        below = np.maximum(wide + foot - self.shortest, 0.0)
        above = np.maximum(wide - foot - self.shortest, 0.0)
        share = rng.uniform(0.0, 1.0, len(design)) * (below + above)
        return np.where(share < below, share - wide, wide - (below + above) + share)

    def _length(self, design: FloatArray) -> FloatArray:
        """Length (u,) of the lines in half ranges."""
        return np.abs(
            design[:, 4 + len(self.turning)] - design[np.arange(len(design)), self._axis(design)]
        )

    def _for_tool(self, x: FloatArray) -> FloatArray:
        """Coordinates (.., c) of the platform's origin that put the tool's origin where they say."""
        names, tool = self.robot.controlled, self.robot.tool[:3, 3]
        if not tool.any():
            return x
        moved = x.copy()
        offset = pose_from_coordinates(x, names, self.robot.home)[..., :3, :3] @ tool
        moved[..., [names.index(name) for name in POSITION]] -= offset
        return moved

    def _seen(self, x: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Poses (n, 4, 4), slopes (n, 3, p) of the tool's origin in tolerances, and which rows of x
        (n, c) are reached.
        """
        robot, free = self.robot, self.free_parameters
        values = robot.values[None]
        state = inverse_trials(robot, values, x[None])
        q = compute_readings(robot, values, state)
        reached = (state.status == Status.CONVERGED) & (state.closure_sign == self._home)
        for limit in evaluate_limits(robot, values, q, state):
            reached = reached & (limit.margin >= 0.0)
        D = (
            differentiate_pose(robot, values, q, state).parameters[0][..., free.places]
            * free.tolerance
        )
        reached = reached[0] & np.isfinite(D).all(axis=(1, 2))
        T = np.where(reached[:, None, None], state.T[0], np.eye(4))
        D = np.where(reached[:, None, None], D, 0.0)
        arm = T[:, :3, :3] @ robot.tool[:3, 3]
        return T, D[:, 3:] - geometry.hat(arm) @ D[:, :3], reached


def surface_rows(at: FloatArray, J: FloatArray, axis: IntArray) -> tuple[FloatArray, FloatArray]:
    """Rows of groups by their surfaces' unknowns and by the machine's: first the line's four, then
    the plane's.

    Parameters
    ----------
    at : (u, k, 3) [m] points. J : (u, k, 3, p) their slopes. axis : (u,) 0, 1 or 2, along which the
        lines run.

    Returns
    -------
    F : (u, k + 3, 5) by two turns, height and two shifts. A : (u, k + 3, p).
    """
    u, k = at.shape[:2]
    each = np.arange(u)
    n, *across = ((axis + j) % 3 for j in range(3))
    lever = at - at[:, :1]
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


def without_surfaces(F: FloatArray, A: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Project rows A (u, m, p) onto the complement of F (u, m, 5): (u, m - 5, p), and where F has
    full rank (u,).
    """
    norm = np.linalg.norm(F, axis=1, keepdims=True)
    Q, R = np.linalg.qr(F / np.where(norm > 0.0, norm, 1.0), mode="complete")
    shown = np.abs(np.diagonal(R, axis1=1, axis2=2)).min(axis=1) > DEGENERATE
    return np.swapaxes(Q[:, :, SURFACE:], 1, 2) @ A, shown
