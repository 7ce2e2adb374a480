# SPDX-License-Identifier: Apache-2.0
"""Plan points on planes and perpendicular lines, for a coordinate measuring machine that can only
hold coordinates.

The candidates are plane-line groups. Every coordinate of every point moves in turn by coordinate
exchange, so that log det of the information becomes large; see `PlaneLineGroups`
and docs/theory/planning.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from loopcal import geometry
from loopcal.checks import NOT_NEGATIVE, POSITIVE, Limit, Limited
from loopcal.errors import EstimationError
from loopcal.estimate.free_parameters import FreeParameters, select_free_parameters
from loopcal.findings import Finding, report_finding
from loopcal.measure.instrument import Gaussian, Instrument, Noise, Sensor
from loopcal.measure.kinds.surfaces import Line, Plane
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, pose_from_coordinates
from loopcal.mechanism.sensitivity import differentiate_pose
from loopcal.mechanism.solutions import inverse
from loopcal.mechanism.workspace import evaluate_limits, workspace_ranges
from loopcal.numerics.elimination import eliminate_columns
from loopcal.planning.constraints import ConstraintChecker, Constraints, build_checker, list_reasons
from loopcal.planning.design_space import (
    Criterion,
    PriorInformation,
    find_observable_space,
    is_allowed,
)
from loopcal.planning.exchange import MovedDesign, coordinate_exchange
from loopcal.planning.path import check_paths, locate_home
from loopcal.planning.pose_planning import POSE_FIELDS, Plan, PlannedPoses
from loopcal.results.description import Field, fields
from loopcal.results.result import DrawnResult
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

AXIS = 3  # column of the axis in a design
# Levels of every coordinate, in half ranges from the middle of the workspace.
LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
# Shortest allowed line, in half ranges of the workspace: a shorter one is hard to tell from a
# point.
SHORTEST = 0.25
# Groups out of reach are drawn anew in a workspace smaller by this factor, so many times.
SHRINKAGE, ROUNDS = 0.85, 12
SURFACE = 5  # nuisance parameters of a group: two rotations, a height, two shifts
SWEEPS = 3  # sweeps over all coordinates: one more gains a few per cent
# Points of a group that give no information on the machine: k + 3 rows, less five nuisance
# parameters of the surfaces.
SPENT = 2
DRAWN = 20  # groups drawn for each that is needed before the constraints are said to exclude all


@dataclass(frozen=True, eq=False)
class PlaneLineGroups(Limited):
    """Groups of poses whose points lie on a plane and on a line perpendicular to it.

    A design of u groups is (u, c): fractions of the half ranges of the workspace, from -1 to 1,
    except for the axis, which is 0, 1 or 2.
    """

    ERROR: ClassVar[type[Exception]] = EstimationError
    LIMITS: ClassVar[Mapping[str, Limit]] = {
        "points": Limit(
            lambda value: value >= 4,
            "at least 4: one on plane and line, one on the line, two more in the plane",
        ),
        "sigma": POSITIVE,
        "axes": Limit(
            lambda value: value and set(value) <= set(POSITION),
            f"one or more of {', '.join(POSITION)}",
        ),
    }
    robot: Mechanism  # moves in x, y and z, and states a workspace
    points: int  # k of a group, at least 4
    sigma: float  # of a held coordinate [m]
    axes: tuple[str, ...] = POSITION  # along which lines may run
    shortest: float = SHORTEST  # least length of a line, in half ranges

    def __post_init__(self) -> None:
        super().__post_init__()
        missing = tuple(name for name in POSITION if name not in self.robot.controlled)
        if missing:
            raise EstimationError.of(
                "plan.surfaces-not-followed", robot=self.robot.name, missing=missing
            )

    @cached_property
    def free(self) -> FreeParameters:
        """The free parameters of the machine, p of them."""
        return select_free_parameters(self.robot)

    @cached_property
    def orientation_names(self) -> tuple[str, ...]:
        """The m controlled coordinates that do not place the point."""
        return tuple(name for name in self.robot.controlled if name not in POSITION)

    @property
    def n_coordinates(self) -> int:
        """Number c of coordinates of a design: the place of p0, the axis, the place of p1 along it,
        two in the plane for each other point, and the orientation at each point.
        """
        return 5 + 2 * (self.points - 2) + self.points * len(self.orientation_names)

    def list_levels(self) -> tuple[FloatArray, ...]:
        """Return the levels to try, coordinate by coordinate."""
        levels = [np.array(LEVELS)] * self.n_coordinates
        levels[AXIS] = np.array([POSITION.index(name) for name in self.axes], dtype=np.float64)
        return tuple(levels)

    def draw(self, groups: int, seed: int | np.random.Generator = 0) -> FloatArray:
        """Draw a design (u, c): points and orientations anywhere in the workspace, each line along
        any of the axes and long enough.

        Groups with a pose out of reach are drawn anew, nearer and nearer to the middle.
        """
        rng = np.random.default_rng(seed)
        design, left = np.zeros((groups, self.n_coordinates)), np.arange(groups)
        for i in range(ROUNDS):
            half = SHRINKAGE**i
            new = rng.uniform(-half, half, (len(left), self.n_coordinates))
            new[:, AXIS] = rng.choice(self.list_levels()[AXIS], len(left))
            new[:, 4 + len(self.orientation_names)] = self._draw_line_ends(new, half, rng)
            design[left] = new
            left = left[np.isnan(self.linearize(new)).any(axis=(1, 2))]
            if not len(left):
                return design
        raise EstimationError.of(
            "plan.surfaces-out-of-reach", robot=self.robot.name, points=self.points
        )

    def place_points(self, design: FloatArray) -> FloatArray:
        """Return controlled coordinates (u, k, c) [m, rad] that bring the origin of the tool to the
        points of designs (u, c).
        """
        u, k, m = len(design), self.points, len(self.orientation_names)
        each, axis = np.arange(u), list_axes(design)
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
        x = coordinates[:, :, order]
        controlled, tool = self.robot.controlled, self.robot.tool[:3, 3]
        if tool.any():  # the origin of the tool is to be at the points, not that of the platform
            offset = pose_from_coordinates(x, controlled, self.robot.home)[..., :3, :3] @ tool
            x[..., [controlled.index(name) for name in POSITION]] -= offset
        return x

    def linearize(self, design: FloatArray, checker: ConstraintChecker | None = None) -> FloatArray:
        """Return the rows (u, k - 2, p) of groups (u, c) for the machine, the surfaces eliminated.

        They are divided by sigma, by deviations in spreads; NaN for a group with a pose that is
        out of reach or not allowed, too short a line, or points that do not determine the surfaces.

        checker : further constraints on the poses.
        """
        x = self.place_points(design)
        different, back = np.unique(x.reshape(-1, x.shape[2]), axis=0, return_inverse=True)
        origins, J, reached = self.linearize_points(different, checker)
        back, axis = back.reshape(x.shape[:2]), list_axes(design)
        F, A = linearize_surfaces(origins[back], J[back], axis)
        done = eliminate_columns(np.concatenate([F, A], axis=2), SURFACE)
        end, foot = design[:, 4 + len(self.orientation_names)], design[np.arange(len(design)), axis]
        allowed = (done.rank == SURFACE) & reached[back].all(axis=1)
        allowed &= np.abs(end - foot) >= self.shortest
        return np.where(allowed[:, None, None], done.rest[:, SURFACE:] / self.sigma, np.nan)

    def _draw_line_ends(
        self, design: FloatArray, half: float, rng: np.random.Generator
    ) -> FloatArray:
        """Draw the ends of lines (u,), evenly from what is `shortest` or more from p_0 and within
        `half` of the middle; if nothing is, the line has its least length.
        """
        foot = design[np.arange(len(design)), list_axes(design)]
        limit = min(max(half, self.shortest), 1.0)
        below = np.maximum(limit + foot - self.shortest, 0.0)
        above = np.maximum(limit - foot - self.shortest, 0.0)
        share = rng.uniform(0.0, 1.0, len(design)) * (below + above)
        return np.where(share < below, share - limit, limit - (below + above) + share)

    def linearize_points(
        self, x: FloatArray, checker: ConstraintChecker | None = None
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return the origins (n, 3) of the tool [m], their derivatives (n, 3, p) by deviations in
        spreads, and which rows of x (n, c) are reached and allowed.
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
        return arm + T[:, :3, 3], D[:, 3:] - geometry.hat(arm) @ D[:, :3], reached


def list_axes(design: FloatArray) -> IntArray:
    """Return the axes (u,) of the lines of a design: 0, 1 or 2."""
    return np.rint(design[:, AXIS]).astype(np.int64)


def linearize_surfaces(
    points: FloatArray, J: FloatArray, axis: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return rows of groups: four of the line, then those of the plane.

    points : (u, k, 3) [m]. J : (u, k, 3, p) their derivatives. axis : (u,) of the lines.
    Returns F : (u, k + 3, 5) by two rotations, height and two shifts. A : (u, k + 3, p) by the
        machine.
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


def make_plane_line_instrument(
    robot: Mechanism, axis: IntArray, points: IntArray, make_noise: Callable[[str, int], Noise]
) -> Instrument:
    """Return an instrument that measures a plane and a line along each axis that is used, unknown
    in each group.

    axis : (u,) 0, 1 or 2, along which the line of each group runs.
    points : (u, k) poses of each group: first the point on plane and line, then the other one on
        the line.
    make_noise : from the name of a kind and its number of gaps to their noise.
    """
    sensors = []
    for along in np.unique(axis):
        chosen = np.flatnonzero(axis == along)
        for kind, touched, gaps in (
            (Plane, np.delete(points[chosen], 1, axis=1), 1),
            (Line, points[chosen, :2], 2),
        ):
            surface = kind(
                unknown=("surface",),
                surface=f"surface-{POSITION[along]}",
                along=np.eye(3)[along],
                through=robot.home[:3, 3],
            )
            names = np.repeat([f"group{g + 1}" for g in chosen], touched.shape[1])
            noise = make_noise(kind.name, gaps)
            sensors.append(Sensor(surface, noise, rows=touched.ravel(), group=names))
    return Instrument(tuple(sensors)).with_tool(robot)


def find_line_axes(robot: Mechanism, coordinates: FloatArray, groups: int) -> IntArray:
    """Return the axes (u,) of the lines of points (n, c) [m, rad], group after group."""
    T = pose_from_coordinates(coordinates, robot.controlled, robot.home) @ robot.tool
    points = T[:, :3, 3].reshape(groups, -1, 3)
    return np.asarray(np.abs(points[:, 1] - points[:, 0]).argmax(axis=1))


@dataclass(frozen=True, eq=False)
class SurfaceOptions(Limited):
    """Options of `plan_surfaces`.

    Parameters
    ----------
    groups, points : number of planes with a perpendicular line, and of points of each.
    sigma : how exactly a coordinate is held [m], one standard deviation.
    constraints : on the poses. seed : of the first points.
    """

    ERROR: ClassVar[type[Exception]] = EstimationError
    LIMITS: ClassVar[Mapping[str, Limit]] = {"groups": POSITIVE, "seed": NOT_NEGATIVE}
    groups: int = 10
    points: int = 8
    sigma: float = 1e-5
    constraints: Constraints = field(default_factory=Constraints)
    seed: int = 1


@dataclass(frozen=True, eq=False)
class SurfacePlan(DrawnResult):
    """Points to bring onto planes and lines.

    Attributes
    ----------
    robot : at the values for which the plan was made. options : of the plan.
    poses : group by group, in the order of visiting; readings are nominal.
    positions : (u, k, 3) of the origin of the tool [m].
    axis : (u,) 0, 1 or 2, along which each line runs.
    rank : number of parameter combinations that the groups determine.
    possible : number that planes and lines can determine. With fewer equations, the plan takes the
        spreads as prior information.
    sd_first, sd_last : root mean square standard deviation of these, in spreads, as drawn and as
        planned.
    is_converged : whether moving points further gains hardly anything; False where the passes over
        the coordinates ran out.
    """

    robot: Mechanism
    options: SurfaceOptions
    poses: PlannedPoses
    positions: FloatArray
    axis: IntArray
    rank: int
    possible: int
    sd_first: float
    sd_last: float
    is_converged: bool = True

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields(robot="robot.name", groups=lambda plan: len(plan.poses.groups)),
        *fields(points=lambda plan: plan.poses.groups.shape[1], rank="", possible_rank="possible"),
        *fields("sd_first", "sd_last", sigma="options.sigma", seed="options.seed"),
        *fields(poses=lambda plan: plan.list_poses(), findings=""),
        *POSE_FIELDS,
    )
    LABELS: ClassVar[Mapping[str, Any]] = Plan.LABELS

    def list_roles(self) -> tuple[str, ...]:
        """Return the role of each point of a group: on both, on the line, in the plane."""
        return ("p0", "p1", *["plane"] * (self.poses.groups.shape[1] - 2))

    def list_fixed_coordinates(self, group: int, point: int) -> tuple[str, ...]:
        """Return the coordinates that a point must share with p0 of its group."""
        along = POSITION[self.axis[group]]
        across = tuple(name for name in POSITION if name != along)
        return {0: POSITION, 1: across}.get(point, (along,))

    @property
    def instrument(self) -> Instrument:
        """A plane and a line along each axis that is used, unknown in each group."""
        sigma = self.options.sigma
        return make_plane_line_instrument(
            self.robot, self.axis, self.poses.groups, lambda _, gaps: Gaussian(np.full(gaps, sigma))
        )

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that the plan reports."""
        (u, k), rank = self.poses.groups.shape, self.rank
        size = {"groups": u, "points": k}
        sd: dict[str, Any] = {"sd_first": self.sd_first, "sd_last": self.sd_last}
        via_home = int(self.poses.via_home.sum())
        found = [
            report_finding(
                "plan.surfaces", robot=self.robot.name, poses=u * k, via_home=via_home, **size
            ),
            report_finding("plan.surface-information", rank=rank, **sd),
        ]
        if rank != self.possible:
            needed = -(-self.possible // (k - SPENT))
            numbers = {"equations": rank, "rank": self.possible, "needed": needed}
            found.append(report_finding("plan.few-groups", **size, **numbers))
        if not self.is_converged:
            found.append(report_finding("plan.sweeps-exhausted", sweeps=SWEEPS))
        return (*found, report_finding("plan.readings-are-measured"))

    def __repr__(self) -> str:
        u, k = self.poses.groups.shape
        return f"SurfacePlan({self.robot.name}: {u} groups of {k} points, rank {self.rank})"

    def list_poses(self) -> list[dict[str, Any]]:
        """Return for each point its name, group, role, held coordinates, command and readings."""
        k, roles = self.poses.groups.shape[1], self.list_roles()
        return [
            {
                "name": row["name"],
                "group": f"group{i // k + 1}",
                "role": roles[i % k],
                "hold": list(self.list_fixed_coordinates(i // k, i % k)),
                **{name: row[name] for name in ("via_home", "commanded", "readings")},
            }
            for i, row in enumerate(self.poses.to_dicts(self.robot))
        ]


def plan_surfaces(
    robot: Mechanism, options: SurfaceOptions | None = None, progress: Progress = report_no_progress
) -> SurfacePlan:
    """Plan points on planes and perpendicular lines.

    Parameters
    ----------
    robot : at its present values. options : number of groups and points, constraints, seed.
    progress : receives the steps of the exchange that are done.

    Raises
    ------
    EstimationError
        Too few points, or no group that satisfies the constraints.
    """
    options = options or SurfaceOptions()
    groups = PlaneLineGroups(robot, options.points, options.sigma)
    checker = build_checker(robot, options.constraints)
    designs, rows = _draw_allowed(
        groups, checker, options.groups, np.random.default_rng(options.seed)
    )
    possible = len(find_observable_space(rows, PriorInformation.none(len(groups.free))))
    rank = min(possible, options.groups * (options.points - SPENT))
    best = improve_groups(
        groups, designs[: options.groups], SWEEPS, rank == possible, checker, progress
    )
    poses, positions = _arrange_points(groups, checker, best.design)
    return SurfacePlan(
        robot,
        options,
        poses,
        positions,
        list_axes(best.design),
        rank,
        possible,
        _rms_sd(rows[: options.groups], rank),
        _rms_sd(best.rows, rank),
        best.is_converged,
    )


def improve_groups(
    groups: PlaneLineGroups,
    design: FloatArray,
    sweeps: int,
    is_complete: bool = True,
    checker: ConstraintChecker | None = None,
    progress: Progress = report_no_progress,
) -> MovedDesign:
    """Improve the log determinant of the information of groups (u, c) by coordinate exchange; with
    0 sweeps they stay.

    is_complete : whether so many groups determine all that such groups can determine; otherwise the
        spreads take part.
    """
    count = len(groups.free)
    return coordinate_exchange(
        lambda _, moved: groups.linearize(moved, checker),
        design,
        groups.list_levels(),
        Criterion("D"),
        PriorInformation.none(count) if is_complete else PriorInformation.from_tolerances(count),
        sweeps,
        progress,
    )


def _arrange_points(
    groups: PlaneLineGroups, checker: ConstraintChecker, design: FloatArray
) -> tuple[PlannedPoses, FloatArray]:
    """Return the poses of a design in their order, and the positions of the tool (u, k, 3) [m].

    The path goes via home where the straight one is not allowed.
    """
    x = groups.place_points(design)
    (u, k), flat = x.shape[:2], x.reshape(-1, x.shape[2])
    from_home = check_paths(checker, np.broadcast_to(locate_home(groups.robot), flat.shape), flat)
    if not from_home.allowed.all():
        isolated = int((~from_home.allowed).sum())
        reasons = list_reasons(from_home.count_violations())
        raise EstimationError.of(
            "plan.points-isolated", isolated=isolated, points=len(flat), reasons=reasons
        )
    solution = inverse(groups.robot, flat)
    poses = PlannedPoses(
        tuple(
            f"{g + 1}.{f'p{i}' if i < 2 else f'plane{i - 1}'}" for g in range(u) for i in range(k)
        ),
        flat,
        solution.q,
        np.zeros(u * k, dtype=bool),
        ~np.concatenate([[True], check_paths(checker, flat[:-1], flat[1:]).allowed]),
        np.arange(u * k).reshape(u, k),
    )
    return poses, (solution.T @ groups.robot.tool)[:, :3, 3].reshape(u, k, 3)


def _draw_allowed(
    groups: PlaneLineGroups, checker: ConstraintChecker, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw groups (u, c) that satisfy the constraints: at least `count`, and enough to find the
    rank. Returns also their rows (u, k - 2, p).
    """
    enough = max(count, -(-len(groups.free) // (groups.points - SPENT)))
    designs: list[FloatArray] = []
    rows: list[FloatArray] = []
    total = 0
    while sum(map(len, designs)) < enough:
        new = groups.draw(enough, rng)
        new_rows = groups.linearize(new, checker)
        allowed = is_allowed(new_rows)
        designs.append(new[allowed])
        rows.append(new_rows[allowed])
        total += len(new)
        if total >= DRAWN * enough:
            poses = groups.place_points(new).reshape(-1, len(groups.robot.controlled))
            check = checker.check_poses(inverse(groups.robot, poses))
            raise EstimationError.of(
                "plan.groups-excluded",
                allowed=sum(map(len, designs)),
                total=total,
                points=groups.points,
                reasons=list_reasons(check.count_violations()),
            )
    return np.concatenate(designs), np.concatenate(rows)


def _rms_sd(rows: FloatArray, rank: int) -> float:
    """Return the root mean square standard deviation of the first `rank` directions of rows."""
    s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)[:rank]
    return float(np.sqrt(np.mean(1.0 / s**2))) if s[-1] > 0.0 else float("inf")
