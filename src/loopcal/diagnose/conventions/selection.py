# SPDX-License-Identifier: Apache-2.0
"""Search for the interpretation of measurements that explains them.

Interpretations of the values are evaluated together, those of the actuator readings one by one,
because they have their own poses. Pairs are tested only if no single interpretation explains the
data: the most promising ones are applied, and all others are tested on the result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from loopcal.diagnose.conventions.interpretations.interpretation import Interpretation, combine
from loopcal.diagnose.conventions.interpretations.reading_interpretations import (
    list_reading_interpretations,
)
from loopcal.diagnose.conventions.interpretations.setup_interpretations import (
    list_setup_interpretations,
)
from loopcal.diagnose.conventions.interpretations.value_interpretations import list_interpretations
from loopcal.diagnose.conventions.interpretations.zero_interpretations import (
    find_zero_interpretations,
)
from loopcal.diagnose.conventions.judgement import (
    BETTER,
    compute_rms_residuals,
    guess_frames,
    is_informative,
    judge_data,
)
from loopcal.diagnose.conventions.misfit import (
    ALLOWED,
    EQUALLY,
    MOST_EXCLUDED,
    QUICK,
    THOROUGH,
    Comparison,
    compare_with_robot,
    compute_misfits,
    exclude_far_rows,
    select_reached,
)
from loopcal.diagnose.conventions.refinement import explains_after_fit, refine_misfit
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.measure import Measurements
from loopcal.mechanism import compute_readings, find_directly_reachable
from loopcal.numerics.sorted_values import find_distinct
from loopcal.typing import FloatArray, IntArray

FAR_BETTER = 10.0
"""Factor by which it must fit better if tolerances and noise do not explain the rest, as of a robot
far from nominal in data with a wrong unit.
"""

GROSS = 100.0
"""Misfit above which data that contradict stated setup parameters are refused. Below it, robots far
beyond their tolerances look the same, and it is a warning.
"""

LARGEST = 10.0
"""Misfit up to which another interpretation is accepted if the robot reaches too few poses of the
data as written, which then have no misfit to compare.
"""

FEW_ROWS, FEWEST_POSES = 60, 20
"""Number of rows, and smallest number of poses, by which all interpretations are compared first."""

PROMISING, MOST_JUDGED = 2.0, 8
"""Factor by which the misfit on these rows may exceed the limit of a far better fit, and largest
number of interpretations that are judged by all rows.
"""

NEAREST, NEAREST_IN_PAIRS = 12, 4
"""Number of interpretations of the readings that are judged: those of the smallest misfit before
parameters change.
"""

LOWERED, MOST_BASES = 0.7, 3
"""Share of the misfit below which an interpretation is a base of pairs, and largest number of bases
among the values, and among the readings.
"""


class Selection(NamedTuple):
    """The selected interpretation, its comparison with the robot and its misfit, and others that
    fit equally well.
    """

    interpretation: Interpretation
    comparison: Comparison
    misfit: float
    alternatives: tuple[Interpretation, ...]


class Search(NamedTuple):
    """A finished search.

    Attributes
    ----------
    selection : the interpretation that explains the data; None without one.
    tried : slip -> number of single interpretations that were tested. pairs : number of pairs.
    """

    selection: Selection | None
    tried: dict[str, int]
    pairs: int


class _Test(NamedTuple):
    """An interpretation, its misfit by a few rows and, if that is promising, by all rows; infinite
    if it was not computed.
    """

    interpretation: Interpretation
    quick: float
    misfit: float


def search_interpretations(
    free: FreeParameters,
    data: Measurements,
    stated: Comparison | None,
    misfit: float,
    pairs: bool = True,
) -> Search:
    """Search for the interpretation that fits far better than the stated one.

    Parameters
    ----------
    data : as written. stated : their comparison at the poses that the robot reaches; None where it
        reaches too few. misfit : of the data as written. pairs : test pairs if no single
        interpretation explains the data.
    """
    written = None if stated is None else stated.data
    singles = _test_all(free, data, written, misfit)
    tried = dict(Counter(test.interpretation.slip for test in singles))
    best = _select_best(free, data, written, singles, misfit, ALLOWED)
    count = 0
    if best is None and pairs:
        parameters = _test_parameters(free, data, written, misfit)
        tried |= Counter(test.interpretation.slip for test in parameters)
        best = _select_best(free, data, written, parameters, misfit, ALLOWED)
    if best is None and pairs:
        tested = list(_test_pairs(free, data, written, singles, misfit))
        count = len(tested)
        best = _select_best(free, data, written, tested, misfit, ALLOWED)
    if best is None:
        limit = misfit / FAR_BETTER if np.isfinite(misfit) else LARGEST
        best = _select_best(free, data, written, singles, misfit, limit)
        if best is not None and best.misfit > ALLOWED and not _is_robot_far(stated, best):
            best = None
    return Search(best, tried, count)


def _is_robot_far(stated: Comparison | None, chosen: Selection) -> bool:
    """Return whether an interpretation that leaves a misfit is true for a robot far from nominal.

    Such a robot explains the data in this interpretation, and not as they are written; or the
    residuals of the given robot become far smaller, not only their misfit.
    """
    if stated is not None:
        before = compute_rms_residuals(stated)
        after = compute_rms_residuals(chosen.comparison)
        if any(FAR_BETTER * size < before.get(dimension, 0.0) for dimension, size in after.items()):
            return True
    if not explains_after_fit(chosen.comparison, ALLOWED):
        return False
    return stated is None or not explains_after_fit(stated, ALLOWED)


def shares_poses(data: Measurements) -> bool:
    """Return whether rows share more than their pose: pairs of poses, or groups."""
    return any(o.kind.poses_per_row > 1 or bool((o.group != "").any()) for o in data.observations)


def _test_all(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    misfit: float,
    nearest: int = NEAREST,
) -> list[_Test]:
    """Test all single interpretations of data as written, `reached` where the robot reaches them;
    those of the values only if it reaches enough poses.
    """
    values = [] if reached is None else _test_values(free, reached, misfit)
    return values + _test_readings(free, data, misfit, nearest)


def _test_pairs(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    singles: Sequence[_Test],
    misfit: float,
) -> Iterator[_Test]:
    """Yield tests of pairs: the most promising single ones, each with all others after it."""
    for of_readings in (False, True):
        bases = sorted(
            (
                test
                for test in singles
                if (test.interpretation.observation is None) is of_readings
                and test.quick < LOWERED * misfit
            ),
            key=lambda test: test.quick,
        )
        for base in bases[:MOST_BASES]:
            changed = base.interpretation.apply(data)
            if of_readings:
                reach = select_reached(free, changed)
                changed_reached = reach.data if reach.is_enough else None
            else:
                changed_reached = None if reached is None else base.interpretation.apply(reached)
            bound = min(misfit, base.quick)
            for test in _test_all(free, changed, changed_reached, bound, NEAREST_IN_PAIRS):
                yield test._replace(
                    interpretation=combine(base.interpretation, test.interpretation)
                )


def _select_best(
    free: FreeParameters,
    data: Measurements,
    reached: Measurements | None,
    tested: Sequence[_Test],
    misfit: float,
    limit: float,
) -> Selection | None:
    """Select the interpretation of the smallest misfit up to `limit` that is far better than
    `misfit`; None without one.
    """

    def choose_data(interpretation: Interpretation) -> Measurements:
        of_values = all(part.observation is not None for part in interpretation.parts)
        return reached if of_values and reached is not None else data

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
    kept: list[Interpretation] = []
    tables: list[list[FloatArray]] = []
    setups: list[list[tuple[str, ...]]] = []
    for interpretation in interpretations:
        changed = interpretation.apply(data)
        table = [changed.readings, *(o.measured for o in changed.observations)]
        setup = [o.kind.unknown for o in changed.observations]
        if not any(
            setup == other_setup
            and all(np.allclose(a, b, equal_nan=True) for a, b in zip(table, other, strict=True))
            for other, other_setup in zip(tables, setups, strict=True)
        ):
            kept.append(interpretation)
            tables.append(table)
            setups.append(setup)
    return kept


def _select_few(data: Measurements) -> IntArray:
    """Return poses spread over the data by which many interpretations are compared; all where rows
    share more than their pose.
    """
    n = data.n_poses
    equations = sum(o.whitener.shape[-1] * len(o) for o in data.observations)
    count = max(FEWEST_POSES, -(-FEW_ROWS * n // max(equations, 1)))
    if n <= count or shares_poses(data):
        return np.arange(n)
    return find_distinct(np.linspace(0, n - 1, count).astype(np.intp))


def _test_values(free: FreeParameters, data: Measurements, misfit: float) -> list[_Test]:
    """Test all interpretations of the measured values."""
    listed = list(list_interpretations(data))
    screened = compute_misfits(free, data.take(_select_few(data)), listed, QUICK)
    promising = _select_promising(screened, misfit)
    judged = np.full(len(listed), np.inf)
    judged[promising] = compute_misfits(free, data, [listed[i] for i in promising], THOROUGH)
    return _list_tests(listed, screened, judged)


def _test_readings(
    free: FreeParameters, data: Measurements, misfit: float, nearest: int
) -> list[_Test]:
    """Test all interpretations of the readings: the reach of all, the residuals before parameters
    change of those in reach, and the misfit of the `nearest` ones.
    """
    robot, poses = free.robot, _select_few(data)
    home = compute_readings(robot, robot.values[None], robot.home_state)[0, 0]
    listed = list(list_reading_interpretations(data, robot.actuators, home))
    readings = np.stack([interpretation.change(data.readings)[poses] for interpretation in listed])
    reached = find_directly_reachable(
        robot, robot.values[None], readings.reshape(1, -1, readings.shape[-1])
    ).reshape(readings.shape[:2])
    near = np.flatnonzero(reached.mean(axis=1) >= 1.0 - MOST_EXCLUDED)
    start, size = guess_frames(free, data.take(poses), readings[near], reached[near])
    screened, judged = np.full(len(listed), np.inf), np.full(len(listed), np.inf)
    for i in np.sort(np.argsort(size, kind="stable")[:nearest]):
        changed = listed[near[i]].apply(data)
        comparison = judge_data(free, changed.take(poses), start[[i]])
        screened[near[i]] = np.inf if comparison is None else comparison.misfit
    for i in _select_promising(screened, misfit):
        comparison = judge_data(free, listed[i].apply(data))
        judged[i] = np.inf if comparison is None else comparison.misfit
    return _list_tests(listed, screened, judged)


def _test_parameters(
    free: FreeParameters, data: Measurements, reached: Measurements | None, misfit: float
) -> list[_Test]:
    """Test interpretations that have parameters of their own: setup items that are not declared
    unknown, and other zeros of the readings.
    """
    few = _select_few(data)
    zeros = find_zero_interpretations(free, data, few, not misfit > GROSS)
    tests = [_test_one(free, data, few, zero, misfit) for zero in zeros]
    if reached is None:
        return tests
    for count in (1, 2):
        if all(test.misfit > ALLOWED for test in tests):
            few = _select_few(reached)
            setups = list_setup_interpretations(reached, count)
            tests += [_test_one(free, reached, few, setup, misfit) for setup in setups]
    return tests


def _test_one(
    free: FreeParameters,
    data: Measurements,
    few: IntArray,
    interpretation: Interpretation,
    misfit: float,
) -> _Test:
    """Test one interpretation by a few poses and, if that is promising, by all rows."""
    changed = interpretation.apply(data)
    screened = judged = np.inf
    reach = select_reached(free, changed.take(few))
    if reach.is_enough:
        quick = exclude_far_rows(compare_with_robot(free, reach.data, (), QUICK))
        screened = float(np.nan_to_num(quick.misfit, nan=np.inf))
    if screened <= PROMISING * misfit / BETTER:
        comparison = judge_data(free, changed)
        if comparison is not None and np.isfinite(comparison.misfit):
            judged = refine_misfit(comparison)[0]
    return _Test(interpretation, screened, judged)


def _list_tests(
    listed: Sequence[Interpretation], screened: FloatArray, judged: FloatArray
) -> list[_Test]:
    """Return tests; a misfit of too few rows is infinite."""
    numbers = (np.nan_to_num(misfits, nan=np.inf).tolist() for misfits in (screened, judged))
    return [_Test(*row) for row in zip(listed, *numbers, strict=True)]


def _select_promising(misfits: FloatArray, misfit: float) -> IntArray:
    """Return the places of the best misfits that may belong to a far better fit than `misfit`."""
    finite = np.sort(misfits[np.isfinite(misfits)])
    bound = min(PROMISING * misfit / BETTER, *finite[MOST_JUDGED - 1 : MOST_JUDGED], np.inf)
    return np.flatnonzero((misfits <= bound) & np.isfinite(misfits))
