# SPDX-License-Identifier: Apache-2.0
"""Corrections in tables, for controllers that compute with another geometry than the identified.

A controller adds a correction c that it interpolates linearly between nodes:

    commands   x + c(x) in place of the coordinates x
    height     z + c(x, y) in place of z, at the lowest z of the workspace
    readings   q_i + c_i(q_i) in place of the reading of actuator i
    skew       U^-1 x in place of x, with a unit upper triangle U, and axes that are scaled by s

At the nodes of the first two, FK(IK(x + c; controller); identified) = x. A reading needs a
correction that depends on all coordinates, except for errors of its own drive: the table of an
actuator is the least-squares fit to IK(x; identified) - IK(x; controller) over the workspace. What
remains is the error of the identified machine at other points. Skew: positions of the machine are
R U diag(s) x + b with a rotation R, by least squares; what remains is that after the best rigid
motion, because such a controller turns no frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Finding, Severity, report_finding
from loopcal.geometry import align_point_sets, wrap_angle
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import POSITION, TILT, get_dimension, read_coordinates
from loopcal.mechanism.solutions import forward, inverse, list_commanded
from loopcal.mechanism.workspace import draw_coordinates, sample_workspace, workspace_ranges
from loopcal.typing import FloatArray
from loopcal.units import Dimension

What = Literal["commands", "height", "readings", "skew"]

SHARE = 0.1  # of the largest error, which remains where nobody states another limit
STEPS = 5  # of the fixed-point iteration: each leaves the slope of the map, far below 1
CHECKS = 2000  # points between nodes at which the rest is found
FEWEST = 3  # nodes along an axis: with the ends alone, a symmetric error looks like none
ENOUGH = 1.2  # times the least rest of any number of nodes, at which more nodes do not help
LIGHT = 1e-3  # weight of a coarser table at a node, of a pose near it


class TableSize(NamedTuple):
    """What a controller corrects, and the most nodes of a table: in all, and along an axis."""

    what: What
    most: int
    most_along: int


@dataclass(frozen=True, eq=False)
class CorrectionTable:
    """Corrections at the nodes of a grid.

    axes : coordinate, or actuator -> its nodes [m, rad]. values : what is corrected -> corrections
    at all nodes, one axis of the array for each of `axes` [m, rad].
    """

    axes: Mapping[str, FloatArray]
    values: Mapping[str, FloatArray]


class _Machine(NamedTuple):
    """The identified robot, the geometry of its controller, and the coordinates to correct."""

    robot: Mechanism
    controller: Mechanism
    corrected: list[int]

    def lead(self, targets: FloatArray, commands: FloatArray) -> FloatArray:
        """Return how far (n, c) the robot stops from targets at commands (n, c), NaN where the
        machine does not get to one.
        """
        led = inverse(self.controller, commands)
        readings = np.where(led.converged[:, None], led.q, np.nan)
        return self.stop(targets, readings[:, list_commanded(self.controller)])

    def stop(self, targets: FloatArray, readings: FloatArray) -> FloatArray:
        """Return how far (n, c) the robot stops from targets at readings (n, a)."""
        reached = forward(self.robot, np.nan_to_num(readings))
        found = read_coordinates(reached.T, self.robot.controlled) - targets
        found = np.where(np.isin(self.robot.controlled, POSITION), found, wrap_angle(found))
        usable = reached.converged & np.isfinite(readings).all(axis=1)
        return np.where(usable[:, None], found, np.nan)

    def measure(self, misses: FloatArray, columns: Sequence[int]) -> tuple[float, float]:
        """Return the largest error in position and in orientation [m, rad] of some columns."""
        of = np.isin(np.arange(misses.shape[1]), columns)
        is_length = np.isin(self.robot.controlled, POSITION)
        parts = (misses[:, of & is_length], misses[:, of & ~is_length])
        position, angle = (float(np.linalg.norm(p, axis=1).max(initial=0.0)) for p in parts)
        return position, angle

    def weigh(self, misses: FloatArray) -> float:
        """Return the larger of both [m], an angle by its arc at the robot's size."""
        position, angle = self.measure(misses, self.corrected)
        return max(position, self.robot.size * angle)


