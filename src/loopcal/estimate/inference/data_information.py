# SPDX-License-Identifier: Apache-2.0
"""What the data of a fit say of its parameters, without any tolerance or penalty.

The linearized rows, folded into r <= p rows, are B e = b + noise of one variance. They say the same
of the parameters whatever method estimated these, so that two calibrations of one machine can be
compared although tolerances pull both estimates to nominal. Null directions have no row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.residual_test import ResidualTest
from loopcal.estimate.inference.shown_noise import find_shown_noise
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import FloatArray

ROWS, DEVIATIONS, NOISE = "information_rows", "information_deviations", "information_noise"
"""Names of the stored arrays."""


@dataclass(frozen=True, eq=False)
class DataInformation:
    """Rows B (e - nominal) = deviations + noise; what lies outside their range says nothing of e.

    Attributes
    ----------
    rows : (r, p) B [1 / SI]. deviations : (r,) right-hand sides [1].
    variance : of the noise of a row, in units of the stated one: what the residuals show, or else
        what the fit uses; NaN without intervals. degrees : its degrees of freedom.
    """

    rows: FloatArray
    deviations: FloatArray
    variance: float
    degrees: float

    def __repr__(self) -> str:
        """Return the numbers of rows and parameters."""
        return f"<DataInformation: {len(self.rows)} rows on {self.rows.shape[1]} parameters>"

    def arrays(self) -> dict[str, FloatArray]:
        """Return the arrays of a run folder."""
        noise = np.array([self.variance, self.degrees])
        return {ROWS: self.rows, DEVIATIONS: self.deviations, NOISE: noise}


def collect_information(
    free: FreeParameters, decomposition: Decomposition, test: ResidualTest
) -> DataInformation:
    """Return what the rows of a fit (t = 1), which follow no penalty, say of the parameters."""
    shown = find_shown_noise(decomposition, test)
    variance = test.sigma_scale**2 if test.intervals else np.nan
    degrees = test.noise_degrees
    if shown is not None and shown.is_known:
        variance, degrees = shown.variance, shown.degrees
    return fold_information(free, decomposition, variance, float(degrees))


def fold_information(
    free: FreeParameters, decomposition: Decomposition, variance: float, degrees: float
) -> DataInformation:
    """Return what the rows of trial 0 of a decomposition say, for this noise of a row."""
    d = decomposition.plain()
    is_used = d.used[0]
    unit = free.tolerance * d.scale
    rows = d.singular_values[0][is_used, None] * d.inverse[0][is_used] / unit
    return DataInformation(rows, d.projections[0][is_used], variance, degrees)


def information_from_arrays(arrays: Mapping[str, np.ndarray]) -> DataInformation | None:
    """Return the information in the arrays of a run folder; None where an older version wrote
    it.
    """
    if ROWS not in arrays:
        return None
    variance, degrees = arrays[NOISE].tolist()
    return DataInformation(arrays[ROWS], arrays[DEVIATIONS], variance, degrees)
