# SPDX-License-Identifier: Apache-2.0
"""Whether measured points lie where their names say, and whether the frame of an instrument moved.

Points are compared with those that the nominal robot predicts. Each session is examined by itself,
since the instrument may have moved between two.

Repeated targets on the base show a motion within a session. In the frame of the instrument, k of
them are at `x = p + c + w x (p - m) + t`: mean places p with corrections c, the center m of the
targets, and a small motion (w, t) of each measurement. That of the first one is 0. If the frame
keeps its place in a session, all are. By how much the whitened sum of squares grows with this
condition is a chi-square of six degrees of freedom for each further measurement.

Whether the targets kept their distances, and have those of their stated places, is what remains if
each measurement of any session may move freely; each is first brought to the others by its best
rigid motion, which may be large. No robot and no pose enters. The noise is the stated one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from loopcal import engine, geometry
from loopcal.diagnose.residual_patterns import order_by_time
from loopcal.errors import DataError
from loopcal.estimate.residual_test import FALSE_ALARMS
from loopcal.findings import Finding, Quantity, report_finding
from loopcal.measure.kinds.position import Position, name_point
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.mechanism.solutions import forward
from loopcal.numerics.decomposition import decompose, empty_factor
from loopcal.numerics.statistics import compute_any_probability, compute_chi_square_tail
from loopcal.results.tables import to_quantity
from loopcal.typing import BoolArray, FloatArray, IntArray
from loopcal.units import UNITS, Dimension, find_unit, list_symbols

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
        raise DataError.of("sheet.points-unit", stated=stated, **numbers)


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
        raise DataError.of("sheet.instrument-moved", **ends)
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
        raise DataError.of("sheet.points-misnamed", points=renamed, **numbers)
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
        begin = table.labels[first] if first else ""
        facts = {"is_late": shift > 0, "first": begin, **numbers}
        raise DataError.of("sheet.points-shifted", **facts)


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


# Probability, for each of the two tests, of a report although no frame and no target moved.
LEVEL = 0.5 * FALSE_ALARMS["motion of frames"]
TINY = 1e-99  # smallest probability that is written; a smaller one is stated as below this
# Standard deviation of stated places [m], negligible beside the noise of any instrument.
EXACT = 1e-9
# Singular values of whitened rows with scaled columns, relative to the largest, that are zero.
RANK = 1e-9


@dataclass(frozen=True, eq=False)
class FrameDrift:
    """The largest motion of the frame of an instrument from the first measurement of a session."""

    frame: str
    session: str
    targets: tuple[str, ...]  # on the base
    row: int  # number of the measurement at which the motion is most significant, from 1
    rows: int  # number of measurements of the session
    shift: float  # displacement at the center of the targets [m]
    shift_sd: float
    angle: float  # [rad]
    angle_sd: float
    # chi_square, degrees: of the test that the frame kept its place in the whole session
    chi_square: float
    degrees: int
    p_value: float  # probability of a larger chi-square without motion

    @property
    def finding(self) -> Finding:
        """The motion as a finding."""
        arcsec = UNITS["arcsec"]
        return report_finding(
            "residuals.frame-moved",
            frame=self.frame,
            session=self.session,
            row=self.row,
            rows=self.rows,
            shift=Quantity(1e3 * self.shift, "mm"),
            shift_sd=Quantity(1e3 * self.shift_sd, "mm"),
            angle=to_quantity(self.angle, arcsec),
            angle_sd=to_quantity(self.angle_sd, arcsec),
            p_value=self.p_value,
            tiny=self.p_value < TINY,
        )


class ShapeTest(NamedTuple):
    """The test whether targets on the base kept their distances in all measurements."""

    frame: str  # in which they were measured
    targets: tuple[str, ...]  # on the base
    # targets without each of which the noise explains the others; of three often more than one
    suspects: tuple[str, ...]
    is_stated: bool  # whether their places are stated, and compared, too
    chi_square: float  # of what no motion of frames explains
    degrees: int
    p_value: float  # probability of a larger chi-square if no target moved

    @property
    def finding(self) -> Finding:
        """The targets that did not keep their distances."""
        names = ("targets", "suspects", "is_stated", "chi_square", "degrees")
        data = {name: getattr(self, name) for name in names}
        return report_finding("residuals.base-targets-moved", **data)


class _Repeats(NamedTuple):
    """E measurements of the same k targets: points (E, k, 3) [m], NaN where missing, whiteners
    (E, 3 k, 3 k) of their rows, and sessions (E,).
    """

    kind: Position
    points: FloatArray
    whitener: FloatArray
    session: list[str]


def report_base_targets(data: Measurements) -> tuple[Finding, ...]:
    """Return findings on frames that moved within a session, and on targets that moved."""
    shapes = compare_shapes(data)
    changed = [s for s in shapes if compute_any_probability(s.p_value, len(shapes)) < LEVEL]
    drifts = estimate_frame_drifts(_leave_out(data, changed))
    moved = [d for d in drifts if compute_any_probability(d.p_value, len(drifts)) < LEVEL]
    findings = [shape.finding for shape in changed]
    findings += [drift.finding for drift in moved]
    used = {name for rows in data.observations for name in rows.session.tolist()}
    open_frames = [rows for rows in data.base_observations if "frame" in rows.kind.unknown]
    on_base = dict.fromkeys(name for rows in open_frames for name in rows.session.tolist())
    if used and (unused := [name for name in on_base if name not in used]):
        names = tuple(f"session {name!r}" if name else "rows without a session" for name in unused)
        findings.append(report_finding("data.base-session-unused", sessions=names))
    return tuple(findings)


def _leave_out(data: Measurements, changed: Sequence[ShapeTest]) -> Measurements:
    """Return the measurements without targets that moved; without all where it is open which."""
    kept = []
    for rows in data.base_observations:
        kind, measured = rows.kind, np.array(rows.measured)
        for shape in changed:
            own = (shape.frame, shape.targets)
            if isinstance(kind, Position) and (kind.frame, kind.targets) == own:
                known = len(shape.suspects) == 1
                for name in shape.suspects if known else kind.targets:
                    measured[:, list(kind.target_columns[name])] = np.nan
        kept.append(replace(rows, measured=measured))
    return replace(data, base_observations=tuple(kept))


def estimate_frame_drifts(data: Measurements) -> tuple[FrameDrift, ...]:
    """Return the motion of each frame in each session with at least two measurements of at least
    three targets on the base that are not collinear.
    """
    drifts = []
    for repeats in _list_repeats(data):
        for session in dict.fromkeys(repeats.session):
            chosen = [i for i, name in enumerate(repeats.session) if name == session]
            if len(chosen) > 1:
                arrays = repeats.points[chosen], repeats.whitener[chosen]
                own = _Repeats(repeats.kind, *arrays, [session] * len(chosen))
                drifts.append(_estimate_drift(own))
    return tuple(drifts)


def compare_shapes(data: Measurements) -> tuple[ShapeTest, ...]:
    """Return the tests of all targets on the base that were measured together at least twice, or
    once if their places are stated and known.
    """
    tests = []
    for repeats in _list_repeats(data, with_places=True):
        kind, aligned = repeats.kind, _align_each(repeats)
        rows, values, _ = _build_rows(aligned)
        is_seen = np.asarray(np.isfinite(repeats.points).all(axis=2))
        full, degrees = _solve_without(rows, values, is_seen)
        if degrees <= 0:
            continue
        suspects = []
        for i, name in enumerate(kind.targets):
            cost, left = _solve_without(rows, values, is_seen, i)
            if degrees > left > 0 and compute_chi_square_tail(left, cost) > LEVEL:
                suspects.append(name)
        tail = float(compute_chi_square_tail(degrees, full))
        names = (kind.frame, kind.targets, tuple(suspects))
        tests.append(ShapeTest(*names, "targets" not in kind.unknown, full, degrees, tail))
    return tuple(tests)


def _list_repeats(data: Measurements, *, with_places: bool = False) -> Iterator[_Repeats]:
    """Yield the measurements of the same targets in frames of one name, in their order.

    with_places : whether the stated places come first, as an exact measurement without a session.
    """
    groups: dict[tuple[str, tuple[str, ...]], list[Observations]] = {}
    for rows in data.base_observations:
        if isinstance(rows.kind, Position):
            groups.setdefault((rows.kind.frame, rows.kind.targets), []).append(rows)
    for alike in groups.values():
        kind = alike[0].kind
        assert isinstance(kind, Position)
        pairs = []
        for rows in alike:  # those that count, in the order of their time
            counted, time = np.flatnonzero(rows.weight > 0.0), rows.context.get("time")
            time = None if time is None else time[counted]
            pairs.append((rows, counted[order_by_time(time, len(counted))]))
        measured = np.concatenate([rows.measured[i] for rows, i in pairs])
        points = measured.reshape(len(measured), -1, 3)
        whitener = np.concatenate([rows.whitener[i] for rows, i in pairs])
        session = np.concatenate([rows.session[i] for rows, i in pairs])
        if with_places and "targets" not in kind.unknown and kind.places is not None:
            points = np.concatenate([kind.places[None], points])
            whitener = np.concatenate([np.eye(kind.places.size)[None] / EXACT, whitener])
            session = np.concatenate([[""], session])
        used = [i for i, each in enumerate(points) if _spans_plane(each)]
        if len(used) > 1:
            yield _Repeats(kind, points[used], whitener[used], session[used].tolist())


def _spans_plane(points: FloatArray) -> bool:
    """Return whether at least three of points (k, 3) are measured and not collinear."""
    measured = points[np.isfinite(points).all(axis=1)]
    if len(measured) < 3:
        return False
    extent = np.linalg.svd(measured - measured.mean(axis=0), compute_uv=False)
    return bool(extent[1] > geometry.FLATNESS * extent[0])


def _align_each(repeats: _Repeats) -> _Repeats:
    """Return the measurements, each moved to the first one with which it shares enough targets."""
    points, whitener = repeats.points.copy(), repeats.whitener.copy()
    for i in range(1, len(points)):
        for first in points[:i]:
            both = np.isfinite(first + points[i]).all(axis=1)
            if _spans_plane(np.where(both[:, None], first, np.nan)):
                T = geometry.align_point_sets(points[i, both], first[both])
                points[i] = points[i] @ T[:3, :3].T + T[:3, 3]
                back = np.kron(np.eye(len(first)), T[:3, :3].T)  # to the axes of its noise
                whitener[i] = whitener[i] @ back
                break
    return repeats._replace(points=points, whitener=whitener)


def _build_rows(repeats: _Repeats) -> tuple[FloatArray, FloatArray, float]:
    """Return whitened rows (E, 3 k, 3 k + 6) by the places and by the motion of the measurement (w
    times the radius of the targets, t), whitened values (E, 3 k), and the radius [m].
    """
    points, (E, k) = repeats.points, repeats.points.shape[:2]
    is_seen = np.isfinite(points)
    count = np.maximum(is_seen.sum(axis=0), 1)
    place = np.where(is_seen, points, 0.0).sum(axis=0) / count
    arm = place - place.mean(axis=0)
    radius = float(np.sqrt((arm**2).sum(axis=1).mean()))
    identity = np.broadcast_to(np.eye(3), (k, 3, 3))
    by_motion = np.concatenate([-geometry.hat(arm) / radius, identity], axis=-1)
    columns = np.concatenate([np.eye(3 * k), by_motion.reshape(3 * k, 6)], axis=1)
    values = np.where(is_seen, points - place, 0.0).reshape(E, 3 * k, 1)
    return repeats.whitener @ columns, (repeats.whitener @ values)[..., 0], radius


def _spread_motions(rows: FloatArray) -> FloatArray:
    """Return rows (E 3 k, 3 k + 6 (E - 1)): each measurement but the first has its own motion."""
    E, m = rows.shape[:2]
    spread = np.zeros((E, m, m + 6 * (E - 1)))
    spread[:, :, :m] = rows[:, :, :m]
    for i in range(1, E):
        spread[i, :, m + 6 * (i - 1) : m + 6 * i] = rows[i, :, m:]
    return spread.reshape(E * m, -1)


def _solve(A: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return the least-squares solution (c,) of whitened rows A x = b, shortest in scaled columns,
    a root (c, r) of its covariance, and the sum of squares.
    """
    rows = np.concatenate([A, b[:, None]], axis=1)
    factor = engine.fold(empty_factor(1, A.shape[1]), rows[None])
    length = np.linalg.norm(A, axis=0)
    scale = 1.0 / np.where(length > 0.0, length, 1.0)
    decomposition = decompose(factor, np.array([len(A)]), root=np.diag(scale), tolerance=RANK)
    used = decomposition.used
    penalty = np.where(used, 0.0, np.inf)
    values = decomposition.deviation(decomposition.solution(penalty))[0]
    root = decomposition.noise_roots(penalty)[0][:, used[0]]
    return values, root, float(decomposition.remaining(penalty)[0])