def make_tables(
    robot: Mechanism, controller: Mechanism, size: TableSize, limit: float | None = None
) -> tuple[tuple[CorrectionTable, ...], Finding]:
    """Return the tables with which a controller leads the identified robot to its commands: one,
    or one for each actuator; and what remains between the nodes.

    controller : the geometry that it computes with. limit : error that may remain [m], of an
    orientation by its arc at the robot's size; a tenth of the largest error by default.

    DataError : the controller errs nowhere or has other coordinates, or a node is out of reach.
    """
    names, reason = robot.controlled, ""
    if set(names) & set(TILT):
        reason = "tilt"
    elif size.what in ("height", "skew") and names[:3] != ("x", "y", "z"):
        reason = "height"
    elif controller.controlled != names or len(controller.actuators) != len(robot.actuators):
        reason = "other"
    elif np.array_equal(controller.values, robot.values):
        reason = "equal"
    if reason:
        raise DataError(_refuse(robot, reason))
    ranges = workspace_ranges(robot)
    moved = {"height": ["z"], "skew": ["x", "y", "z"]}.get(size.what, list(names))
    machine = _Machine(robot, controller, [names.index(name) for name in moved])
    axes, home = list(names), read_coordinates(robot.home, names)
    if size.what == "height":
        axes, home[names.index("z")] = ["x", "y"], ranges["z"][0]
    places = [names.index(name) for name in axes]

    def place(points: FloatArray) -> FloatArray:
        targets = np.tile(home, (len(points), 1))
        targets[:, places] = points
        return targets

    if size.what == "readings":
        targets = sample_workspace(robot, 4 * CHECKS).coordinates
    else:
        targets = place(draw_coordinates(np.random.default_rng(0), tuple(axes), ranges, CHECKS))
    before = machine.lead(targets, targets)
    targets, before = (rows[np.isfinite(before).all(axis=1)] for rows in (targets, before))
    if not len(targets):
        raise DataError(_refuse(robot, "nowhere"))
    tables, after = list[CorrectionTable](), before
    if size.what == "skew":
        tables, before, after = _fit_skew(machine, targets, before)
    limit = SHARE * machine.weigh(before) if limit is None else limit
    if size.what == "readings":
        tables, after = _fit_readings(machine, targets, limit, size.most_along)
    elif size.what != "skew":
        spans = [ranges[name] for name in axes]
        nodes, grid, after = _choose_grid(machine, place, targets[:, places], spans, limit, size)
        values = dict(zip(moved, np.moveaxis(grid, -1, 0), strict=True))
        tables = [CorrectionTable(dict(zip(axes, nodes, strict=True)), values)]
    return tuple(tables), _report(machine, size, tables, (before, after), limit)


def _refuse(robot: Mechanism, reason: str, point: str = "") -> Finding:
    """Return why there is no table of a robot."""
    return report_finding("files.no-table", robot=robot.name, reason=reason, point=point)


def _report(
    machine: _Machine,
    size: TableSize,
    tables: Sequence[CorrectionTable],
    misses: Sequence[FloatArray],
    limit: float,
) -> Finding:
    """Return how large errors were, what remains, and what no table of this sort corrects."""
    robot, others = machine.robot, tuple(set(range(misses[0].shape[1])) - {*machine.corrected})
    is_met = machine.weigh(misses[1]) <= limit
    sizes = [machine.measure(rows, machine.corrected) for rows in misses]
    sizes.append((limit, limit / robot.size if sizes[0][1] else 0.0))
    data: dict[str, Any] = {"what": size.what, "points": len(misses[1]), "is_met": is_met}
    data["nodes"] = [" x ".join(str(len(n)) for n in t.axes.values()) for t in tables if t.axes]
    for key, (position, angle) in zip(("before", "after", "limit"), sizes, strict=True):
        data[key] = robot.to_quantity(position, Dimension.LENGTH)
        data[f"angle_{key}"] = robot.to_quantity(angle, Dimension.ANGLE) if angle else 0
    data["others"] = tuple(robot.controlled[i] for i in others)
    rests = zip(
        machine.measure(misses[1], others), (Dimension.LENGTH, Dimension.ANGLE), strict=True
    )
    data["rests"] = [str(robot.to_quantity(rest, dimension)) for rest, dimension in rests if rest]
    level = Severity.INFO if is_met and not others else Severity.WARNING
    return report_finding("files.table-remains", level, **data)


