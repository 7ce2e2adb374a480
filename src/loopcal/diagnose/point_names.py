# SPDX-License-Identifier: Apache-2.0
"""Findings on measured points that do not lie where their names say.

Each session is examined by itself, since the instrument may have moved between two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Finding, report_finding
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


@dataclass(frozen=True)
class PointCheck:
    """The points of a table against their predictions."""

    distance: float  # median distance of a point from its prediction [m]
    limit: float  # of near points [m]
    # (row, target) of points and the (row, target) whose prediction they fit
    renamed: tuple[tuple[tuple[int, int], tuple[int, int]], ...] = ()
    # (row, target) of points that fit no prediction, and their distance [m]
    far: tuple[tuple[tuple[int, int], float], ...] = ()
    # first row after the instrument has moved; None where it stood still
    moved_before: int | None = None
    # ratio of the distances with one instrument frame to those with two; 0: no move. Between
    # `DOUBTED` and `MOVED` the move is likely, but geometric errors hide it
    move_gain: float = 0.0
    # 1 where the points of each row fit the row before, -1 where they fit the next one
    shift: int = 0
    shifted_from: int = 0  # first row whose name is shifted
    # median distance with the names as they are [m], where they are shifted
    distance_as_named: float = float("nan")


def check_point_names(kind: Position, T: FloatArray, measured: FloatArray) -> PointCheck | None:
    """Compare measured points with the predictions of the nominal robot.

    kind : of the rows, mounted on the robot's tool. T : (r, 4, 4) platform pose of each row.
    measured : (r, 3 k) [m] points of k targets in the frame of the instrument, NaN where missing.
    Returns None where there are too few points.
    """
    points = measured.reshape(len(T), len(kind.targets), 3)
    is_present: BoolArray = np.asarray(~np.isnan(points).any(axis=2))
    unknowns = 6 * ("frame" in kind.unknown) + 3 * len(kind.targets) * ("targets" in kind.unknown)
    if 3 * is_present.sum() < 2 * unknowns + 6:
        return None
    extent = float(np.ptp(points[is_present], axis=0).max(initial=0.0))
    fitted = _fit_without_far_points(kind, T, points, is_present, LEAST_SHARE * extent)
    if fitted is None:
        return None
    predicted, distance, limit = fitted
    is_far = is_present & ~(distance <= limit)
    typical = float(np.median(distance[is_present & ~is_far]))
    shift = _find_shift(kind, T, points, is_present, typical)
    if shift is None and typical > SCALE_SHARE * _measure_extent(T):
        shift = _find_late_shift(kind, T, points, is_present, typical)
    if shift is not None:
        by, first, then = shift
        return PointCheck(then, limit, shift=by, shifted_from=first, distance_as_named=typical)
    split, gain = _find_move(kind, T, points, is_present)
    if gain > MOVED:
        return PointCheck(typical, limit, moved_before=split, move_gain=gain)
    places = np.argwhere(is_far)
    check = PointCheck(typical, limit)
    if len(places):
        check = _rename(points, predicted, places, distance, typical, limit)
    if check.renamed or split is None:
        return check
    return replace(check, moved_before=split, move_gain=gain)


def _measure_extent(T: FloatArray) -> float:
    """Return the largest extent of poses (r, 4, 4) along an axis [m]."""
    return float(np.ptp(T[:, :3, 3], axis=0).max(initial=0.0))


def _rename(
    points: FloatArray,
    predicted: FloatArray,
    places: IntArray,
    distance: FloatArray,
    typical: float,
    limit: float,
) -> PointCheck:
    """Return which of the far points at `places` fit the prediction of another one.

    A point may also have the place of a point that was not measured.
    """
    from scipy.optimize import linear_sum_assignment  # loaded late: only few points are far

    is_open = np.isnan(points).any(axis=2)
    candidates = np.concatenate([places, np.argwhere(is_open)])
    far_points = points[tuple(places.T)]
    expected = predicted[tuple(candidates.T)]
    between = np.linalg.norm(far_points[:, None] - expected[None], axis=2)
    rows, columns = linear_sum_assignment(np.minimum(between, limit))
    renamed, far = [], []
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        place = (int(places[row][0]), int(places[row][1]))
        if between[row, column] <= limit and column != row:
            other = (int(candidates[column][0]), int(candidates[column][1]))
            renamed.append((place, other))
        else:
            far.append((place, float(distance[place])))
    return PointCheck(typical, limit, tuple(renamed), tuple(far))


def _fit_without_far_points(
    kind: Position, T: FloatArray, points: FloatArray, is_present: BoolArray, least: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """Return predictions (r, k, 3), distances (r, k) and the limit of near points [m].

    None where the points do not determine frame and targets.
    """
    used, result = is_present, None
    for _ in range(FITS):
        fitted = _fit(kind, T, points, used)
        if fitted is None:
            return None
        predicted, distance = fitted
        limit = FAR * max(float(np.median(distance[is_present])), least)
        result = (predicted, distance, limit)
        near: BoolArray = is_present & (distance <= limit)
        if (near == used).all():
            break
        used = near
    return result


def _fit(
    kind: Position, T: FloatArray, points: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return predictions (r, k, 3) with the best frame and targets, and distances (r, k)."""
    measured = np.where(used[..., None], points, np.nan).reshape(len(T), -1)
    try:
        candidates = kind.guess_values(T, measured)
    except DataError:  # collinear points
        return None
    best = None
    for values in np.atleast_2d(candidates):
        predicted = kind.locate_targets(T, values)[0]
        distance = np.linalg.norm(predicted - points, axis=2)
        if best is None or np.median(distance[used]) < np.median(best[1][used]):
            best = (predicted, distance)
    return best


