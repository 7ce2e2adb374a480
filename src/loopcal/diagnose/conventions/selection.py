# SPDX-License-Identifier: Apache-2.0
"""Search for the interpretation of measurements that explains them.

Interpretations of the values are evaluated together, those of the actuator readings one by one,
because they have their own poses. Pairs are tested only if no single interpretation explains the
data: the most promising ones are applied, and all others are tested on the result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.conventions.interpretations import (
    Interpretation,
    combine,
    interpret_readings,
    list_interpretations,
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.misfit import (
    ALLOWED,
    BETTER,
    EQUALLY,
    QUICK,
    THOROUGH,
    Comparison,
    compare_with_robot,
    compute_misfits,
    compute_quick_misfit,
    compute_rms_residuals,
    exclude_far_rows,
    explains_after_fit,
    guess_frames,
    is_informative,
    is_redundant,
    judge_data,
    refine_misfit,
    select_reached,
)
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.findings import Finding, report_finding
from loopcal.measure.kinds.kind import Column, Kind
from loopcal.measure.measurements import Measurements
from loopcal.mechanism.kinematics import compute_readings
from loopcal.numerics.statistics import choose_evenly
from loopcal.typing import FloatArray, IntArray
from loopcal.units import Dimension

# Number of constants in a scan, factor by which the next scan is narrower, and number of scans.
SCANNED, NARROWER, SCANS = 25, 8.0, 4
BEST = 3  # number of hypotheses that are scanned again
BESIDE = 0.02  # share of the stroke by which readings may be outside: the stroke is nominal, too


class _Zero(NamedTuple):
    """Readings `sign q + base + c` of some actuators, with c between two limits."""

    columns: list[int]  # of the actuators
    sign: float  # 1 or -1
    base: FloatArray  # (k,) of each of them [m or rad]
    # low, high: of c [m or rad]
    low: float
    high: float

    def apply(self, readings: FloatArray, constant: float) -> FloatArray:
        """Return the readings (n, a) with a value of c."""
        changed = np.array(readings)
        changed[:, self.columns] = self.sign * readings[:, self.columns] + self.base + constant
        return changed


def find_zero_interpretations(
    free: FreeParameters, data: Measurements, poses: IntArray, reversed_only: bool
) -> list[Interpretation]:
    """Return the zeros, at most three, with which the given robot fits best at some poses, the best
    first; only of readings that are counted in the opposite direction with `reversed_only`.
    """
    robot = free.robot
    zeros = [zero for zero in _list_zeros(free, data) if zero.sign < 0.0 or not reversed_only]
    few, constants = data.take(poses), np.zeros(0)
    for scan in range(SCANS):
        if not zeros:
            return []
        grids = [np.linspace(zero.low, zero.high, SCANNED) for zero in zeros]
        tested = zip(zeros, grids, strict=True)
        readings = [zero.apply(few.readings, c) for zero, grid in tested for c in grid.tolist()]
        sizes = np.full(len(readings), np.inf)
        near, _, size = guess_frames(free, few, np.stack(readings))
        sizes[near] = np.nan_to_num(size, nan=np.inf)
        sizes = sizes.reshape(len(zeros), SCANNED)
        best = np.argsort(sizes.min(axis=1), kind="stable")[:BEST]
        best = best[np.isfinite(sizes.min(axis=1)[best])]
        zeros = [zeros[i] for i in best]
        constants = np.array([grids[i][np.argmin(sizes[i])] for i in best])
        if scan < SCANS - 1:
            halves = [0.5 * (zero.high - zero.low) / NARROWER for zero in zeros]
            zeros = [
                zero._replace(low=constant - half, high=constant + half)
                for zero, constant, half in zip(zeros, constants.tolist(), halves, strict=True)
            ]
    result = []
    for zero, constant in zip(zeros, constants.tolist(), strict=True):
        total = zero.base + constant
        dimension = robot.actuators[zero.columns[0]].dimension
        shown = [robot.to_quantity(float(value), dimension) for value in total]
        same = np.ptp(total) < 1e-9 * max(float(np.abs(total).max()), 1e-9)
        details = {
            "actuators": tuple(robot.actuators[j].name for j in zero.columns),
            "reversed": zero.sign < 0.0,
            "zeros": tuple(shown[:1] if same else shown),
        }
        change = partial(zero.apply, constant=constant)
        result.append(interpret_readings("reading-zero", details, change))
    return result


def _list_zeros(free: FreeParameters, data: Measurements) -> Iterator[_Zero]:
    """Yield the hypotheses about zeros, those of all actuators of a dimension first."""
    robot = free.robot
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    smallest, largest = np.nanmin(data.readings, axis=0), np.nanmax(data.readings, axis=0)
    spread = largest - smallest
    strokes = [
        actuator.stroke or (home[j] - spread[j], home[j] + spread[j])
        for j, actuator in enumerate(robot.actuators)
    ]
    low, high = np.array(strokes).T
    low, high = low - BESIDE * (high - low), high + BESIDE * (high - low)
    dimensions = [actuator.dimension for actuator in robot.actuators]
    groups = [[j for j, d in enumerate(dimensions) if d is each] for each in dimensions]
    for columns in dict.fromkeys(map(tuple, [*groups, *([j] for j in range(len(groups)))])):
        chosen = list(columns)
        zero, start, ends = np.zeros(len(chosen)), home[chosen], (low + high)[chosen]
        bases = [(1.0, zero), (1.0, start), (-1.0, zero), (-1.0, start), (-1.0, ends)]
        if len(chosen) == 1:  # the scan contains the others
            bases = [(1.0, zero), (-1.0, zero)]
        for sign, base in bases:
            ends_of = np.sort(sign * np.array([smallest, largest])[:, chosen], axis=0) + base
            least = float((low[chosen] - ends_of[0]).max())
            most = float((high[chosen] - ends_of[1]).min())
            if least < most:
                yield _Zero(chosen, sign, base, least, most)


# Interpretations of measurements with a frame, target or anchor that no file declares unknown.

# Setup items that a user may forget to declare unknown. Surfaces with their frames and offsets
# are none of them: the errors of the machine explain those, too.
DECLARED = ("frame", "targets", "tool", "anchor")
UNDECLARED = "undeclared-setup"  # the slip of such interpretations


def list_setup_interpretations(data: Measurements, count: int) -> Iterator[Interpretation]:
    """Yield measurements with `count` setup items unknown that are known as written, in all kinds
    that allow them; two of them are the frame and another one.
    """

    def declare_unknown(data: Measurements, items: tuple[str, ...]) -> Measurements:
        changed = []
        for rows in data.observations:
            more = tuple(item for item in items if item in _list_known(rows.kind))
            unknown = (*rows.kind.unknown, *more)
            changed.append(replace(rows, kind=replace(rows.kind, unknown=unknown)))
        return replace(data, observations=tuple(changed))

    known = [_list_known(rows.kind) if len(rows) else () for rows in data.observations]
    items = [item for item in DECLARED if any(item in names for names in known)]
    for chosen in combinations(items, count):
        if count > 1 and chosen[0] != "frame":
            continue
        first = next(i for i, names in enumerate(known) if chosen[0] in names)
        unknown = (*data.observations[first].kind.unknown, *chosen)
        details = {"items": chosen, "unknown": tuple(dict.fromkeys(unknown))}
        apply = partial(declare_unknown, items=chosen)
        yield Interpretation(UNDECLARED, details, apply, of_values=True)


def _list_known(kind: Kind) -> tuple[str, ...]:
    """Return the items that a kind allows to be unknown, and that it states."""
    allowed = set(kind.allowed_unknown)
    if "surface" in allowed:
        allowed.discard("frame")
    return tuple(i for i in DECLARED if i in allowed and i not in kind.unknown)


# Factor by which it must fit better if tolerances and noise do not explain the rest, as of a
# robot far from nominal in data with a wrong unit.
FAR_BETTER = 10.0
# Misfit above which data that contradict stated setup parameters are refused. Below it, robots
# far beyond their tolerances look the same, and it is a warning.
GROSS = 100.0
# Misfit up to which another interpretation is accepted if the robot reaches too few poses of the
# data as written, which then have no misfit to compare.
LARGEST = 10.0
# Number of rows, and smallest number of poses, by which all interpretations are compared first.
FEW_ROWS, FEWEST_POSES = 60, 20
# Factor by which the misfit on these rows may exceed the limit of a far better fit, and largest
# number of interpretations that are judged by all rows.
PROMISING, MOST_JUDGED = 2.0, 8
# Number of interpretations of the readings that are judged: those of the smallest misfit before
# parameters change.
NEAREST, NEAREST_IN_PAIRS = 12, 4
# Share of the misfit below which an interpretation is a base of pairs, and largest number of
# bases among the values, and among the readings.
LOWERED, MOST_BASES = 0.7, 3


class Selection(NamedTuple):
    """The selected interpretation."""

    interpretation: Interpretation
    comparison: Comparison  # of the data so interpreted
    misfit: float
    alternatives: tuple[Interpretation, ...]  # that fit equally well


class _Test(NamedTuple):
    """A tested interpretation; a misfit that was not computed is infinite."""

    interpretation: Interpretation
    quick: float  # misfit by a few rows
    misfit: float  # and, if that is promising, by all rows


def search_interpretations(
    free: FreeParameters, data: Measurements, stated: Comparison | None, misfit: float, pairs: bool
) -> tuple[Selection | None, dict[str, int], int, str]:
    """Search for the interpretation that fits far better than the stated one.

    data : as written. stated : their comparison at the poses that the robot reaches; None where it
        reaches too few. misfit : of the data as written. pairs : test pairs if no single
        interpretation explains the data.
    Returns the interpretation that explains the data, None without one; the number of single
    interpretations that were tested by slip, and the number of pairs; the unit, in words, in which
    the data would fit where that is no evidence, because values so small fit by chance.
    """
    written = None if stated is None else stated.data
    select = partial(_select_best, free, data, written, misfit)
    singles = _test_all(free, data, written, misfit)
    tried = dict(Counter(test.interpretation.slip for test in singles))
    best, count = select(singles, ALLOWED), 0
    if best is None and pairs:
        parameters = _test_parameters(free, data, written, misfit)
        tried |= Counter(test.interpretation.slip for test in parameters)
        best = select(parameters, ALLOWED)
    if best is None and pairs:
        tested = list(_test_pairs(free, data, written, singles, misfit))
        best, count = select(tested, ALLOWED), len(tested)
    if best is None:
        best = select(singles, misfit / FAR_BETTER if np.isfinite(misfit) else LARGEST)
        if best is not None and best.misfit > ALLOWED and not _is_robot_far(stated, best):
            best = None
    units = [test for test in singles if test.interpretation.slip == "unit"]
    possible = min(units, key=lambda test: test.misfit, default=None)
    if best is not None or possible is None or possible.misfit > ALLOWED:
        return best, tried, count, ""
    return best, tried, count, str(possible.interpretation.finding)


def _is_robot_far(stated: Comparison | None, chosen: Selection) -> bool:
    """Return whether an interpretation that leaves a misfit is true for a robot far from nominal:
    it explains the data so, and not as they are written; or its residuals become far smaller, too.
    """
    if stated is not None:
        before = compute_rms_residuals(stated)
        after = compute_rms_residuals(chosen.comparison)
        if any(FAR_BETTER * size < before.get(dimension, 0.0) for dimension, size in after.items()):
            return True
    explains = explains_after_fit(chosen.comparison)
    return explains and (stated is None or not explains_after_fit(stated))


def shares_poses(data: Measurements) -> bool:
    """Return whether rows share more than their pose: pairs of poses, or groups."""
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _test(
    listed: Sequence[Interpretation],
    screened: FloatArray,
    judge: Callable[[IntArray], FloatArray | list[float]],
    misfit: float,
) -> list[_Test]:
    """Return the tests of interpretations with misfits by a few rows: `judge` computes the misfits
    by all rows of the best that may belong to a far better fit than `misfit`.
    """
    finite = np.sort(screened[np.isfinite(screened)])
    bound = min(PROMISING * misfit / BETTER, *finite[MOST_JUDGED - 1 : MOST_JUDGED], np.inf)
    promising = np.flatnonzero((screened <= bound) & np.isfinite(screened))
    judged = np.full(len(listed), np.inf)
    judged[promising] = judge(promising)
    numbers = (np.nan_to_num(misfits, nan=np.inf).tolist() for misfits in (screened, judged))
    return [_Test(*row) for row in zip(listed, *numbers, strict=True)]


def _test_all(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    misfit: float,
    nearest: int = NEAREST,
) -> list[_Test]:
    """Test all single interpretations of data as written: those of the values, together, only if
    the robot reaches enough poses; those of the readings by their reach, and the `nearest` ones by
    residuals before parameters change.
    """
    tests: list[_Test] = []
    if reached is not None:
        of_values, few = list(list_interpretations(reached)), reached.take(_select_few(reached))

        def judge_values(promising: IntArray) -> FloatArray:
            return compute_misfits(free, reached, [of_values[i] for i in promising], THOROUGH)

        screened = compute_misfits(free, few, of_values, QUICK)
        tests = _test(of_values, screened, judge_values, misfit)
    robot, poses = free.robot, _select_few(data)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    listed = list(list_reading_interpretations(data, robot.actuators, home))
    readings = np.stack([each.apply(data).readings[poses] for each in listed])
    near, start, size = guess_frames(free, data.take(poses), readings)

    def judge(i: int, start: FloatArray | None = None, few: IntArray | None = None) -> float:
        changed = listed[i].apply(data)
        comparison = judge_data(free, changed if few is None else changed.take(few), start)
        return np.inf if comparison is None else comparison.misfit

    screened = np.full(len(listed), np.inf)
    for i in np.sort(np.argsort(size, kind="stable")[:nearest]).tolist():
        screened[near[i]] = judge(int(near[i]), start[[i]], poses)
    return tests + _test(listed, screened, lambda promising: list(map(judge, promising)), misfit)


def _test_pairs(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    singles: Sequence[_Test],
    misfit: float,
) -> Iterator[_Test]:
    """Yield tests of pairs: the most promising single ones, each with all others after it."""
    for of_values in (True, False):
        promising = [
            test
            for test in singles
            if test.interpretation.of_values == of_values and test.quick < LOWERED * misfit
        ]
        for base in sorted(promising, key=lambda test: test.quick)[:MOST_BASES]:
            changed = base.interpretation.apply(data)
            if not of_values:
                changed_reached = select_reached(free, changed)[0]
            else:
                changed_reached = None if reached is None else base.interpretation.apply(reached)
            bound = min(misfit, base.quick)
            for test in _test_all(free, changed, changed_reached, bound, NEAREST_IN_PAIRS):
                pair = combine(base.interpretation, test.interpretation)
                yield test._replace(interpretation=pair)


def _select_best(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    misfit: float,
    tested: Sequence[_Test],
    limit: float,
) -> Selection | None:
    """Select the interpretation of the smallest misfit up to `limit` that is far better than
    `misfit`; None without one.
    """

    def choose_data(interpretation: Interpretation) -> Measurements:
        return reached if interpretation.of_values and reached is not None else data

    better = [
        test
        for test in tested
        if test.misfit <= limit
        and test.misfit * BETTER < misfit
        and is_informative(free, choose_data(test.interpretation), test.interpretation, test.misfit)
    ]
    if not better:
        return None
    smallest = min(test.misfit for test in better)
    equal = [t.interpretation for t in better if t.misfit <= max(EQUALLY * smallest, 1.0)]
    best, *others = _drop_same(data, equal)
    comparison = judge_data(free, best.apply(choose_data(best)))
    if comparison is None:
        return None
    least, _ = refine_misfit(comparison)
    if not (least * BETTER < misfit and least <= limit):
        return None
    return Selection(best, comparison, least, tuple(others))


def _drop_same(
    data: Measurements, interpretations: Sequence[Interpretation]
) -> list[Interpretation]:
    """Return the interpretations without those that make the same data as an earlier one."""
    kept: list[tuple[Interpretation, list[FloatArray], list[tuple[str, ...]]]] = []
    for interpretation in interpretations:
        changed = interpretation.apply(data)
        table = [changed.readings, *(o.measured for o in changed.observations)]
        setup = [o.kind.unknown for o in changed.observations]
        if not any(
            setup == other_setup
            and all(np.allclose(a, b, equal_nan=True) for a, b in zip(table, other, strict=True))
            for _, other, other_setup in kept
        ):
            kept.append((interpretation, table, setup))
    return [interpretation for interpretation, _, _ in kept]


def _select_few(data: Measurements) -> IntArray:
    """Return poses spread over the data by which many interpretations are compared; all where rows
    share more than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(FEWEST_POSES, -(-FEW_ROWS * n // max(equations, 1)))
    if n <= count or shares_poses(data):
        return np.arange(n)
    return choose_evenly(n, count)


def _test_parameters(
    free: FreeParameters, data: Measurements, reached: Measurements | None, misfit: float
) -> list[_Test]:
    """Test interpretations that have parameters of their own: setup items that are not declared
    unknown, and other zeros of the readings.
    """

    def test_each(listed: Sequence[Interpretation], data: Measurements) -> list[_Test]:
        few = _select_few(data)

        def screen(interpretation: Interpretation) -> float:
            changed = select_reached(free, interpretation.apply(data).take(few))[0]
            if changed is None:
                return np.inf
            return exclude_far_rows(compare_with_robot(free, changed, (), QUICK)).misfit

        def judge(i: int) -> float:
            comparison = judge_data(free, listed[i].apply(data))
            return np.inf if comparison is None else refine_misfit(comparison)[0]

        screened = np.array(list(map(screen, listed)))
        return _test(listed, screened, lambda promising: list(map(judge, promising)), misfit)

    zeros = find_zero_interpretations(free, data, _select_few(data), not misfit > GROSS)
    tests = test_each(zeros, data)
    for count in (1, 2):
        if reached is not None and all(test.misfit > ALLOWED for test in tests):
            tests += test_each(list(list_setup_interpretations(reached, count)), reached)
    return tests


# Data that another interpretation explains as well as the stated one cannot show which is true.

# Number of measured residuals from which the order of a redundant robot's actuators is certain:
# those of four positions, by which no machine of another order agrees with its redundant
# readings. With fewer, poses are known from the readings.
MEASURED = 12
# Slips in the order of the actuators.
ORDERS = ("swapped-readings", "reversed-readings", "permuted-readings")
# Columns of a height, and standard deviations of the noise from which its sign matters.
HEIGHT, SIGNIFICANT = (Column("z", Dimension.LENGTH),), 10.0


def report_equals(free: FreeParameters, data: Measurements, misfit: float) -> Finding | None:
    """Report other orders of a redundant robot's actuators, or the other sign of heights, that
    explain data as well as they are written; None without any.
    """
    heights = [o for o in data.observations if o.kind.columns == HEIGHT]
    sizes = [np.nan_to_num(o.whitener[:, 0, 0] * o.measured[:, 0]) for o in heights]
    is_significant = any(np.abs(size).max(initial=0.0) > SIGNIFICANT for size in sizes)
    if len(heights) == len(data.observations) and is_significant:
        mirrored = tuple(replace(o, measured=-o.measured) for o in heights)
        opposite = compute_quick_misfit(free, replace(data, observations=mirrored))
        if opposite <= max(EQUALLY * misfit, 1.0):
            return report_finding(
                "conventions.height-sign-undecided",
                robot=free.robot.name,
                misfit=misfit,
                other_misfit=opposite,
            )
    if not is_redundant(free) or sum(o.n_residuals for o in data.observations) >= MEASURED:
        return None
    few = data.take(select_measured(data))
    orders = []
    for interpretation in list_reading_interpretations(few, free.robot.actuators):
        if interpretation.slip in ORDERS:
            comparison = judge_data(free, interpretation.apply(few))
            if comparison is not None and refine_misfit(comparison)[0] <= ALLOWED:
                orders.append(interpretation.describe())
    if not orders:
        return None
    return report_finding(
        "conventions.orders-undecided", robot=free.robot.name, alternatives=tuple(orders)
    )


def select_measured(data: Measurements) -> IntArray:
    """Return the measured poses, and others spread over the data up to `FEWEST_POSES`."""
    measured = np.unique(np.concatenate([o.rows.ravel() for o in data.observations] or [[]]))
    others = np.setdiff1d(np.arange(data.n_poses), measured)
    missing = max(FEWEST_POSES - len(measured), 0) if len(others) else 0
    spread = np.linspace(0, len(others) - 1, missing)
    return np.union1d(measured, others[np.unique(spread.astype(np.intp))]).astype(np.intp)
