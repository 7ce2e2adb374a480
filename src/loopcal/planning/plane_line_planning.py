# SPDX-License-Identifier: Apache-2.0
"""Plan points on planes and perpendicular lines, for a coordinate measuring machine that can only
hold coordinates.

The candidates are plane-line groups. Every coordinate of every point moves in turn by coordinate
exchange, so that log det of the information becomes large; see `loopcal.planning.plane_line_groups`
and docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.findings import Finding, report_finding
from loopcal.measure import Gaussian, Instrument
from loopcal.mechanism import POSITION, Mechanism, inverse
from loopcal.planning.constraints import ConstraintChecker, Constraints, build_checker, list_reasons
from loopcal.planning.design import (
    D,
    MovedDesign,
    PriorInformation,
    coordinate_exchange,
    find_observable_space,
    is_allowed,
)
from loopcal.planning.path import check_paths, locate_home
from loopcal.planning.plane_line_groups import AXIS, PlaneLineGroups
from loopcal.planning.plane_line_sensors import make_plane_line_instrument
from loopcal.planning.result import PlannedPoses
from loopcal.presentation import TableResult, draw
from loopcal.typing import BoolArray, FloatArray, IntArray, Progress, report_no_progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SWEEPS = 3
"""Sweeps over all coordinates: one more gains a few per cent."""
SPENT = 2
"""Points of a group that give no information on the machine: k + 3 rows, less five nuisance
parameters of the surfaces.
"""
DRAWN = 20
"""Groups drawn for each that is needed before the constraints are said to exclude all."""


@dataclass(frozen=True, eq=False)
class SurfaceOptions:
    """Options of `plan_surfaces`.

    Parameters
    ----------
    groups, points : number of planes with a perpendicular line, and of points of each.
    sigma : how exactly a coordinate is held [m], one standard deviation.
    constraints : on the poses. seed : of the first points.
    """

    groups: int = 10
    points: int = 8
    sigma: float = 1e-5
    constraints: Constraints = field(default_factory=Constraints)
    seed: int = 1


@dataclass(frozen=True, eq=False)
class SurfacePlan(TableResult):
    """Points to bring onto planes and lines.

    Attributes
    ----------
    robot : at the values for which the plan was made. options : of the plan.
    poses : group by group, in the order of visiting; readings are nominal.
    positions : (u, k, 3) of the origin of the tool [m].
    axis : (u,) 0, 1 or 2, along which each line runs.
    rank : number of parameter combinations that the groups determine.
    possible : number that planes and lines can determine. With fewer equations, the plan takes the
        tolerances as prior information.
    sd_first, sd_last : root mean square standard deviation of these, in tolerances, as drawn and as
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
        u, k = self.poses.groups.shape
        few = () if self.rank == self.possible else (self._report_few_groups(),)
        exhausted = report_finding("plan.sweeps-exhausted", sweeps=SWEEPS)
        return (
            report_finding(
                "plan.surfaces",
                robot=self.robot.name,
                groups=u,
                points=k,
                poses=u * k,
                via_home=int(self.poses.via_home.sum()),
            ),
            report_finding(
                "plan.surface-information",
                rank=self.rank,
                sd_first=self.sd_first,
                sd_last=self.sd_last,
            ),
            *few,
            *(() if self.is_converged else (exhausted,)),
            report_finding("plan.readings-are-measured"),
        )

    def _report_few_groups(self) -> Finding:
        """Return that the groups give fewer equations than could be determined."""
        u, k = self.poses.groups.shape
        return report_finding(
            "plan.few-groups",
            groups=u,
            points=k,
            equations=self.rank,
            rank=self.possible,
            needed=-(-self.possible // (k - SPENT)),
        )

    def plot(self) -> Figure:
        """Draw where the tool is at the points of each group, in three views."""
        return draw("draw_surface_plan", self)

    def __repr__(self) -> str:
        u, k = self.poses.groups.shape
        return f"SurfacePlan({self.robot.name}: {u} groups of {k} points, rank {self.rank})"

    def __str__(self) -> str:
        return "\n".join(str(finding) for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """Return everything by name for JSON, SI."""
        u, k = self.poses.groups.shape
        rows, roles = self.poses.to_dicts(self.robot), self.list_roles()
        poses = [
            {
                "name": row["name"],
                "group": f"group{i // k + 1}",
                "role": roles[i % k],
                "hold": list(self.list_fixed_coordinates(i // k, i % k)),
                **{name: row[name] for name in ("via_home", "commanded", "readings")},
            }
            for i, row in enumerate(rows)
        ]
        return {
            "robot": self.robot.name,
            "groups": u,
            "points": k,
            "rank": self.rank,
            "possible_rank": self.possible,
            "sd_first": self.sd_first,
            "sd_last": self.sd_last,
            "sigma": self.options.sigma,
            "seed": self.options.seed,
            "poses": poses,
            "findings": self.findings,
        }


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
    if options.groups < 1:
        raise EstimationError(f"{options.groups} groups; give 1 or more")
    designs, rows = _draw_allowed(
        groups, checker, options.groups, np.random.default_rng(options.seed)
    )
    possible = count_observable(groups, rows)
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
        np.rint(best.design[:, AXIS]).astype(np.int64),
        rank,
        possible,
        _rms_sd(rows[: options.groups], rank),
        _rms_sd(best.rows, rank),
        best.is_converged,
    )


def count_observable(groups: PlaneLineGroups, rows: FloatArray) -> int:
    """Return how many combinations of parameters groups with these rows (u, k - 2, p) determine."""
    return len(find_observable_space(rows, PriorInformation.none(len(groups.free))))


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

    Parameters
    ----------
    is_complete : whether so many groups determine all that such groups can determine; otherwise the
        tolerances take part. checker : further constraints on the poses.
    """
    count = len(groups.free)
    return coordinate_exchange(
        lambda _, moved: groups.linearize(moved, checker),
        design,
        groups.list_levels(),
        D(),
        PriorInformation.none(count) if is_complete else PriorInformation.from_tolerances(count),
        sweeps,
        progress,
    )


def _arrange_points(
    groups: PlaneLineGroups, checker: ConstraintChecker, design: FloatArray
) -> tuple[PlannedPoses, FloatArray]:
    """Return the poses of a design in their order, and the positions of the tool (u, k, 3) [m]."""
    x = groups.place_points(design)
    solution = inverse(groups.robot, x.reshape(-1, x.shape[2]))
    u, k = x.shape[:2]
    poses = PlannedPoses(
        tuple(
            f"{g + 1}.{f'p{i}' if i < 2 else f'plane{i - 1}'}" for g in range(u) for i in range(k)
        ),
        x.reshape(-1, x.shape[2]),
        solution.q,
        np.zeros(u * k, dtype=bool),
        _require_paths(checker, x),
        np.arange(u * k).reshape(u, k),
    )
    return poses, (solution.T @ groups.robot.tool)[:, :3, 3].reshape(u, k, 3)


def _draw_allowed(
    groups: PlaneLineGroups, checker: ConstraintChecker, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw groups that satisfy the constraints: at least `count`, and enough to find the rank.

    Returns
    -------
    design : (u, c). rows : (u, k - 2, p).

    Raises
    ------
    EstimationError
        Hardly any group satisfies the constraints.
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
            raise EstimationError(
                report_finding(
                    "plan.groups-excluded",
                    allowed=sum(map(len, designs)),
                    total=total,
                    points=groups.points,
                    reasons=list_reasons(check.count_violations()),
                )
            )
    return np.concatenate(designs), np.concatenate(rows)


def _require_paths(checker: ConstraintChecker, x: FloatArray) -> BoolArray:
    """Return before which points (u * k,), in their order, the path goes via home.

    Raises
    ------
    EstimationError
        No straight path leads from home to a point.
    """
    flat = x.reshape(-1, x.shape[2])
    home = np.broadcast_to(locate_home(checker.robot), flat.shape)
    from_home = check_paths(checker, home, flat)
    if not from_home.allowed.all():
        raise EstimationError(
            report_finding(
                "plan.points-isolated",
                isolated=int((~from_home.allowed).sum()),
                points=len(flat),
                reasons=list_reasons(from_home.count_violations()),
            )
        )
    return ~np.concatenate([[True], check_paths(checker, flat[:-1], flat[1:]).allowed])


def _rms_sd(rows: FloatArray, rank: int) -> float:
    """Return the root mean square standard deviation of the first `rank` directions of rows."""
    s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)[:rank]
    return float(np.sqrt(np.mean(1.0 / s**2))) if s[-1] > 0.0 else float("inf")