def _find_shift(
    kind: Position, T: FloatArray, points: FloatArray, is_present: BoolArray, typical: float
) -> tuple[int, int, float] | None:
    """Return by how many rows names are shifted, 0 for the first row, and the median distance then;
    None where the names as they are fit nearly as well.
    """
    best = None
    for shift in (1, -1):
        poses = T[:-1] if shift > 0 else T[1:]
        of_rows = slice(1, None) if shift > 0 else slice(None, -1)
        fitted = _fit(kind, poses, points[of_rows], is_present[of_rows])
        if fitted is None or not is_present[of_rows].any():
            continue
        distance = float(np.median(fitted[1][is_present[of_rows]]))
        if distance * MOVED < typical and (best is None or distance < best[2]):
            best = (shift, 0, distance)
    return best


def _find_late_shift(
    kind: Position, T: FloatArray, points: FloatArray, is_present: BoolArray, typical: float
) -> tuple[int, int, float] | None:
    """Return like `_find_shift` a shift that begins at a later row: a pose was left out, or counted
    twice, and the numbers went on.
    """
    n, best = len(T), None
    for shift in (1, -1):
        rows = n if shift > 0 else n - 1

        def measure(first: int, shift: int = shift, rows: int = rows) -> float:
            poses = T[np.arange(rows) - shift * (np.arange(rows) >= first)]
            fitted = _fit(kind, poses, points[:rows], is_present[:rows])
            if fitted is None or not is_present[:rows].any():
                return np.inf
            return float(np.mean(fitted[1][is_present[:rows]]))

        first = _find_smallest(measure, 1, rows - 1)
        if first is not None:
            distance = measure(first)
            if distance * MOVED < typical and (best is None or distance < best[2]):
                best = (shift, first, distance)
    return best


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


