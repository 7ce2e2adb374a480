# SPDX-License-Identifier: Apache-2.0
"""Corrections in tables, for controllers that compute with another geometry than the identified.

A controller adds a correction c that it interpolates linearly between nodes:

    commands   x + c(x) in place of the coordinates x
    height     z + c(x, y) in place of z, at the lowest z of the workspace
    readings   q_i + c_i(q_i) in place of the reading of actuator i

At the nodes of the first two, FK(IK(x + c; controller); identified) = x. A reading needs a
correction that depends on all coordinates, except for errors of its own drive: the table of an
actuator is the least-squares fit to IK(x; identified) - IK(x; controller) over the workspace. What
remains is the error of the identified machine at other points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Finding, Severity, report_finding
from loopcal.geometry import wrap_angle
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.platform_coordinates import TILT, get_dimension, read_coordinates
from loopcal.mechanism.solutions import forward, inverse, list_commanded
from loopcal.mechanism.workspace import draw_coordinates, sample_workspace, workspace_ranges
from loopcal.typing import BoolArray, FloatArray
from loopcal.units import Dimension

What = Literal["commands", "height", "readings"]

SHARE = 0.1  # of the largest error, which remains where nobody states another limit
STEPS = 5  # of the fixed-point iteration: each leaves the slope of the map, far below 1
CHECKS = 2000  # points between nodes at which the rest is found
FEWEST = 3  # nodes along an axis: with the ends alone, a symmetric error looks like none
ENOUGH = 1.2  # times the least rest of any number of nodes, at which more nodes do not help
SMALL = 0.05  # of the limit: a table that leaves less of a reading needs no more nodes
SMOOTHING = 1e-3  # weight of the bend at a node, of a pose near it
ROUNDING = 1e-9  # errors below this share of the robot's size are rounding


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

    @property
    def are_lengths(self) -> BoolArray:
        """Which controlled coordinates (c,) are lengths."""
        return np.array([get_dimension(n) is Dimension.LENGTH for n in self.robot.controlled])

    def miss(self, targets: FloatArray, commands: FloatArray) -> FloatArray:
        """Return how far (n, c) the robot stops from targets at commands (n, c), NaN where the
        machine does not get to one.
        """
        led = inverse(self.controller, commands)
        return self.stop(targets, led.q[:, list_commanded(self.controller)], led.converged)

    def stop(self, targets: FloatArray, readings: FloatArray, usable: BoolArray) -> FloatArray:
        """Return how far (n, c) the robot stops from targets at readings (n, a)."""
        reached = forward(self.robot, np.where(usable[:, None], readings, 0.0))
        found = read_coordinates(reached.T, self.robot.controlled) - targets
        found = np.where(self.are_lengths, found, wrap_angle(found))
        return np.where((usable & reached.converged)[:, None], found, np.nan)

    def sizes(self, misses: FloatArray, columns: Sequence[int]) -> FloatArray:
        """Return the error in position, and in orientation (n, 2) [m, rad] of some columns."""
        of = np.zeros(len(self.are_lengths), bool)
        of[list(columns)] = True
        squares = misses**2
        lengths = squares[:, of & self.are_lengths].sum(axis=1)
        return np.sqrt(np.column_stack([lengths, squares[:, of & ~self.are_lengths].sum(axis=1)]))

    def weigh(self, misses: FloatArray) -> FloatArray:
        """Return the larger of both (n,) [m], an angle by its arc at the robot's size."""
        return (self.sizes(misses, self.corrected) * [1.0, self.robot.size]).max(axis=1)


