# SPDX-License-Identifier: Apache-2.0
"""The error that measurement noise alone causes, in the metric of the validation.

An exact geometry still shows prediction errors: those of the instrument. The expected square of the
position error of a row is the sum of the variances of its length components, so

    floor^2 = mean over rows of  sum over components  sigma^2

and the same with the angles for the orientation error. The noise of uncertain joint readings is not
part of it, so with such readings the true floor is higher.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopcal.measure import Observations
from loopcal.units import Dimension


@dataclass(frozen=True)
class NoiseFloor:
    """Expected rms of the errors of an exact geometry, NaN for what no row measures.

    Attributes
    ----------
    position : [m]. orientation : [rad].
    """

    position: float
    orientation: float


def compute_noise_floor(rows: Sequence[Observations]) -> NoiseFloor:
    """Return the noise floor of rows with their stated covariances."""
    return NoiseFloor(_rms(rows, Dimension.LENGTH), _rms(rows, Dimension.ANGLE))


def _rms(rows: Sequence[Observations], dimension: Dimension) -> float:
    """Return the root mean square over the rows that measure this dimension."""
    squares = []
    for o in rows:
        chosen = np.array([column.dimension is dimension for column in o.kind.noise_columns])
        present = o.present & chosen
        variance = np.where(present, np.diagonal(o.covariance, axis1=1, axis2=2), 0.0)
        squares.append(variance.sum(axis=1)[present.any(axis=1)])
    square = np.concatenate(squares) if squares else np.zeros(0)
    return float(np.sqrt(square.mean())) if len(square) else float("nan")
