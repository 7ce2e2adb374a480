# SPDX-License-Identifier: Apache-2.0
"""Which points to bring onto planes and perpendicular lines, where a coordinate measuring machine
can only hold coordinates.

Groups move by coordinate exchange, every coordinate of every point in turn, so that log det of what
they tell becomes large; see `loopcal.planning.groups` and docs/theory/planning.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.errors import EstimationError
from loopcal.measure import Gaussian, Instrument, Sensor
from loopcal.measure.kinds.line import Line
from loopcal.measure.kinds.plane import Plane
from loopcal.mechanism import POSITION, Mechanism, inverse
from loopcal.planning.candidates import home_coordinates
from loopcal.planning.constraints import Constraints, Rules, refusals, rules
from loopcal.planning.coordinate import coordinate_exchange
from loopcal.planning.criteria import D
from loopcal.planning.design import Start, directions
from loopcal.planning.groups import PlaneAndLine
from loopcal.planning.paths import follow
from loopcal.typing import BoolArray, FloatArray, IntArray

SWEEPS = 3
"""Over all coordinates: after these the gain of one more is a few per cent."""
SPENT = 2
"""Points of a group that tell nothing of the machine: k + 3 rows, less five unknowns of the
surfaces.
"""
DRAWN = 20
"""Groups drawn at random for each that is needed, before the constraints are said to leave none."""


@dataclass(frozen=True, eq=False)
class SurfacePlan:
    """Points to bring onto planes and lines.

    Attributes
    ----------
    robot : for which it was made. coordinates : (u, k, c) controlled coordinates [m, rad]; readings
        : (u, k, a) nominal.
    held : (u, k, 3) place of the tool's origin [m]. axis : (u,) 0, 1 or 2, along which each line
        runs.
    via_home : (u, k) True where home must be visited before. sigma : of a held coordinate [m].
    rank : combinations of the p parameters that the groups tell.
    first, last : root mean square standard deviation of these, in tolerances, as drawn and as
        planned. seed : of the draw.
    """

    robot: Mechanism
    coordinates: FloatArray
    readings: FloatArray
    held: FloatArray
    axis: IntArray
    via_home: BoolArray
    sigma: float
    rank: int
    first: float
    last: float
    seed: int

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the poses, group by group: `1.p0`, `1.p1`, `1.plane1`, ..."""
        u, k = self.coordinates.shape[:2]
        return tuple(
            f"{g + 1}.{role if i < 2 else f'plane{i - 1}'}"
            for g in range(u)
            for i, role in enumerate(self.roles(k))
        )

    @staticmethod
    def roles(k: int) -> tuple[str, ...]:
        """Role of each point of a group: the foot, the one on the line, those in the plane."""
        return ("p0", "p1", *["plane"] * (k - 2))

    def hold(self, group: int, point: int) -> tuple[str, ...]:
        """Coordinates of the measuring machine that a point must agree in with the foot of its
        group.
        """
        along = POSITION[self.axis[group]]
        across = tuple(name for name in POSITION if name != along)
        return {0: POSITION, 1: across}.get(point, (along,))

    def instrument(self) -> Instrument:
        """Return what looks at the poses: a plane and a line along each axis that is used, unknown
        in each group.
        """
        u, k = self.coordinates.shape[:2]
        number = np.arange(u * k).reshape(u, k)
        sensors = []
        for axis in np.unique(self.axis):
            groups = np.flatnonzero(self.axis == axis)
            stated = {
                "unknown": ("surface",),
                "surface": f"surface-{POSITION[axis]}",
                "along": np.eye(3)[axis],
            }
            stated |= {"through": self.robot.home[:3, 3]}
            pairs = (
                (Plane(**stated), np.delete(number[groups], 1, axis=1), 1),
                (Line(**stated), number[groups, :2], 2),
            )
            for kind, points, m in pairs:
                names = np.repeat([f"group{g + 1}" for g in groups], points.shape[1])
                sensors.append(
                    Sensor(kind, Gaussian(np.full(m, self.sigma)), rows=points.ravel(), group=names)
                )
        return Instrument(tuple(sensors)).with_tool(self.robot)

    def __str__(self) -> str:
        u, k = self.coordinates.shape[:2]
        via = int(self.via_home.sum())
        ways = f"; {via} of the ways go via home" if via else ""
        lines = [
            (
                f"{u} planes with a perpendicular line, {k} points each: {u * k} poses of "
                f"{self.robot.name}{ways}"
            )
        ]
        lines.append(
            f"{self.rank} parameter combinations can be told, to {self.last:.3g} of a tolerance "
            "(rms); as first drawn "
            f"{self.first:.3g}"
        )
        lines.append(
            "note: readings are what is measured: bring the point to where the held coordinates "
            "agree, and write them down"
        )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Everything by name for JSON, SI."""
        u, k = self.coordinates.shape[:2]
        actuators = [actuator.name for actuator in self.robot.actuators]
        poses = [
            {
                "name": self.labels[g * k + i],
                "group": f"group{g + 1}",
                "role": role,
                "hold": list(self.hold(g, i)),
                "via_home": bool(self.via_home[g, i]),
                "commanded": dict(
                    zip(self.robot.controlled, self.coordinates[g, i].tolist(), strict=True)
                ),
                "readings": dict(zip(actuators, self.readings[g, i].tolist(), strict=True)),
            }
            for g in range(u)
            for i, role in enumerate(self.roles(k))
        ]
        numbers = {
            "rank": self.rank,
            "sd_first": self.first,
            "sd_last": self.last,
            "sigma": self.sigma,
            "seed": self.seed,
        }
        return {"robot": self.robot.name, "groups": u, "points": k, **numbers, "poses": poses}


def plan_surfaces(
    robot: Mechanism,
    groups: int = 10,
    points: int = 8,
    sigma: float = 1e-5,
    constraints: Constraints | None = None,
    seed: int = 1,
) -> SurfacePlan:
    """Plan points on planes and perpendicular lines.

    Parameters
    ----------
    robot : at the values that are believed now. groups, points : number of planes, and of points of
        each.
    sigma : how exactly a coordinate is held [m]. constraints : what poses must keep to. seed : of
        the first points.

    Raises
    ------
    EstimationError
        Fewer equations than what they can tell, too few points, or no group that keeps to the
        constraints.
    """
    planned, judged = PlaneAndLine(robot, points, sigma), rules(robot, constraints or Constraints())
    if groups < 1:
        raise EstimationError(f"{groups} groups were asked for; ask for 1 or more")
    drawn, many = _drawn(planned, judged, groups, np.random.default_rng(seed))
    start = Start.nothing(len(planned.free_parameters))
    rank = len(directions(many, start))
    if groups * (planned.points - SPENT) < rank:
        raise EstimationError(
            f"{groups} groups of {points} points give {groups * (planned.points - SPENT)} "
            f"equations, but {rank} parameter "
            f"combinations can be told; plan at least {-(-rank // (planned.points - SPENT))} "
            "groups, or more points"
        )
    found = coordinate_exchange(
        lambda which, values: _allowed_rows(planned, judged, values),
        drawn[:groups],
        planned.levels(),
        D(),
        start,
        SWEEPS,
    )
    x = planned.coordinates(found.design)
    solution = inverse(robot, x.reshape(-1, x.shape[2]))
    held = (solution.T @ robot.tool)[:, :3, 3].reshape(*x.shape[:2], 3)
    spreads = [_spread(many[:groups], rank), _spread(found.rows, rank)]
    axis = np.rint(found.design[:, 3]).astype(np.int64)
    readings = solution.q.reshape(*x.shape[:2], -1)
    return SurfacePlan(
        robot, x, readings, held, axis, _ways(judged, x), sigma, rank, spreads[0], spreads[1], seed
    )


def _drawn(
    planned: PlaneAndLine, judged: Rules, groups: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw groups that keep to the constraints, at least as many as are needed, and enough to tell
    what all could.

    Returns
    -------
    design : (u, c). rows : (u, k - 2, p).

    Raises
    ------
    EstimationError
        Hardly any group keeps to the constraints.
    """
    enough = max(groups, -(-len(planned.free_parameters) // (planned.points - SPENT)))
    design: list[FloatArray] = []
    rows: list[FloatArray] = []
    tried = 0
    while sum(map(len, design)) < enough:
        new = planned.random(enough, rng)
        found = _allowed_rows(planned, judged, new)
        good = np.isfinite(found).all(axis=(1, 2))
        design.append(new[good])
        rows.append(found[good])
        tried += len(new)
        if tried >= DRAWN * enough:
            poses = planned.coordinates(new).reshape(-1, len(planned.robot.controlled))
            why = refusals(judged.judge(inverse(planned.robot, poses)).counts())
            raise EstimationError(
                f"only {sum(map(len, design))} of {tried} groups of {planned.points} points keep "
                f"to the constraints ({why}); "
                "relax one, narrow the workspace in the robot file, or ask for fewer points"
            )
    return np.concatenate(design), np.concatenate(rows)


def _allowed_rows(planned: PlaneAndLine, judged: Rules, design: FloatArray) -> FloatArray:
    """Rows (u, k - 2, p) of groups, NaN where a pose breaks a constraint."""
    rows = planned.rows(design)
    finite = np.flatnonzero(np.isfinite(rows).all(axis=(1, 2)))
    x = planned.coordinates(design[finite])
    allowed = (
        judged.judge(inverse(planned.robot, x.reshape(-1, x.shape[2])))
        .allowed.reshape(x.shape[:2])
        .all(axis=1)
    )
    rows[finite[~allowed]] = np.nan
    return rows


def _ways(judged: Rules, x: FloatArray) -> BoolArray:
    """Where home must be visited before a point (u, k), in their order.

    Raises
    ------
    EstimationError
        A point to which no straight way leads from home.
    """
    flat = x.reshape(-1, x.shape[2])
    home = np.broadcast_to(home_coordinates(judged.robot), flat.shape)
    reached = follow(judged, home, flat)
    if not reached.allowed.all():
        raise EstimationError(
            f"no straight way leads from home to {int((~reached.allowed).sum())} of the planned "
            "points: "
            f"{refusals(reached.counts())}; relax a constraint, or plan with another seed"
        )
    direct = np.concatenate([[True], follow(judged, flat[:-1], flat[1:]).allowed])
    return ~direct.reshape(x.shape[:2])


def _spread(rows: FloatArray, rank: int) -> float:
    """Root mean square standard deviation of the first `rank` directions of rows."""
    s = np.linalg.svd(rows.reshape(-1, rows.shape[-1]), compute_uv=False)[:rank]
    return float(np.sqrt(np.mean(1.0 / s**2))) if s[-1] > 0.0 else float("inf")