def make_tables(
    robot: Mechanism, controller: Mechanism, size: TableSize, limit: float | None = None
) -> tuple[tuple[CorrectionTable, ...], tuple[Finding, ...]]:
    """Return the tables with which a controller leads the identified robot to its commands: one,
    or one for each actuator; and what remains between the nodes.

    controller : the geometry that it computes with. limit : error that may remain [m], of an
    orientation by its arc at the robot's size; a tenth of the largest error by default.

    DataError : the controller errs nowhere, or a node is out of reach.
    """
    names = robot.controlled
    if set(names) & set(TILT) or (size.what == "height" and not {"x", "y", "z"} <= set(names)):
        raise DataError(
            report_finding("files.no-table", robot=robot.name, names=names, needed=size.what)
        )
    if controller.controlled != names or len(controller.actuators) != len(robot.actuators):
        raise DataError(report_finding("files.controller-of-another", robot=controller.name))
    ranges = workspace_ranges(robot)
    moved = ["z"] if size.what == "height" else names
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
    before = machine.miss(targets, targets)
    targets, before = (rows[np.isfinite(before).all(axis=1)] for rows in (targets, before))
    largest = float(machine.weigh(before).max(initial=0.0))
    if largest < ROUNDING * robot.size:
        raise DataError(report_finding("files.nothing-to-correct", robot=robot.name))
    limit = SHARE * largest if limit is None else limit
    if size.what == "readings":
        tables, after = _fit_readings(machine, targets, limit, size)
    else:
        spans = [ranges[name] for name in axes]
        nodes, grid, after = _choose_grid(machine, place, targets[:, places], spans, limit, size)
        values = dict(zip(moved, np.moveaxis(grid, -1, 0), strict=True))
        tables = (CorrectionTable(dict(zip(axes, nodes, strict=True)), values),)
    return tables, tuple(_report(machine, size, tables, (before, after), limit))


