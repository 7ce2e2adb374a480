# SPDX-License-Identifier: Apache-2.0
"""Findings on measured points that do not lie where their names say.

Each session is examined by itself, since the instrument may have moved between two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.kinds.position import Position, name_point
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import Dimension, find_unit, list_symbols

# Distance from its prediction, in medians, above which a point is not where its name says.
FAR = 8.0
FITS = 6  # repetitions of the fit without the points that are far
# Ratio of the distances with one instrument frame to those with two, above which it has moved.
# Also of those with names as they are to those with shifted names.
MOVED = 8.0
# Like `MOVED`, per degree of freedom: ratio above which it may have moved. Geometric errors alone
# gave at most 1.2 with 30 poses of a hexapod.
DOUBTED = 2.0
GRID = 8  # moments between which a move or a shift of names is sought at first
# Share of the extent of the poses by which points are away, above which units are doubted.
SCALE_SHARE = 0.02
FEWEST_POSES = 4  # poses on each side of a moment at which an instrument may have moved
LEAST_SHARE = 1e-9  # share of the extent of all points below which a distance is rounding


def examine_points(robot: Mechanism, data: Measurements, unit: str) -> tuple[Finding, ...]:
    """Return findings on points that are far from where the nominal robot predicts them; raise
    DataError for wrong names and units, and for an instrument that moved.

    Rows of other kinds than `position` are not examined. unit : in which the points were read.
    """
    findings: list[Finding] = []
    solution = forward(robot, data.readings)
    for rows in data.observations:
        if not isinstance(rows.kind, Position):
            continue
        for session in np.unique(rows.session):
            chosen = np.flatnonzero((rows.session == session) & solution.converged[rows.rows])
            if chosen.size == 0:  # no pose whose points could be predicted
                continue
            poses = rows.rows[chosen]
            points = rows.measured[chosen].reshape(len(chosen), len(rows.kind.targets), 3)
            labels = [data.labels[i] for i in poses]
            table = _Points(robot, rows.kind, solution.T[poses], points, labels)
            _refuse_other_unit(table, unit)
            findings += _examine(table)
    return tuple(findings)


@dataclass(frozen=True, eq=False)
class _Points:
    """Points of k targets at the platform poses T (r, 4, 4) [m] of r rows."""

    robot: Mechanism
    kind: Position  # mounted on the robot's tool
    T: FloatArray
    points: FloatArray  # (r, k, 3) [m] in the frame of the instrument, NaN where missing
    labels: list[str]  # of the poses

    @cached_property
    def is_present(self) -> BoolArray:
        """(r, k) measured points."""
        return np.asarray(~np.isnan(self.points).any(axis=2))

    @property
    def extent(self) -> float:
        """Largest extent of the poses along an axis [m]."""
        return float(np.ptp(self.T[:, :3, 3], axis=0).max(initial=0.0))

    def fit(
        self, T: FloatArray, points: FloatArray, used: BoolArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return predictions (n, k, 3) with the frame and targets that fit used points best, and
        distances (n, k); None where the points do not determine them.
        """
        measured = np.where(used[..., None], points, np.nan).reshape(len(T), -1)
        try:
            candidates = self.kind.guess_values(T, measured)
        except DataError:  # collinear points
            return None
        best = None
        for values in np.atleast_2d(candidates):
            predicted = self.kind.locate_targets(T, values)[0]
            distance = np.linalg.norm(predicted - points, axis=2)
            if best is None or np.median(distance[used]) < np.median(best[1][used]):
                best = (predicted, distance)
        return best

    def measure(
        self, poses: IntArray, rows: IntArray, summarize: Callable[[FloatArray], float]
    ) -> float:
        """Return a summary of the distances of the points of rows (n,) from their predictions at
        the poses of other rows (n,); infinite where there are none.
        """
        used = self.is_present[rows]
        fitted = self.fit(self.T[poses], self.points[rows], used) if used.any() else None
        return np.inf if fitted is None else float(summarize(fitted[1][used]))

    def name(self, place: tuple[int, int]) -> str:
        """Return the name of a point, a row and a target."""
        return name_point(self.labels[place[0]], self.kind.targets[place[1]], self.kind.targets)

    def to_quantity(self, distance: float) -> Quantity:
        """Return a distance [m] in the unit of the robot's file."""
        return self.robot.to_quantity(distance, Dimension.LENGTH)