def _find_move(
    kind: Position, T: FloatArray, points: FloatArray, is_present: BoolArray
) -> tuple[int | None, float]:
    """Return the row before which the instrument may have moved, and by which ratio the root mean
    square of distances per degree of freedom falls; (None, 0) up to the ratio `DOUBTED`.

    Both sides are fitted with frames and targets of their own.
    """
    if "frame" not in kind.unknown:
        return None, 0.0

    def measure(start: int, end: int) -> float:
        fitted = _fit(kind, T[start:end], points[start:end], is_present[start:end])
        if fitted is None:
            return np.inf
        return float((fitted[1][is_present[start:end]] ** 2).sum())

    per_pose = max(1, 3 * len(kind.targets))
    unknowns = 6 + 3 * len(kind.targets)
    fewest = max(FEWEST_POSES, -(-3 * unknowns // per_pose))
    split = _find_smallest(
        lambda place: measure(0, place) + measure(place, len(T)), fewest, len(T) - fewest
    )
    if split is None:
        return None, 0.0
    unsplit, divided = measure(0, len(T)), measure(0, split) + measure(split, len(T))
    numbers = 3 * int(is_present.sum())
    share = (numbers - 2 * unknowns) / (numbers - unknowns)
    if not (share > 0.0 and np.isfinite(unsplit) and divided * DOUBTED**2 < unsplit * share):
        return None, 0.0
    return split, float(np.sqrt(unsplit * share / divided)) if divided > 0.0 else np.inf


def find_other_scale(
    kind: Position, T: FloatArray, measured: FloatArray, scales: Mapping[str, float]
) -> tuple[str, float, float] | None:
    """Return which scale explains points that the nominal robot does not; None where it does.

    kind, T, measured : see `check_point_names`. scales : name -> factor [1] that may be missing.
    Returns Name, median distance with this factor, and median distance without it [m].
    """
    points = measured.reshape(len(T), len(kind.targets), 3)
    used: BoolArray = np.asarray(~np.isnan(points).any(axis=2))

    def measure(scale: float) -> float:
        fitted = _fit(kind, T, scale * points, used)
        return np.inf if fitted is None else float(np.median(fitted[1][used]))

    as_written = measure(1.0)
    if not as_written > SCALE_SHARE * _measure_extent(T):
        return None
    distances = {name: measure(scale) for name, scale in scales.items()}
    if not distances:
        return None
    name = min(distances, key=distances.__getitem__)
    if not distances[name] * MOVED < as_written:
        return None
    return name, distances[name], as_written


def examine_points(robot: Mechanism, data: Measurements, unit: str) -> tuple[Finding, ...]:
    """Return findings on points that are far from where the nominal robot predicts them.

    Rows of other kinds than `position` are not examined.

    unit : in which the points were read, for messages.
    """
    findings: list[Finding] = []
    solution = forward(robot, data.readings)
    for rows in data.observations:
        kind = rows.kind
        if not isinstance(kind, Position):
            continue
        for session in np.unique(rows.session):
            chosen = np.flatnonzero((rows.session == session) & solution.converged[rows.rows])
            T, measured = solution.T[rows.rows[chosen]], rows.measured[chosen]
            _refuse_other_unit(robot, kind, T, measured, unit)
            check = check_point_names(kind, T, measured)
            if check is not None:
                labels = [data.labels[i] for i in rows.rows[chosen]]
                findings += _report_point_check(robot, check, labels, kind.targets)
    return tuple(findings)


def _refuse_other_unit(
    robot: Mechanism, kind: Position, T: FloatArray, measured: FloatArray, stated: str
) -> None:
    """Raise DataError where the points fit in another unit of length than the stated one."""
    scale = find_unit(stated, Dimension.LENGTH).factor_to_si
    known = {s: find_unit(s).factor_to_si for s in list_symbols(Dimension.LENGTH)}
    others = {symbol: factor / scale for symbol, factor in known.items() if symbol != stated}
    other = find_other_scale(kind, T, measured, others)
    if other is not None:
        typical, before = (robot.to_quantity(d, Dimension.LENGTH) for d in other[1:])
        finding = report_finding(
            "sheet.points-unit", stated=stated, unit=other[0], typical=typical, before=before
        )
        raise DataError(finding)


def _report_point_check(
    robot: Mechanism, check: PointCheck, labels: Sequence[str], targets: Sequence[str]
) -> list[Finding]:
    """Return what a check says about far points; raise DataError for names and moves."""

    def name(place: tuple[int, int]) -> str:
        return name_point(labels[place[0]], targets[place[1]], targets)

    findings: list[Finding] = []
    if check.moved_before is not None:
        first, last = labels[check.moved_before], labels[check.moved_before - 1]
        if check.move_gain > MOVED:
            raise DataError(report_finding("sheet.instrument-moved", first=first, last=last))
        findings.append(
            report_finding(
                "sheet.instrument-perhaps-moved", first=first, last=last, gain=check.move_gain
            )
        )
    if check.shift:
        typical, before = (
            robot.to_quantity(distance, Dimension.LENGTH)
            for distance in (check.distance, check.distance_as_named)
        )
        facts = {"is_late": check.shift > 0, "typical": typical, "before": before}
        if not check.shifted_from:
            raise DataError(report_finding("sheet.points-shifted", **facts))
        first = labels[check.shifted_from]
        raise DataError(report_finding("sheet.points-shifted-later", first=first, **facts))
    if check.renamed:
        points = tuple({"found": name(a), "place": name(b)} for a, b in check.renamed)
        limit = robot.to_quantity(check.limit, Dimension.LENGTH)
        raise DataError(
            report_finding("sheet.points-misnamed", points=points, count=len(points), limit=limit)
        )
    if not check.far:
        return findings
    far = tuple(
        {"item": name(place), "distance": robot.to_quantity(distance, Dimension.LENGTH)}
        for place, distance in check.far
    )
    typical = robot.to_quantity(check.distance, Dimension.LENGTH)
    return [*findings, report_finding("sheet.points-far", points=far, typical=typical)]
