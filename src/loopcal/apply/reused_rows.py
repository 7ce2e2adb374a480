# SPDX-License-Identifier: Apache-2.0
"""Rows that a calibration used, recognized again in data for validation.

A row is its readings and its measured values. Two rows are the same where all numbers agree to the
eighth digit of what their column spans: a copy in another file, order or unit is recognized, and a
repeated measurement differs by its noise.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopcal.errors import DataError
from loopcal.findings import Finding, Severity, report_finding
from loopcal.measure import Measurements, Observations
from loopcal.typing import BoolArray, FloatArray

PREFIX = "fitted"
"""First word of the names of the stored arrays."""

SAME = 1e-8
"""Share of what a column spans up to which two numbers are the same."""

ABSENT = 1e15
"""Stands for an absent number, in units of `SAME`: farther than any number is from another."""

REFUSED_SHARE = 0.5
"""Share of reused rows from which data are refused for validation."""


def collect_fitted_rows(
    data: Measurements, excluded: tuple[str, ...] = ()
) -> dict[str, FloatArray]:
    """Return the rows that a calibration uses, to be stored with it.

    Parameters
    ----------
    data : the fitted data. excluded : labels of poses that were excluded from the fit.

    Returns
    -------
    `fitted_<i>_<kind>` -> (r, ..) readings and measured values [SI], without rows of weight 0.
    """
    rows = {}
    for i, o in enumerate(data.observations):
        labels = np.asarray(data.labels)[o.rows.reshape(len(o), -1)]
        used = (o.weight > 0.0) & ~np.isin(labels, excluded).any(axis=1)
        rows[f"{PREFIX}_{i}_{o.kind.name}"] = _content(data, o)[used]
    return rows


def find_reused_rows(stored: Mapping[str, np.ndarray], data: Measurements) -> Finding | None:
    """Return the finding that some rows belong to a calibration; None where no row does.

    Parameters
    ----------
    stored : arrays of a run folder, among them those of `collect_fitted_rows`.
    data : the data for validation.

    Raises
    ------
    DataError : half of the rows or more belong to it.
    """
    labels, total = [], 0
    for o in data.observations:
        rows = _content(data, o)
        reused = np.zeros(len(o), dtype=bool)
        for name, fitted in stored.items():
            if not name.startswith(f"{PREFIX}_") or name.split("_", 2)[2] != o.kind.name:
                continue
            if len(fitted) and fitted.shape[1] == rows.shape[1]:
                reused |= _is_among(rows, fitted)
        labels += [
            "/".join(data.labels[j] for j in np.ravel(o.rows[k])) for k in np.flatnonzero(reused)
        ]
        total += len(o)
    if not labels:
        return None
    refused = len(labels) >= REFUSED_SHARE * total
    finding = report_finding(
        "validation.rows-reused",
        Severity.REFUSAL if refused else Severity.WARNING,
        count=len(labels),
        total=total,
        poses=tuple(dict.fromkeys(labels)),
    )
    if refused:
        raise DataError(finding)
    return finding


def _content(data: Measurements, rows: Observations) -> FloatArray:
    """Return readings and measured values (r, ..) of rows."""
    poses = rows.rows.reshape(len(rows), -1)
    return np.concatenate([data.readings[poses].reshape(len(rows), -1), rows.measured], axis=1)


def _is_among(rows: FloatArray, fitted: FloatArray) -> BoolArray:
    """Return which rows (r,) of one array (r, c) are among those (k >= 1, c) of another."""
    from scipy.spatial import KDTree

    filled = np.where(np.isnan(fitted), 0.0, fitted)
    limit = SAME * np.maximum(np.ptp(filled, axis=0), 1e-3 * np.abs(filled).max(axis=0))
    limit = np.where(limit > 0.0, limit, SAME)
    scaled, stored = (np.nan_to_num(array / limit, nan=ABSENT) for array in (rows, fitted))
    distance, _ = KDTree(stored).query(scaled, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(distance)
