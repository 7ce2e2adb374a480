# SPDX-License-Identifier: Apache-2.0
"""Find poses that repeat another one: their readings differ by less than shows in the measurements.

A controller records the readings of each visit of a pose with jitter of its own, so repeats seldom
have equal readings. The tolerance of a reading is the share of its range that the noise has of the
range of the measured values: a change by it moves no measured value much beyond its noise. Poses
are repeats if all their readings lie within this tolerance and no other pose is near. A slow scan,
whose poses form a chain longer than the tolerance, has no repeats but at equal readings.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from loopcal.measure.observations import Observations
from loopcal.numerics.distributions import binomial_tail
from loopcal.numerics.statistics import compute_median
from loopcal.typing import FloatArray, IntArray

# Standard deviations of the noise by which repeats may differ. The readings of a few visits span
# two to four standard deviations of their jitter, so jitter below the noise is accepted. Errors
# of the model change over a much larger share of the range.
SIGMAS = 3.0
# Largest tolerance, as a share of the range of a reading, however coarse the instrument is: the
# errors of a geometry are equal at poses that are this near.
LARGEST_SHARE = 1e-3
# Least range of a reading, as a share of the largest one: measurements of one pose have no range.
LEAST_RANGE = 1e-2
RANGE = (0.1, 0.9)  # quantiles, so that a wrong row does not change the tolerance
MISSING = 1e300  # stands for readings that are NaN: equal to each other
STEP, STEPS = 4.0, 8  # factor and number of the finer gaps at which long chains are divided


def find_reading_tolerance(
    readings: FloatArray,
    observations: Sequence[Observations],
    reading_sigma: FloatArray | None = None,
) -> FloatArray:
    """Return by how much each reading (a,) [SI] of repeats may differ.

    readings : (n, a) [SI]. observations : with the noise of their rows. reading_sigma : (n, a)
        [SI] or None, of uncertain readings, which differ by it although the pose is the same.
    """
    share = LARGEST_SHARE
    for o in observations:
        places = {column.name: j for j, column in enumerate(o.kind.columns)}
        for i, column in enumerate(o.kind.noise_columns):
            seen = o.present[:, i] & (o.weight > 0.0)
            if seen.any() and column.name in places:
                span = np.ptp(np.quantile(o.measured[seen, places[column.name]], RANGE))
                sd = compute_median(np.sqrt(o.covariance[seen, i, i]))
                share = min(share, SIGMAS * sd / span) if span > 0.0 else share
    is_known = np.isfinite(readings)
    first = np.take_along_axis(readings, is_known.argmax(axis=0)[None], axis=0)
    known = np.where(is_known, readings, np.nan_to_num(first))
    least = LEAST_RANGE * np.abs(known).max(initial=0.0)
    tolerance = share * np.maximum(np.ptp(np.quantile(known, RANGE, axis=0), axis=0), least)
    if reading_sigma is not None:
        jitter = np.median(np.where(np.isfinite(reading_sigma), reading_sigma, 0.0), axis=0)
        tolerance = np.maximum(tolerance, 2.0 * SIGMAS * jitter)
    return np.asarray(tolerance)


def find_repeats(readings: FloatArray, tolerance: FloatArray) -> IntArray:
    """Return the number (n,) of the pose that each pose repeats, whatever their order.

    Poses without a gap above the tolerance (a,) between their readings (n, a) are repeats where all
    lie within the tolerance. Longer chains are divided at smaller gaps, in the end between all
    readings that differ.
    """
    values, sorting = np.nan_to_num(readings, nan=MISSING), np.zeros((0, 0), dtype=np.intp)
    label, is_open = np.zeros(len(values), dtype=np.intp), np.ones(len(values), dtype=bool)
    for gap in (*(tolerance / STEP**k for k in range(STEPS)), np.zeros_like(tolerance)):
        if len(sorting) != np.count_nonzero(is_open):
            sorting = np.argsort(values[is_open], axis=0, kind="stable")
        label[is_open] = label.max() + 1 + _divide(values[is_open], gap, label[is_open], sorting)
        label = np.unique(label, return_inverse=True)[1].reshape(-1)
        order = np.argsort(label, kind="stable")
        begin = np.flatnonzero(np.diff(label[order], prepend=-1))
        ordered = values[order]
        extent = np.maximum.reduceat(ordered, begin) - np.minimum.reduceat(ordered, begin)
        is_open = np.any(extent > tolerance, axis=1)[label]
        if not is_open.any():
            break
    return label


def _divide(values: FloatArray, gap: FloatArray, label: IntArray, sorting: IntArray) -> IntArray:
    """Return the numbers (n,) of groups that no column of values (n, a) can divide at a gap above
    that of the column (a,), within those of a label (n,). `sorting` (n, a) orders each column.
    """
    count = 0
    while (groups := int(label.max()) + 1) > count:
        count = groups
        for column, largest, by_column in zip(values.T, gap, sorting.T, strict=True):
            order = by_column[np.argsort(label[by_column], kind="stable")]
            is_new = (np.diff(label[order]) != 0) | (np.diff(column[order]) > largest)
            label = np.empty_like(label)
            label[order] = np.concatenate([[0], np.cumsum(is_new)])
    return label


# Probability of refusing measurements in which every row was measured. Stated sigmas may be larger
# than the noise of repeats by this factor: those of one session share errors of the instrument.
CHANCE, OVERSTATED = 1e-5, 3.0
LEVELS = (1e-1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-6, 1e-9)  # of agreement [standard deviations]
# Steps [SI] of lengths and of angles of which the rounding of values is a multiple.
SMALLEST_STEPS = (1e-9, np.deg2rad(1e-7))
ROUNDED, FULL_DIGITS = 1e-3, 1e-13  # part of a step that is rounding, and step of unrounded numbers


def find_copies(member: IntArray, values: FloatArray, sd: FloatArray, degrees: int) -> IntArray:
    """Return which earlier row each row (r,) copies, perhaps with fewer digits; -1 for none.

    Two measurements of one value differ by at most e standard deviations with the probability
    `(2 floor(e sigma / s) + 1) s / (2 sqrt(pi) sigma)`, rounded to steps s. Rows are copies where
    more of the repeats agree in all values than the binomial distribution explains. So an equal
    height says nothing if the step is coarse, unless most heights of the file are equal.

    member : (r,) equal for rows of one pose. values : (r, c) [SI], NaN where absent. sd : (c,)
        [SI]. degrees : how many of the c values are independent.
    """
    result, sizes = np.full(len(member), -1), np.bincount(member)
    rows = np.flatnonzero(sizes[member] > 1)
    step, filled = find_steps(values) / sd, np.nan_to_num(values / sd, nan=MISSING)
    repeats, pairs = int((sizes - 1).clip(0).sum()), float((sizes * (sizes - 1.0) / 2.0).sum())
    for level in LEVELS:
        if not len(rows):
            break
        sorting = np.argsort(filled[rows], axis=0, kind="stable")
        label = _divide(filled[rows], np.full(len(sd), level), member[rows], sorting)
        _, first, group = np.unique(label, return_index=True, return_inverse=True)
        original, agreeing = rows[first[group.reshape(-1)]], len(rows) - len(first)
        single = OVERSTATED * (2.0 * np.floor(level / step) + 1.0) * step / (2.0 * np.sqrt(np.pi))
        single = np.sort(np.minimum(np.nan_to_num(single, nan=1.0), 1.0))
        chance = min(pairs / repeats * float(np.prod(single[-degrees:])), 1.0)
        if agreeing and binomial_tail(agreeing - 1, repeats, chance) < CHANCE:
            result[rows] = np.where(original < rows, original, -1)
            break
        rows = rows[np.bincount(label)[label] > 1]  # the others agree at no smaller level
    return result


def find_steps(values: FloatArray) -> FloatArray:
    """Return the step (c,) to which the values (r, c) of each column are rounded: the largest of
    which all are multiples, `FULL_DIGITS` where there is none; infinite for columns of zeros.
    """
    numbers, steps = np.nan_to_num(values), np.full(values.shape[1], FULL_DIGITS)
    for unit in SMALLEST_STEPS:
        counts = np.rint(numbers / unit)
        is_multiple = (np.abs(numbers / unit - counts) < ROUNDED).all(axis=0)
        step = unit * np.gcd.reduce(counts.astype(np.int64), axis=0, initial=0)
        steps = np.where(is_multiple, np.maximum(steps, step), steps)
    return np.where(numbers.any(axis=0), steps, np.inf)