def _refuse_other_unit(table: _Points, stated: str) -> None:
    """Raise DataError where the points fit in another unit of length than the stated one."""

    def measure(scale: float) -> float:
        fitted = table.fit(table.T, scale * table.points, table.is_present)
        return np.inf if fitted is None else float(np.median(fitted[1][table.is_present]))

    as_written = measure(1.0)
    if not as_written > SCALE_SHARE * table.extent:
        return
    factors = {s: find_unit(s).factor_to_si for s in list_symbols(Dimension.LENGTH)}
    scale = find_unit(stated, Dimension.LENGTH).factor_to_si
    distances = {s: measure(factor / scale) for s, factor in factors.items() if s != stated}
    unit = min(distances, key=distances.__getitem__)
    if distances[unit] * MOVED < as_written:
        typical, before = table.to_quantity(distances[unit]), table.to_quantity(as_written)
        numbers = {"unit": unit, "typical": typical, "before": before}
        raise DataError(report_finding("sheet.points-unit", stated=stated, **numbers))


def _examine(table: _Points) -> list[Finding]:
    """Compare the points with the predictions of the nominal robot; no finding with too few."""
    kind, is_present = table.kind, table.is_present
    unknowns = 6 * ("frame" in kind.unknown) + 3 * len(kind.targets) * ("targets" in kind.unknown)
    if 3 * is_present.sum() < 2 * unknowns + 6:
        return []
    least = LEAST_SHARE * float(np.ptp(table.points[is_present], axis=0).max(initial=0.0))
    used, predicted, distance, limit = is_present, table.points, np.zeros(0), 0.0
    for _ in range(FITS):
        fitted = table.fit(table.T, table.points, used)
        if fitted is None:
            return []
        predicted, distance = fitted
        limit = FAR * max(float(np.median(distance[is_present])), least)
        near: BoolArray = is_present & (distance <= limit)
        if (near == used).all():
            break
        used = near
    is_far = is_present & ~(distance <= limit)
    typical = float(np.median(distance[is_present & ~is_far]))
    _refuse_shift(table, typical)
    split, gain = _find_move(table)
    ends: dict[str, Any] = {}
    if split is not None:
        ends = {"first": table.labels[split], "last": table.labels[split - 1]}
    if gain > MOVED:
        raise DataError(report_finding("sheet.instrument-moved", **ends))
    far = _rename(table, predicted, np.argwhere(is_far), limit)
    findings = []
    if ends:
        findings.append(report_finding("sheet.instrument-perhaps-moved", **ends, gain=gain))
    if far:
        points = tuple(
            {"item": table.name(place), "distance": table.to_quantity(float(distance[place]))}
            for place in far
        )
        typically = table.to_quantity(typical)
        findings.append(report_finding("sheet.points-far", points=points, typical=typically))
    return findings


