# SPDX-License-Identifier: Apache-2.0
"""Recognize rows that a calibration was fitted to in other measurements, by their numbers.

A row is its readings and its measured values. A copy in another file, order or unit, without some
of its columns, as another kind of measurement (a pose whose orientation was left out is a
position), or rounded far below its noise is the same row. A repeated measurement differs by its
noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.measure.measurements import Measurements
from loopcal.measure.readings import find_steps
from loopcal.numerics.statistics import binomial_tail
from loopcal.plain_text import represent
from loopcal.typing import BoolArray, FloatArray

SAME = 1e-8  # share of what a column spans up to which two numbers are the same
SAME_READING = 1e-5  # the same for readings of rows whose measured values decide
# Probability that the m measured values of a repeat agree: each differs by less than the m-th root
# of it, in standard deviations of the noise, and by less than the largest difference.
CHANCE, LARGEST = 1e-6, 1e-2
ENOUGH = 3  # equal values by which rows of different kinds are the same
FEW = 200_000  # numbers that are compared pair by pair
ALONE = "readings"  # stands for the kind of rows that have readings alone
PREFIX = "fitted"  # first word of the names of the stored arrays


class ComparedRows(NamedTuple):
    """Rows of one kind."""

    kind: str
    readings: int  # number of their columns of readings
    content: FloatArray  # (r, c) readings, then measured values [SI]
    noise: FloatArray  # (r, c) standard deviation of each number, zero where it is not known
    poses: np.ndarray  # (r, l)

    @property
    def values(self) -> FloatArray:
        """Measured values (r, m) [SI]."""
        return self.content[:, self.readings :]


def _estimate_chance(rows: ComparedRows, fitted: FloatArray, is_same_form: bool) -> FloatArray:
    """Return the probability (r,) that a repeat agrees with its first row by rounding."""
    other = fitted[:, rows.readings :]
    compared = np.isfinite(rows.values)
    if is_same_form:
        compared &= np.isfinite(other).any(axis=0)
    steps = find_steps(_mask_constants(other))
    step = np.minimum(
        find_steps(_mask_constants(rows.values)),
        np.where(np.isfinite(steps), steps, 0.0).max(initial=0.0),
    )
    noise = rows.noise[:, rows.readings :]
    single = step / (2.0 * np.sqrt(np.pi) * np.where(noise > 0.0, noise, np.inf))
    single = np.where(compared, np.minimum(single, 1.0), np.nan)
    # the values that agree most easily; NaN is last
    easiest = -np.sort(-single, axis=1)[:, : None if is_same_form else ENOUGH]
    return np.asarray(np.nanprod(easiest, axis=1))


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
    m = int(common[rows.readings :].sum())
    if m == 0 and rows.content.shape[1] > rows.readings:
        return np.zeros(len(own), dtype=bool)
    share = np.full(len(span), SAME)
    if m > 0 and rows.readings > 0:
        share[: rows.readings] = SAME_READING
    noise = np.median(rows.noise[own], axis=0)
    limit = np.maximum(share * span, min(CHANCE ** (1.0 / max(m, 1)), LARGEST) * noise)[common]
    mine, theirs = rows.content[own][:, common] / limit, stored[:, common] / limit
    if 0 < mine.size * len(theirs) <= FEW:  # sooner than the import of a search tree
        return (np.abs(mine[:, None] - theirs).max(axis=2) < 1.0).any(axis=1)
    from scipy.spatial import KDTree

    distance, _ = KDTree(theirs).query(mine, p=np.inf, distance_upper_bound=1.0)
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


class ReusedRows(NamedTuple):
    """Rows of measurements that belong to a calibration."""

    poses: tuple[str, ...]  # labels of their poses
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]
    total: int  # number of all rows


@dataclass(frozen=True, eq=False)
class FittedRows:
    """The rows that a calibration, and those before it that are its prior, were fitted to."""

    # of each kind its name and (r, c) the readings and measured values [SI]
    groups: tuple[tuple[str, FloatArray], ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return sum(len(content) for _, content in self.groups)

    __repr__ = represent

    def joined(self, other: FittedRows) -> FittedRows:
        """Return these rows and those of another calibration."""
        return FittedRows((*self.groups, *other.groups))

    def arrays(self) -> dict[str, FloatArray]:
        """Return the rows by name, `fitted_<i>_<kind>`, to be stored."""
        return {f"{PREFIX}_{i}_{kind}": rows for i, (kind, rows) in enumerate(self.groups)}

    def count_shared(
        self, other: FittedRows, readings: int, noise: Mapping[str, FloatArray]
    ) -> int:
        """Return how many of these rows are among those of another calibration.

        readings : number of actuators. noise : of each kind the standard deviation (m,) of its
            measured values, as far as it is known [SI].
        """
        count = 0
        for kind, content in self.groups:
            width = 0 if kind == ALONE else readings
            sd = np.zeros(content.shape[1])
            if kind in noise and len(noise[kind]) == len(sd) - width:
                sd[width:] = noise[kind]
            poses = np.arange(len(content))[:, None]
            rows = ComparedRows(kind, width, content, np.broadcast_to(sd, content.shape), poses)
            count += int(other.find_copies(rows).sum())
        return count

    def find_copies(self, rows: ComparedRows) -> BoolArray:
        """Return which rows (r,) are copies of one of these."""
        copies = np.zeros(len(rows.content), dtype=bool)
        for kind, content in self.groups:
            # else the columns of both do not mean the same, as where a pose became a position
            is_same_form = kind == rows.kind and content.shape[1] == rows.content.shape[1]
            agree = (_is_among if is_same_form else _has_values_of)(rows, content)
            if agree.any() and rows.values.shape[1]:
                largest = float(_estimate_chance(rows, content, is_same_form)[agree].max())
                if largest > CHANCE:
                    # whether more agree than repeats by chance would, each with this probability
                    count = int(agree.sum())
                    repeats = sum(len(near) > 0 for near in _find_repeats(rows, content))
                    agree &= binomial_tail(count - 1, max(repeats, count), largest) < CHANCE
            copies |= agree
        return copies

    def find_in(self, data: Measurements) -> ReusedRows:
        """Return which rows of other measurements, of weight above 0, are among these."""
        labels: list[str] = []
        total, kinds = 0, {kind for kind, _ in self.groups}
        for rows in _list_rows(data):
            if rows.kind == ALONE and rows.kind not in kinds:
                continue
            reused = self.find_copies(rows)
            labels += ["/".join(data.labels[j] for j in poses) for poses in rows.poses[reused]]
            total += len(reused)
        return ReusedRows(tuple(dict.fromkeys(labels)), len(labels), total)


def collect_fitted_rows(data: Measurements, are_readings_fitted: bool = False) -> FittedRows:
    """Return the rows of measurements that a fit uses, with a weight above 0; with readings alone
    if these are fitted, as where actuators are redundant.
    """
    rows = _list_rows(data) if are_readings_fitted else _list_rows(data)[:-1]
    kept = (o for o in rows if are_readings_fitted or o.kind != ALONE)
    return FittedRows(tuple((o.kind, o.content) for o in kept))


def fitted_rows_from_arrays(arrays: Mapping[str, np.ndarray]) -> FittedRows | None:
    """Return the rows in the arrays of a run folder; None where they are not known."""
    names = [name for name in arrays if name.startswith(f"{PREFIX}_")]
    if not names:
        return None
    return FittedRows(tuple((name.split("_", 2)[2], arrays[name]) for name in names))


def _list_rows(data: Measurements) -> list[ComparedRows]:
    """Return the rows of each kind that count, then the readings of poses without such rows."""
    result, is_alone = [], np.ones(data.n_poses, dtype=bool)
    for o in data.observations:
        is_alone[o.rows] = False
        counts = np.isfinite(o.measured).any(axis=1) | (o.measured.shape[1] == 0)
        counts &= o.weight > 0.0
        poses = o.rows.reshape(len(o), o.rows[0].size if len(o) else 1)[counts]
        width = poses.shape[1] * data.readings.shape[1]
        read = data.readings[poses].reshape(len(poses), width)
        content = np.concatenate([read, o.measured[counts]], axis=1)
        variance = np.einsum("rii->ri", o.covariance)
        if variance.shape != o.measured.shape:  # other residuals than values: noise is not known
            variance = np.zeros(o.measured.shape)
        sd = np.sqrt(np.where(np.isfinite(variance) & (variance > 0.0), variance, 0.0))
        noise = np.concatenate([np.zeros((len(content), width)), sd[counts]], axis=1)
        result.append(ComparedRows(o.kind.name, width, content, noise, poses))
    if data.reading_sigma is not None:
        is_alone &= np.isfinite(data.reading_sigma).any(axis=1)
    alone, poses = data.readings[is_alone], np.flatnonzero(is_alone)[:, None]
    return [*result, ComparedRows(ALONE, 0, alone, np.zeros(alone.shape), poses)]
