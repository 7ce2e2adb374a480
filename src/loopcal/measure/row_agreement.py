# SPDX-License-Identifier: Apache-2.0
"""Compare rows of measurements by their numbers: which are copies, and which are repeats.

All m values of a repeat agree with the first row by chance with a probability below CHANCE, if they
are written with enough digits. Values that are rounded to a step r agree more often, each with the
probability r / (2 sqrt(pi) sigma), if r is not much above sigma. Rows of such values count as
copies where more of them agree than repeats would: the binomial probability is below CHANCE.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from loopcal.typing import BoolArray, FloatArray

SAME = 1e-8
"""Share of what a column spans up to which two numbers are the same."""

SAME_READING = 1e-5
"""The same for readings of rows whose measured values decide."""

CHANCE = 1e-6
"""Probability that the m measured values of a repeat agree: each differs by less than the m-th root
of it, in standard deviations of the noise.
"""

LARGEST = 1e-2
"""Largest such difference."""

ENOUGH = 3
"""Number of equal values by which rows of different kinds are the same."""

SMALLEST_STEPS = (1e-9, np.deg2rad(1e-7))
"""Steps [SI] of lengths and of angles of which the rounding of values is a multiple."""


class ComparedRows(NamedTuple):
    """Rows of one kind: `content` (r, c) are `readings` columns of readings, then measured values
    [SI]; `noise` (r, c) is the standard deviation of each number, zero where it is not known;
    `poses` (r, l) are their poses.
    """

    kind: str
    readings: int
    content: FloatArray
    noise: FloatArray
    poses: np.ndarray

    @property
    def values(self) -> FloatArray:
        """Measured values (r, m) [SI]."""
        return self.content[:, self.readings :]


def find_agreeing(rows: ComparedRows, fitted: FloatArray, is_same_form: bool) -> BoolArray:
    """Return which rows (r,) are copies of one of the fitted rows (k, c).

    Parameters
    ----------
    rows : in question. fitted : readings and measured values [SI].
    is_same_form : whether the columns of both mean the same; otherwise values are looked for in all
        columns, as where a pose became a position.
    """
    agree = _is_among(rows, fitted) if is_same_form else _has_values_of(rows, fitted)
    if not agree.any() or not rows.values.shape[1]:
        return agree
    chance = _estimate_chance(rows, fitted, is_same_form)
    largest = float(chance[agree].max())
    return agree & (largest <= CHANCE or _is_no_chance(rows, fitted, int(agree.sum()), largest))


def _is_no_chance(rows: ComparedRows, fitted: FloatArray, count: int, chance: float) -> bool:
    """Return whether more rows agree than repeats by chance would, each with this probability."""
    from loopcal.numerics.special_functions import bdtrc

    repeats = sum(len(near) > 0 for near in _find_repeats(rows, fitted))
    return bool(bdtrc(count - 1, max(repeats, count), chance) < CHANCE)


def _estimate_chance(rows: ComparedRows, fitted: FloatArray, is_same_form: bool) -> FloatArray:
    """Return the probability (r,) that the values of a repeat agree with those of its first row by
    rounding.
    """
    other = fitted[:, rows.readings :]
    compared = np.isfinite(rows.values)
    if is_same_form:
        compared &= np.isfinite(other).any(axis=0)
    steps = _find_steps(other)
    step = np.minimum(
        _find_steps(rows.values), np.where(np.isfinite(steps), steps, 0.0).max(initial=0.0)
    )
    noise = rows.noise[:, rows.readings :]
    single = step / (2.0 * np.sqrt(np.pi) * np.where(noise > 0.0, noise, np.inf))
    single = np.where(compared, np.minimum(single, 1.0), np.nan)
    # the values that agree most easily; NaN is last
    easiest = -np.sort(-single, axis=1)[:, : None if is_same_form else ENOUGH]
    return np.asarray(np.nanprod(easiest, axis=1))


def _find_steps(values: FloatArray) -> FloatArray:
    """Return the step (c,) to which the values (r, c) of each column are rounded: the largest of
    which all are multiples; infinite for columns that say nothing.
    """
    values = _mask_constants(values)
    steps = []
    for unit in SMALLEST_STEPS:
        counts = np.rint(np.nan_to_num(values) / unit).astype(np.int64)
        steps.append(unit * np.gcd.reduce(counts, axis=0, initial=0))
    step = np.max(steps, axis=0)
    return np.where(step > 0.0, step, np.inf)


def _find_repeats(rows: ComparedRows, fitted: FloatArray) -> list[list[int]]:
    """Return for each row (r,) which fitted rows have its readings."""
    from scipy.spatial import KDTree

    n = rows.readings
    result: list[list[int]] = [[] for _ in rows.content]
    own, stored = (np.isfinite(part[:, :n]).all(axis=1) for part in (rows.content, fitted))
    if n == 0 or fitted.shape[1] <= n or not own.any() or not stored.any():
        return result
    readings, places = fitted[stored, :n], np.flatnonzero(stored)
    span = np.maximum(np.ptp(readings, axis=0), np.abs(readings).max(axis=0))
    limit = SAME_READING * np.where(span > 0.0, span, 1.0)
    asked = np.flatnonzero(own)
    near = KDTree(readings / limit).query_ball_point(
        rows.content[asked, :n] / limit, r=1.0, p=np.inf
    )
    for i, neighbors in zip(asked, near, strict=True):
        result[i] = places[neighbors].tolist()
    return result


def _is_among(rows: ComparedRows, fitted: FloatArray) -> BoolArray:
    """Return which rows (r,) agree with one of the fitted rows (k, c) in all numbers that both
    have, among them a measured value.
    """
    result = np.zeros(len(rows.content), dtype=bool)
    if not len(fitted) or not len(result):
        return result
    filled = np.where(np.isnan(fitted), 0.0, fitted)
    span = np.maximum(np.ptp(filled, axis=0), 1e-3 * np.abs(filled).max(axis=0))
    span = np.where(span > 0.0, span, 1.0)
    masks, mine = np.unique(np.isfinite(rows.content), axis=0, return_inverse=True)
    others, theirs = np.unique(np.isfinite(fitted), axis=0, return_inverse=True)
    for i, mask in enumerate(masks):
        own = np.flatnonzero(mine.reshape(-1) == i)
        for j, other in enumerate(others):
            common = mask & other
            stored = fitted[theirs.reshape(-1) == j]
            result[own] |= _agree(rows, own, stored, common, span)
    return result


def _agree(
    rows: ComparedRows, own: np.ndarray, stored: FloatArray, common: BoolArray, span: FloatArray
) -> BoolArray:
    """Return which of the rows `own` agree with a stored row in the `common` columns (c,)."""
    from scipy.spatial import KDTree

    m = int(common[rows.readings :].sum())
    if m == 0 and rows.content.shape[1] > rows.readings:
        return np.zeros(len(own), dtype=bool)
    share = np.full(len(span), SAME)
    if m > 0 and rows.readings > 0:
        share[: rows.readings] = SAME_READING
    noise = np.median(rows.noise[own], axis=0)
    limit = np.maximum(share * span, min(CHANCE ** (1.0 / max(m, 1)), LARGEST) * noise)[common]
    distance, _ = KDTree(stored[:, common] / limit).query(
        rows.content[own][:, common] / limit, p=np.inf, distance_upper_bound=1.0
    )
    return np.isfinite(distance)


def _has_values_of(rows: ComparedRows, fitted: FloatArray) -> BoolArray:
    """Return which rows (r,) have the readings of one of the fitted rows (k, c) of another kind, or
    of other columns, and its values: all that one of the two has, or ENOUGH. Values that no row
    changes, such as the height of a planar robot, do not count.
    """
    values, others = _mask_constants(rows.values), _mask_constants(fitted[:, rows.readings :])
    result = np.zeros(len(values), dtype=bool)
    for i, candidates in enumerate(_find_repeats(rows, fitted)):
        other = others[candidates]
        count = np.isfinite(other).sum(axis=1)
        needed = np.minimum(np.minimum(count, np.isfinite(values[i]).sum()), ENOUGH)
        chance = np.minimum(CHANCE ** (1.0 / np.maximum(needed, 1)), LARGEST)
        noise = rows.noise[i, rows.readings :]
        same = np.maximum(chance[:, None] * noise, SAME * np.abs(values[i]))
        distance = np.abs(values[i][:, None] - other[:, None, :])  # NaN is not near
        equal = (distance <= same[:, :, None]).any(axis=2).sum(axis=1)
        result[i] = bool(((needed > 0) & (equal >= needed)).any())
    return result


def _mask_constants(values: FloatArray) -> FloatArray:
    """Return values (r, c) with NaN for zeros and where a column of several rows is constant."""
    known = np.isfinite(values)
    low, high = (np.where(known, values, end) for end in (np.inf, -np.inf))
    constant = (high.max(axis=0, initial=-np.inf) <= low.min(axis=0, initial=np.inf)) & (
        known.sum(axis=0) > 1
    )
    return np.where(constant | (values == 0.0), np.nan, values)