def _estimate_drift(repeats: _Repeats) -> FrameDrift:
    """Return the motion of one frame in one session."""
    rows, values, radius = _build_rows(repeats)
    E, m = values.shape
    solution, roots, cost = _solve(_spread_motions(rows), values.ravel())
    _, still, still_cost = _solve(rows[:, :, :m].reshape(E * m, m), values.ravel())
    chi_square, degrees = still_cost - cost, roots.shape[1] - still.shape[1]
    best, largest = 1, -1.0
    for i in range(1, E):
        chosen = slice(m + 6 * (i - 1), m + 6 * i)
        # the squared length of the motion in units of its uncertainty
        u, s, _ = np.linalg.svd(roots[chosen], full_matrices=False)
        size = float((((u.T @ solution[chosen]) / s) ** 2).sum())
        best, largest = (i, size) if size > largest else (best, largest)
    chosen = slice(m + 6 * (best - 1), m + 6 * best)
    motion, root = solution[chosen], roots[chosen]
    angle, angle_sd = _measure_length(motion[:3] / radius, root[:3] / radius)
    shift, shift_sd = _measure_length(motion[3:], root[3:])
    tail = float(compute_chi_square_tail(degrees, chi_square))
    kind = repeats.kind
    where = (kind.frame, repeats.session[0], kind.targets, best + 1, E)
    return FrameDrift(*where, shift, shift_sd, angle, angle_sd, chi_square, degrees, tail)


def _measure_length(vector: FloatArray, root: FloatArray) -> tuple[float, float]:
    """Return the length of a vector (3,) and its standard deviation along the vector."""
    length = float(np.linalg.norm(vector))
    along = vector / length if length > 0.0 else np.eye(3)[0]
    return length, float(np.linalg.norm(along @ root))


def _solve_without(
    rows: FloatArray, values: FloatArray, is_seen: BoolArray, target: int = -1
) -> tuple[float, int]:
    """Return the sum of squares of whitened rows (E, 3 k, ..) without one of the targets, each
    measurement moving freely, and its degrees of freedom. `is_seen` (E, k) targets.
    """
    is_kept = np.arange(is_seen.shape[1]) != target
    kept = np.repeat(is_kept, 3)
    columns = np.concatenate([kept, np.ones(6, dtype=bool)])
    left = rows[:, kept][:, :, columns]
    _, root, cost = _solve(_spread_motions(left), values[:, kept].ravel())
    return cost, 3 * int(is_seen[:, is_kept].sum()) - root.shape[1]