def _report(
    machine: _Machine,
    size: TableSize,
    tables: Sequence[CorrectionTable],
    misses: Sequence[FloatArray],
    limit: float,
) -> list[Finding]:
    """Return how large errors were, what remains, and what no table of this sort corrects."""
    robot, data = machine.robot, dict[str, Any](angle_before=0, angle_after=0, angle_limit=0)
    for key, rows in zip(("before", "after"), misses, strict=True):
        position, angle = machine.sizes(rows, machine.corrected).max(axis=0).tolist()
        data[key] = robot.to_quantity(position, Dimension.LENGTH)
        if angle:
            data[f"angle_{key}"] = robot.to_quantity(angle, Dimension.ANGLE)
            data["angle_limit"] = robot.to_quantity(limit / robot.size, Dimension.ANGLE)
    largest = float(machine.weigh(misses[1]).max())
    is_met = largest <= limit
    data |= {"limit": robot.to_quantity(limit, Dimension.LENGTH), "is_met": is_met}
    data["nodes"] = [" x ".join(str(len(n)) for n in table.axes.values()) for table in tables]
    data["points"] = len(misses[1])
    data["what"] = size.what
    level = Severity.INFO if is_met else Severity.WARNING
    found = [report_finding("files.table-remains", level, **data)]
    others = [i for i in range(len(robot.controlled)) if i not in machine.corrected]
    if others:
        left = float(machine.sizes(misses[1], others)[:, 0].max())
        names = tuple(robot.controlled[i] for i in others)
        shown = robot.to_quantity(left, Dimension.LENGTH)
        found.append(report_finding("files.table-leaves", names=names, rest=shown))
    return found


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
            commands[:, columns] -= machine.miss(targets, commands)[:, columns]
        lost = np.flatnonzero(~np.isfinite(commands).all(axis=1))
        if len(lost):
            shown = ", ".join(
                f"{name} {machine.robot.to_quantity(value, get_dimension(name))}"
                for name, value in zip(
                    machine.robot.controlled, targets[lost[0]].tolist(), strict=True
                )
            )
            raise DataError(report_finding("files.node-out-of-reach", point=shown))
        grid = (commands - targets)[:, columns].reshape(*counts, len(columns))
        correct = RegularGridInterpolator(nodes, grid)

        def remain(points: FloatArray) -> FloatArray:
            targets = place(points)
            commands = targets.copy()
            commands[:, columns] += correct(points)  # noqa: B023  # used in this round only
            found = machine.miss(targets, commands)
            return found[np.isfinite(found).all(axis=1)]

        rest, along = [remain(checks)], []
        for i, own in enumerate(nodes):
            middle = points[points[:, i] < own[-1]]
            middle = middle[:: max(1, len(middle) // CHECKS)]
            rest.append(remain(middle + 0.5 * (own[1] - own[0]) * np.eye(dims)[i]))
            along.append(float(machine.weigh(rest[-1]).max()))
        after = np.concatenate(rest)
        largest = float(machine.weigh(after).max())
        if largest <= limit:
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


def _fit_readings(
    machine: _Machine, targets: FloatArray, limit: float, size: TableSize
) -> tuple[tuple[CorrectionTable, ...], FloatArray]:
    """Return a table for each commanded actuator, fitted to all but `CHECKS` of the poses (n, c),
    and what remains (n, c) at all of them.
    """
    robot, controller = machine.robot, machine.controller
    led, own = inverse(controller, targets), inverse(robot, targets)
    usable = led.converged & own.converged
    commanded = list_commanded(robot)
    q, wanted = led.q[:, commanded], own.q[:, commanded]
    is_check = usable & (np.arange(len(q)) < CHECKS)
    is_fitted = usable & ~is_check
    names = [a.name for a, use in zip(robot.actuators, commanded, strict=True) if use]
    from scipy.sparse import csr_array, vstack
    from scipy.sparse.linalg import lsmr

    fits: list[list[_Fit]] = []
    largest = limit / max(1.0, robot.size)
    for reading, change in zip(q.T, (wanted - q).T, strict=True):
        low, high = float(reading[usable].min()), float(reading[usable].max())
        fits.append([])
        count = FEWEST
        while not fits[-1] or (
            len(fits[-1][-1].nodes) < size.most_along and fits[-1][-1].rest > SMALL * largest
        ):
            nodes = np.linspace(low, high, count)
            place = np.clip((reading[is_fitted] - low) / (nodes[1] - nodes[0]), 0.0, count - 1.0)
            left = np.minimum(place.astype(int), count - 2)
            hats = np.column_stack([left + 1 - place, place - left])
            rows, columns = np.arange(len(place)), np.column_stack([left, left + 1])
            shape = (len(place), count)
            J = csr_array((hats.ravel(), (rows.repeat(2), columns.ravel())), shape=shape)
            # a node that no pose is near continues its neighbors
            bends = SMOOTHING * csr_array(np.diff(np.eye(count), 2, axis=0))
            known = np.concatenate([change[is_fitted], np.zeros(count - 2)])
            values = lsmr(vstack([J, bends]), known, atol=1e-12, btol=1e-12, maxiter=20 * count)[0]
            shift = np.interp(reading, nodes, values)
            rest = float(np.abs(shift - change)[usable].max())
            fits[-1].append(_Fit(rest, nodes, values, shift))
            count = min(2 * count - 1, size.most_along)
    least = [ENOUGH * min(fit.rest for fit in own) for own in fits]
    allowed = max(fit.rest for own in fits for fit in own)
    while True:
        chosen = [
            next(fit for fit in own if fit.rest <= max(allowed, enough))
            for own, enough in zip(fits, least, strict=True)
        ]
        after = machine.stop(targets, q + np.column_stack([fit.shift for fit in chosen]), usable)
        after = after[is_check]
        if machine.weigh(after).max() <= limit or allowed <= min(least):
            break
        allowed *= 0.7
    return tuple(
        CorrectionTable({name: fit.nodes}, {name: fit.values})
        for name, fit in zip(names, chosen, strict=True)
    ), after


class _Fit(NamedTuple):
    """A table of an actuator: what it leaves of a reading, its nodes and values, and its
    corrections at the poses that it is fitted to and checked at.
    """

    rest: float
    nodes: FloatArray
    values: FloatArray
    shift: FloatArray
