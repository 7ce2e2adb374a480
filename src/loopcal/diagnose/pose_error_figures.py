# SPDX-License-Identifier: Apache-2.0
"""Errors of poses in the indices of the 42-parameter hexapod study: position, orientation,
integrated, balance.

With the components (dx, dy, dz) and (da, db, dc) of one row:

    position     dQ1 = sqrt(dx^2 + dy^2 + dz^2)          [m]
    orientation  dQ2 = sqrt(da^2 + db^2 + dc^2)          [rad]
    integrated   dQint = dQ1 + dQ2, the study's number: millimetres and radians added as they are
    balance      spread of the components of one group, largest minus smallest

Source: "Numerical simulation of the calibration algorithm for a 6-DOF parallel mechanism", section
4; what is measured of a pose may be a part of it, and then so are the sums.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.typing import FloatArray

MILLIMETRE = 1e-3
INDICES = ("position", "orientation", "integrated", "position_balance", "orientation_balance")


@dataclass(frozen=True, eq=False)
class Statistics:
    """Maximum, root mean square, mean and standard deviation of an index over the rows that have
    it; NaN without any.
    """

    max: float
    rms: float
    mean: float
    sd: float
    count: int


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Indices of r rows, NaN where a row has no component of that group.

    Attributes
    ----------
    position, orientation : (r,) [m], [rad]. integrated : (r,) [mm + rad].
    position_balance, orientation_balance : (r,) [m], [rad].
    """

    position: FloatArray
    orientation: FloatArray
    integrated: FloatArray
    position_balance: FloatArray
    orientation_balance: FloatArray

    def statistics(self, index: str) -> Statistics:
        """Return the statistics of one of INDICES."""
        values = getattr(self, index)
        values = values[np.isfinite(values)]
        if len(values) == 0:
            return Statistics(np.nan, np.nan, np.nan, np.nan, 0)
        spread = float(values.std(ddof=1)) if len(values) > 1 else np.nan
        rms = float(np.sqrt(np.mean(values**2)))
        return Statistics(float(values.max()), rms, float(values.mean()), spread, len(values))

    def to_dict(self) -> dict[str, Any]:
        """Statistics and rows of every index, SI (integrated: mm + rad)."""
        return {i: {**vars(self.statistics(i)), "rows": getattr(self, i)} for i in INDICES}


def pose_errors(position: FloatArray, orientation: FloatArray) -> PoseErrors:
    """Return the indices of rows.

    Parameters
    ----------
    position : (r, 3) [m] and orientation : (r, 3) [rad] components of the errors (or fewer columns,
        or none); NaN where not measured. Orientation components may be a rotation vector or
        differences of declared angles.
    """
    first, second = _length(position), _length(orientation)
    integrated = first / MILLIMETRE + second
    return PoseErrors(first, second, integrated, _balance(position), _balance(orientation))


def _length(components: FloatArray) -> FloatArray:
    """Root of the sum of squares of what is there, NaN where nothing is."""
    there = np.isfinite(components)
    square = np.where(there, components, 0.0) ** 2
    return np.where(there.any(axis=1), np.sqrt(square.sum(axis=1)), np.nan)


def _balance(components: FloatArray) -> FloatArray:
    """Largest minus smallest component, NaN where fewer than two are there."""
    there = np.isfinite(components)
    high = np.where(there, components, -np.inf).max(axis=1, initial=-np.inf)
    low = np.where(there, components, np.inf).min(axis=1, initial=np.inf)
    enough = there.sum(axis=1) > 1
    return np.where(enough, np.where(enough, high, 0.0) - np.where(enough, low, 0.0), np.nan)
