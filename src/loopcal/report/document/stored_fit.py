# SPDX-License-Identifier: Apache-2.0
"""A stored fit with the attributes of an `Identification` that figures of parameters use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray


@dataclass(frozen=True, eq=False)
class StoredFit:
    """What figures use of a fit that converged; see `Identification` for the attributes."""

    robot: Mechanism
    free_parameters: FreeParameters
    estimate: FloatArray
    covariance: FloatArray
    half_widths: FloatArray
    converged: bool = True

    @property
    def standard_deviations(self) -> FloatArray:
        """(p,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def interval(self) -> FloatArray:
        """Return half-widths (p,) of the 95 % intervals."""
        return self.half_widths


def restore_fit(
    fit: Mapping[str, Any], arrays: Mapping[str, np.ndarray], robot: Mechanism
) -> StoredFit:
    """Return a stored fit for the functions that draw parameters.

    Parameters
    ----------
    fit : content of `fit` of a run, with numbers that are not finite. robot : of which the
        identified parameters are free.
    """
    rows = fit["parameters"]
    places = np.flatnonzero(robot.parameters.free)
    free = FreeParameters(robot, places, arrays["nominal"], np.ones(len(places)), places < 0)
    factor, _ = free.display()
    tolerance = factor * np.array([row["tolerance"] for row in rows])
    assumed = np.array([bool(row["tolerance_assumed"]) for row in rows])
    return StoredFit(
        robot,
        FreeParameters(robot, places, arrays["nominal"], tolerance, assumed),
        arrays["estimate"],
        arrays["covariance"],
        factor * np.array([row["plus_minus"] for row in rows]),
    )
