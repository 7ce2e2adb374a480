# SPDX-License-Identifier: Apache-2.0
"""What a fit knows of the parameters, direction by direction: nothing is lost where a covariance
would be infinite.

The deviation from the estimate is e - estimate = diag(unit) V y, with independent coordinates y_i
of variance `variance_i`: infinite where nothing is known. See docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from loopcal.errors import EstimationError
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

PREFIX = "posterior_"
STORED = ("unit", "directions", "variance", "seen")


@dataclass(frozen=True, eq=False)
class Posterior:
    """Free parameters of a robot with their errors.

    Attributes
    ----------
    robot : Mechanism at the estimate. places : (p,) positions of the free parameters in its table.
    unit : (p,) [SI]. directions : (p, p) V. variance : (p,) of each direction, infinite or NaN (no
        interval can be given).
    seen : (p,) directions that the rows determine; of the others only a prior or nothing at all is
        known.
    """

    robot: Mechanism
    places: IntArray
    unit: FloatArray
    directions: FloatArray
    variance: FloatArray
    seen: BoolArray

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.robot.parameters.names[i] for i in self.places)

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates [SI]."""
        return self.robot.values[self.places]

    def arrays(self) -> dict[str, FloatArray]:
        """Return what `posterior_from_arrays` reads back, for the run folder."""
        return {PREFIX + name: np.asarray(getattr(self, name)) for name in STORED}


def compute_posterior(
    robot: Mechanism,
    places: IntArray,
    tolerance: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: float = 1.0,
) -> Posterior:
    """Return what trial 0 of a decomposition knows.

    Parameters
    ----------
    robot : at the estimate. places, tolerance : (p,) of the free parameters.
    decomposition, penalty : of the fit; columns scaled by tolerance. noise : variance of the
        whitened rows.
    """
    directions, variance, seen = decomposition.knowledge(penalty, noise)
    return Posterior(
        robot=robot,
        places=places,
        unit=tolerance * decomposition.scale,
        directions=directions,
        variance=variance,
        seen=seen,
    )


def posterior_from_arrays(robot: Mechanism, arrays: Mapping[str, np.ndarray]) -> Posterior:
    """Return the posterior that a run folder keeps.

    Parameters
    ----------
    robot : the corrected robot of the run. arrays : those of the run folder.

    Raises
    ------
    EstimationError
        The run has none, or its robot has other free parameters now.
    """
    missing = [name for name in STORED if PREFIX + name not in arrays]
    if missing:
        raise EstimationError(
            f"this run holds no posterior (there is no {PREFIX}{missing[0]}); make it again with "
            "this version of loopcal"
        )
    unit, directions, variance, seen = (arrays[PREFIX + name] for name in STORED)
    places = np.flatnonzero(robot.parameters.free)
    if len(places) != len(unit):
        raise EstimationError(
            f"this run identified {len(unit)} parameters, but its robot file has {len(places)} "
            "free ones; restore the file, "
            "or make the run again"
        )
    return Posterior(robot, places, unit, directions, variance, seen.astype(bool))
