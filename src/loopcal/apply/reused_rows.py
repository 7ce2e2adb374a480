# SPDX-License-Identifier: Apache-2.0
"""The rows that a run was fitted to, kept in its folder, so that they are not taken for unseen ones
under another name.

A row is its readings and its measured values. It is the same where all agree to the eighth digit of
what the column spans: a copy in another file, order or unit is found again, and a repeat of the
measurement differs by its noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from loopcal.errors import DataError

if TYPE_CHECKING:
    import numpy as np

    from loopcal.measure import Measurements, Observations

PREFIX = "fitted"
SAME = 1e-8
"""Share of what a column spans up to which two numbers are the same."""

ABSENT = 1e15
"""Stands for a number that is absent, in units of what is the same: farther than any number is from
another.
"""

SHOWN = 8
"""Poses that are named."""


def fitted_rows(data: Measurements, dropped: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """Return `fitted_<i>_<kind>` -> (r, ..) readings and measured values [SI] of the rows that were
    fitted.

    Parameters
    ----------
    data : what was fitted. dropped : labels of poses that were left out; rows without weight were,
        too.
    """
    import numpy as np

    found = {}
    for i, o in enumerate(data.observations):
        out = np.isin(np.asarray(data.labels)[o.rows.reshape(len(o), -1)], dropped).any(axis=1)
        found[f"{PREFIX}_{i}_{o.kind.name}"] = _content(data, o)[(o.weight > 0.0) & ~out]
    return found


def seen_before(stored: Mapping[str, np.ndarray], data: Measurements, override: str = "") -> str:
    """Return a sentence where some rows are among those that a run was fitted to; empty where none
    is.

    Parameters
    ----------
    stored : arrays of the run, among them those of `fitted_rows`. data : rows that are to be
        unseen.
    override : how a user of the caller accepts them; closes the message.

    Raises
    ------
    DataError
        Half of the rows and more are.
    """
    import numpy as np

    labels, count = [], 0
    for o in data.observations:
        own = _content(data, o)
        names = (
            name
            for name in stored
            if name.startswith(f"{PREFIX}_") and name.split("_", 2)[2] == o.kind.name
        )
        again = np.zeros(len(o), dtype=bool)
        for known in (stored[name] for name in names):
            if len(known) and known.shape[1] == own.shape[1]:
                again |= _among(own, known)
        labels += [
            "/".join(data.labels[j] for j in np.ravel(o.rows[k])) for k in np.flatnonzero(again)
        ]
        count += len(o)
    if not labels:
        return ""
    named = list(dict.fromkeys(labels))
    more = f" and {len(named) - SHOWN} more" if len(named) > SHOWN else ""
    sentence = (
        f"{len(labels)} of {count} rows are rows that this run was fitted to (poses "
        f"{', '.join(named[:SHOWN])}{more}), which"
        " prove nothing about unseen poses"
    )
    if 2 * len(labels) < count:
        return sentence
    raise DataError(f"{sentence}; give others" + (f", or use {override}" if override else ""))


def _content(data: Measurements, rows: Observations) -> np.ndarray:
    """Readings and measured values (r, ..) of rows."""
    import numpy as np

    poses = rows.rows.reshape(len(rows), -1)
    return np.concatenate([data.readings[poses].reshape(len(rows), -1), rows.measured], axis=1)


def _among(own: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Which rows (r,) of one array (r, c) are among those of another (k, c), which has at least
    one.
    """
    import numpy as np
    from scipy.spatial import KDTree

    filled = np.where(np.isnan(known), 0.0, known)
    limit = SAME * np.maximum(np.ptp(filled, axis=0), 1e-3 * np.abs(filled).max(axis=0))
    limit = np.where(limit > 0.0, limit, SAME)
    here, there = (np.nan_to_num(rows / limit, nan=ABSENT) for rows in (own, known))
    return np.isfinite(KDTree(there).query(here, p=np.inf, distance_upper_bound=1.0)[0])