def _choose_grid(
    machine: _Machine,
    place: Callable[[FloatArray], FloatArray],
    checks: FloatArray,
    spans: Sequence[tuple[float, float]],
    limit: float,
    size: TableSize,
) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Return the nodes along each axis, corrections (.., c) at all of them, and what remains (n, c)
    at the checks (n, d) and between neighbors.

    Linear interpolation errs by the square of the spacing: n nodes become so many that all axes
    contribute alike.
    """
    from scipy.interpolate import RegularGridInterpolator

    columns, dims = machine.corrected, len(spans)
    counts = np.full(dims, FEWEST)
    while True:
        nodes = [np.linspace(*span, n) for span, n in zip(spans, counts.tolist(), strict=True)]
        points = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, dims)
        targets = place(points)
        commands = targets.copy()
        for _ in range(STEPS):
            commands[:, columns] -= machine.lead(targets, commands)[:, columns]
        lost = np.flatnonzero(~np.isfinite(commands).all(axis=1))
        if len(lost):
            pairs = zip(machine.robot.controlled, targets[lost[0]].tolist(), strict=True)
            found = [f"{n} {machine.robot.to_quantity(v, get_dimension(n))}" for n, v in pairs]
            raise DataError(_refuse(machine.robot, "reach", ", ".join(found)))
        grid = (commands - targets)[:, columns].reshape(*counts, len(columns))
        correct = RegularGridInterpolator(nodes, grid)

        def remain(points: FloatArray) -> FloatArray:
            targets = place(points)
            commands = targets.copy()
            commands[:, columns] += correct(points)  # noqa: B023  # used in this round only
            found = machine.lead(targets, commands)
            return found[np.isfinite(found).all(axis=1)]

        rest, along = [remain(checks)], []
        for i, own in enumerate(nodes):
            middle = points[points[:, i] < own[-1]]
            middle = middle[:: max(1, len(middle) // CHECKS)]
            rest.append(remain(middle + 0.5 * (own[1] - own[0]) * np.eye(dims)[i]))
            along.append(machine.weigh(rest[-1]))
        after = np.concatenate(rest)
        if machine.weigh(after) <= limit:
            return nodes, grid, after
        shares = np.array(along) / limit * max(1, sum(e > 0.01 * limit for e in along))
        growth = np.clip(np.sqrt(shares), 1.0, 8.0)
        if growth.max() < 1.05:
            growth *= 1.2
        wanted = np.ceil((counts - 1) * growth).astype(int) + 1
        wanted = np.minimum(wanted, size.most_along)
        while wanted.prod() > size.most:
            k = int(np.argmax(wanted / counts))
            if wanted[k] <= counts[k]:
                break
            wanted[k] -= 1
        if (wanted == counts).all():
            return nodes, grid, after
        counts = wanted


def _fit_skew(
    machine: _Machine, targets: FloatArray, before: FloatArray
) -> tuple[list[CorrectionTable], FloatArray, FloatArray]:
    """Return skews and scales, errors at targets (n, c), and what remains of them."""
    places, led = targets[:, :3], (targets + before)[:, :3]
    A = np.linalg.lstsq(*(x - x.mean(axis=0) for x in (places, led)), rcond=None)[0].T
    T = np.linalg.qr(A)[1]
    T *= np.sign(np.diag(T))[:, None]
    scale, U = np.diag(T).copy(), T / np.diag(T)
    if any(actuator.weights for actuator in machine.controller.actuators):
        scale[:2] = scale[:2].mean()  # both belts drive x and y
    commands = np.column_stack([np.linalg.solve(U, places.T).T / scale, targets[:, 3:]])
    after = machine.lead(targets, commands)
    usable = np.isfinite(after).all(axis=1)
    aligned = []
    for misses in (before[usable], after[usable]):
        led = places[usable] + misses[:, :3]
        M = align_point_sets(led, places[usable])
        left = led @ M[:3, :3].T + M[:3, 3] - places[usable]
        aligned.append(np.column_stack([left, misses[:, 3:]]))
    values = {"xy": U[0, 1], "xz": U[0, 2], "yz": U[1, 2], **dict(zip("xyz", scale, strict=True))}
    return [CorrectionTable({}, values)], *aligned


def _fit_readings(
    machine: _Machine, targets: FloatArray, limit: float, most: int
) -> tuple[list[CorrectionTable], FloatArray]:
    """Return a table for each commanded actuator, fitted to all but `CHECKS` of the poses (n, c),
    and what remains at these.
    """
    led, own = (inverse(robot, targets) for robot in (machine.controller, machine.robot))
    usable, commanded = led.converged & own.converged, list_commanded(machine.robot)
    q, change = led.q[usable][:, commanded], (own.q - led.q)[usable][:, commanded]
    targets, checked = targets[usable][:CHECKS], q[:CHECKS]
    names = [a.name for a in machine.robot.actuators if a.reference is None]
    tables = [(row[[row.argmin(), row.argmax()]], np.zeros(2)) for row in q.T]
    tried, count = list[tuple[float, list[tuple[FloatArray, FloatArray]], FloatArray]](), FEWEST
    while True:
        fitted = zip(q[CHECKS:].T, change[CHECKS:].T, tables, strict=True)
        tables = [_fit_table(x, y, table, count) for x, y, table in fitted]
        shifts = [np.interp(x, *table) for x, table in zip(checked.T, tables, strict=True)]
        after = machine.stop(targets, checked + np.column_stack(shifts))
        tried.append((machine.weigh(after), tables, after))
        if tried[-1][0] <= limit or count == most:
            break
        count = min(2 * count - 1, most)
    enough = max(limit, ENOUGH * min(rest for rest, *_ in tried))
    _, tables, after = next(trial for trial in tried if trial[0] <= enough)
    pairs = zip(names, tables, strict=True)
    return [CorrectionTable({name: x}, {name: y}) for name, (x, y) in pairs], after


def _fit_table(
    x: FloatArray, y: FloatArray, coarse: tuple[FloatArray, FloatArray], count: int
) -> tuple[FloatArray, FloatArray]:
    """Return nodes, and the values of the straight lines between them that fit y(x) best; where no
    pose is near a node, a coarser table counts.
    """
    from scipy.interpolate import make_lsq_spline

    nodes = np.linspace(coarse[0][0], coarse[0][-1], count)
    inner = (x > nodes[0]) & (x < nodes[-1])
    places = np.concatenate([x[inner], nodes])
    known = np.concatenate([y[inner], np.interp(nodes, *coarse)])
    weights = np.repeat([1.0, LIGHT], [inner.sum(), count])
    order = np.argsort(places)
    knots = nodes[[0, *range(count), -1]]
    return nodes, make_lsq_spline(places[order], known[order], knots, 1, weights[order])(nodes)