def _rename(
    table: _Points, predicted: FloatArray, places: IntArray, limit: float
) -> list[tuple[int, int]]:
    """Raise DataError where far points at `places` (f, 2) fit the prediction of another one of
    them, or of a point that was not measured; return the places otherwise.
    """
    far = [(int(row), int(target)) for row, target in places]
    if not far:
        return far
    from scipy.optimize import linear_sum_assignment  # loaded late: only few points are far

    candidates = np.concatenate([places, np.argwhere(~table.is_present)])
    far_points, expected = table.points[tuple(places.T)], predicted[tuple(candidates.T)]
    between = np.linalg.norm(far_points[:, None] - expected[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(between, limit))
    renamed = tuple(
        {"found": table.name(far[row]), "place": table.name(tuple(candidates[column].tolist()))}
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if between[row, column] <= limit and column != row
    )
    if renamed:
        numbers = {"count": len(renamed), "limit": table.to_quantity(limit)}
        raise DataError(report_finding("sheet.points-misnamed", points=renamed, **numbers))
    return [far[row] for row in rows]


def _refuse_shift(table: _Points, typical: float) -> None:
    """Raise DataError where names that are shifted by a row fit far better, from the first row on,
    or from a later one: a pose was left out, or counted twice, and the numbers went on.

    typical : median distance with the names as they are [m].
    """
    n = len(table.T)

    def measure(shift: int, first: int, summarize: Callable[[FloatArray], float]) -> float:
        rows = np.arange(int(shift > 0 and not first), n if shift > 0 else n - 1)
        return table.measure(rows - shift * (rows >= first), rows, summarize)

    best = min((measure(shift, 0, np.median), -shift, 0) for shift in (1, -1))
    if not best[0] * MOVED < typical and typical > SCALE_SHARE * table.extent:
        late = []
        for shift in (1, -1):
            first = _find_smallest(
                lambda first, shift=shift: measure(shift, first, np.mean),
                1,
                n - 1 if shift > 0 else n - 2,
            )
            if first is not None:
                late.append((measure(shift, first, np.mean), -shift, first))
        best = min(late, default=best)
    then, shift, first = best[0], -best[1], best[2]
    if then * MOVED < typical:
        numbers = {"typical": table.to_quantity(then), "before": table.to_quantity(typical)}
        facts = {"is_late": shift > 0, **numbers}
        if first:
            later = report_finding("sheet.points-shifted-later", first=table.labels[first], **facts)
            raise DataError(later)
        raise DataError(report_finding("sheet.points-shifted", **facts))


def _find_smallest(measure: Callable[[int], float], low: int, high: int) -> int | None:
    """Return the place of the smallest value in low..high, towards which the values fall."""
    values: dict[int, float] = {}
    while low <= high:  # a grid, then a finer one around the best
        step = max(1, -(-(high - low) // GRID))
        for place in range(low, high + 1, step):
            if place not in values:
                values[place] = measure(place)
        best = min(values, key=values.__getitem__)
        if step == 1:
            break
        low, high = max(low, best - step + 1), min(high, best + step - 1)
    return min(values, key=values.__getitem__) if values else None


def _find_move(table: _Points) -> tuple[int | None, float]:
    """Return the row before which the instrument may have moved, and by which ratio the root mean
    square of distances per degree of freedom falls; (None, 0) up to the ratio `DOUBTED`.

    Both sides are fitted with frames and targets of their own.
    """
    if "frame" not in table.kind.unknown:
        return None, 0.0
    n, unknowns = len(table.T), 6 + 3 * len(table.kind.targets)

    def measure(start: int, end: int) -> float:
        rows = np.arange(start, end)
        return table.measure(rows, rows, lambda distance: (distance**2).sum())

    def divide(place: int) -> float:
        return measure(0, place) + measure(place, n)

    fewest = max(FEWEST_POSES, -(-3 * unknowns // max(1, 3 * len(table.kind.targets))))
    split = _find_smallest(divide, fewest, n - fewest)
    if split is None:
        return None, 0.0
    unsplit, divided = measure(0, n), divide(split)
    numbers = 3 * int(table.is_present.sum())
    share = (numbers - 2 * unknowns) / (numbers - unknowns)
    if not (share > 0.0 and np.isfinite(unsplit) and divided * DOUBTED**2 < unsplit * share):
        return None, 0.0
    return split, float(np.sqrt(unsplit * share / divided)) if divided > 0.0 else np.inf
