# SPDX-License-Identifier: Apache-2.0
"""Recognize rows that a calibration was fitted to in other measurements, by their numbers.

A row is its readings and its measured values. A copy in another file, order or unit, without some
of its columns, as another kind of measurement (a pose whose orientation was left out is a
position), or rounded far below its noise is the same row. A repeated measurement differs by its
noise, see `loopcal.measure.row_agreement`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.measure.kinds import READINGS
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.measure.row_agreement import ComparedRows, find_agreeing
from loopcal.typing import BoolArray, FloatArray, IntArray

PREFIX = "fitted"
"""First word of the names of the stored arrays."""


class ReusedRows(NamedTuple):
    """Rows of measurements that belong to a calibration.

    Attributes
    ----------
    poses : labels of their poses. count : number of these rows. total : number of all rows.
    """

    poses: tuple[str, ...]
    count: int  # pyright: ignore[reportIncompatibleMethodOverride]
    total: int


@dataclass(frozen=True, eq=False)
class FittedRows:
    """The rows that a calibration, and those before it that are its prior, were fitted to.

    Attributes
    ----------
    groups : of each kind its name and (r, c) the readings and measured values [SI].
    """

    groups: tuple[tuple[str, FloatArray], ...] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return sum(len(content) for _, content in self.groups)

    def __repr__(self) -> str:
        """Return the number of rows and their kinds."""
        kinds = ", ".join(dict.fromkeys(kind for kind, _ in self.groups))
        return f"<FittedRows: {len(self)} rows{f' of {kinds}' if kinds else ''}>"

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

        Parameters
        ----------
        readings : number of actuators. noise : of each kind the standard deviation (m,) of its
            measured values, as far as it is known [SI].
        """
        count = 0
        for kind, content in self.groups:
            width = 0 if kind == READINGS else readings
            sd = np.zeros(content.shape[1])
            if kind in noise and len(noise[kind]) == len(sd) - width:
                sd[width:] = noise[kind]
            poses = np.arange(len(content))[:, None]
            rows = ComparedRows(kind, width, content, np.broadcast_to(sd, content.shape), poses)
            shared = np.zeros(len(content), dtype=bool)
            for name, fitted in other.groups:
                is_same_form = name == kind and fitted.shape[1] == content.shape[1]
                shared |= find_agreeing(rows, fitted, is_same_form)
            count += int(shared.sum())
        return count

    def find_in(self, data: Measurements) -> ReusedRows:
        """Return which rows of other measurements are among these; rows of weight 0 do not count.

        Parameters
        ----------
        data : the other measurements.
        """
        labels: list[str] = []
        total, kinds = 0, {kind for kind, _ in self.groups}
        for rows in _list_rows(data):
            if rows.kind == READINGS and rows.kind not in kinds:
                continue
            reused = np.zeros(len(rows.content), dtype=bool)
            for kind, content in self.groups:
                is_same_form = kind == rows.kind and content.shape[1] == rows.content.shape[1]
                reused |= find_agreeing(rows, content, is_same_form)
            labels += ["/".join(data.labels[j] for j in poses) for poses in rows.poses[reused]]
            total += len(reused)
        return ReusedRows(tuple(dict.fromkeys(labels)), len(labels), total)


def collect_fitted_rows(data: Measurements, are_readings_fitted: bool = False) -> FittedRows:
    """Return the rows of measurements that a fit uses: those with a weight above 0.

    Parameters
    ----------
    data : the fitted measurements.
    are_readings_fitted : whether readings alone are fitted, as where actuators are redundant.
    """
    groups = [
        (o.kind.name, _take_content(o, data.readings)[1])
        for o in data.observations
        if are_readings_fitted or o.kind.name != READINGS
    ]
    if are_readings_fitted:
        groups.append((READINGS, data.readings[_find_lonely_readings(data)]))
    return FittedRows(tuple(groups))


def fitted_rows_from_arrays(arrays: Mapping[str, np.ndarray]) -> FittedRows | None:
    """Return the rows in the arrays of a run folder; None where an older version wrote it."""
    names = [name for name in arrays if name.startswith(f"{PREFIX}_")]
    if not names:
        return None
    return FittedRows(tuple((name.split("_", 2)[2], arrays[name]) for name in names))


def _list_rows(data: Measurements) -> list[ComparedRows]:
    """Return the rows of each kind that count, then the readings of poses without such rows."""
    result = []
    for o in data.observations:
        counts, content, poses = _take_content(o, data.readings)
        width = content.shape[1] - o.measured.shape[1]
        noise = np.concatenate([np.zeros((len(content), width)), _state_noise(o)[counts]], axis=1)
        result.append(ComparedRows(o.kind.name, width, content, noise, poses))
    is_alone = _find_lonely_readings(data)
    alone, poses = data.readings[is_alone], np.flatnonzero(is_alone)[:, None]
    return [*result, ComparedRows(READINGS, 0, alone, np.zeros(alone.shape), poses)]


def _take_content(
    rows: Observations, readings: FloatArray
) -> tuple[BoolArray, FloatArray, IntArray]:
    """Return which rows (r,) count, and of these the readings with the measured values, and the
    poses.
    """
    counts = np.isfinite(rows.measured).any(axis=1) | (rows.measured.shape[1] == 0)
    counts &= rows.weight > 0.0
    poses = rows.rows.reshape(len(rows), rows.rows[0].size if len(rows) else 1)[counts]
    read = readings[poses].reshape(len(poses), poses.shape[1] * readings.shape[1])
    return counts, np.concatenate([read, rows.measured[counts]], axis=1), poses


def _find_lonely_readings(data: Measurements) -> BoolArray:
    """Return the poses (n,) without a row whose readings count."""
    is_alone = np.ones(data.n_poses, dtype=bool)
    for o in data.observations:
        is_alone[o.rows] = False
    if data.reading_sigma is not None:
        is_alone &= np.isfinite(data.reading_sigma).any(axis=1)
    return is_alone


def _state_noise(rows: Observations) -> FloatArray:
    """Return the standard deviation (r, c) of each measured value; zero where the kind has other
    residuals than values.
    """
    variance = np.einsum("rii->ri", rows.covariance)
    if variance.shape != rows.measured.shape:
        return np.zeros(rows.measured.shape)
    return np.sqrt(np.where(np.isfinite(variance) & (variance > 0.0), variance, 0.0))
