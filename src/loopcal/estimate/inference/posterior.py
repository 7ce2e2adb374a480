# SPDX-License-Identifier: Apache-2.0
"""The posterior of a fit, direction by direction, also where a covariance would be infinite.

The deviation from the estimate is e - estimate = diag(unit) V y, with independent coordinates y_i
of variance `variance_i`. The variance is infinite for directions of which nothing is known. See
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.inference.measured_frames import MeasuredFrames, frames_from_arrays
from loopcal.estimate.inference.residual_test import ResidualTest
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.findings import report_finding
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

PREFIX = "posterior_"
STORED = {"unit": "unit", "directions": "directions", "variance": "variance", "seen": "determined"}
"""Arrays of a run folder (after `PREFIX`), and the attributes that they hold."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Free parameters of a robot with their uncertainty.

    Attributes
    ----------
    robot : Mechanism at the estimate. places : (p,) positions of the free parameters in its table.
    unit : (p,) [SI]. directions : (p, p) V.
    variance : (p,) of each direction; infinite for unknown ones, NaN without intervals.
    determined : (p,) True for directions that the rows determine; of the others at most a prior is
        known.
    frames : which frames the measurements determine; None where it is not known, as in run folders
        of earlier versions.
    """

    robot: Mechanism
    places: IntArray
    unit: FloatArray
    directions: FloatArray
    variance: FloatArray
    determined: BoolArray
    frames: MeasuredFrames | None = None

    def __repr__(self) -> str:
        """Return the robot's name and the numbers of parameters and of determined directions."""
        return (
            f"<Posterior of {self.robot.name}: {len(self.places)} parameters, "
            f"{int(self.determined.sum())} directions determined>"
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return tuple(self.robot.parameters.names[i] for i in self.places)

    @property
    def estimate(self) -> FloatArray:
        """(p,) estimates [SI]."""
        return self.robot.values[self.places]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `posterior_from_arrays` reads."""
        own = {
            PREFIX + name: np.asarray(getattr(self, attribute))
            for name, attribute in STORED.items()
        }
        return own if self.frames is None else {**own, **self.frames.arrays()}


def compute_posterior(
    robot: Mechanism,
    places: IntArray,
    tolerance: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: float = 1.0,
    frames: MeasuredFrames | None = None,
) -> Posterior:
    """Return the posterior of trial 0 of a decomposition.

    Parameters
    ----------
    robot : at the estimate. places, tolerance : (p,) of the free parameters.
    decomposition, penalty : of the fit; columns scaled by tolerance.
    noise : variance of the whitened rows. frames : which frames the measurements determine.
    """
    directions, variance, determined = decomposition.knowledge(penalty, noise)
    return Posterior(
        robot=robot,
        places=places,
        unit=tolerance * decomposition.scale,
        directions=directions,
        variance=variance,
        determined=determined,
        frames=frames,
    )


class ScaledNoise(NamedTuple):
    """Decomposition, penalty and noise variance from which the variances of a fit are read."""

    decomposition: Decomposition
    penalty: FloatArray
    noise: float


def scale_variances(
    decomposition: Decomposition, penalty: FloatArray, test: ResidualTest, method: Method
) -> ScaledNoise:
    """Return what the variances of a fit are read from, the noise scaled as the test says.

    With an estimated noise the penalty of MAP contains its variance. Decomposition and penalty are
    divided by it, so that the variance of the rows is 1 again. The noise is NaN without intervals.
    """
    noise = test.sigma_scale**2 if test.intervals else np.nan
    if isinstance(method, MAP) and test.intervals and test.noise == "estimated":
        divided = decomposition.divided(np.full(len(penalty), test.sigma_scale))
        return ScaledNoise(divided, penalty / noise, 1.0)
    return ScaledNoise(decomposition, penalty, noise)


def posterior_from_arrays(robot: Mechanism, arrays: Mapping[str, np.ndarray]) -> Posterior:
    """Return the posterior in the arrays of a run folder.

    Parameters
    ----------
    robot : the corrected robot of the run. arrays : of the run folder.

    Raises
    ------
    EstimationError : the run has no posterior, or its robot now has other free parameters.
    """
    missing = [PREFIX + name for name in STORED if PREFIX + name not in arrays]
    if missing:
        raise EstimationError(report_finding("prior.no-posterior", array=missing[0]))
    unit, directions, variance, determined = (arrays[PREFIX + name] for name in STORED)
    places = np.flatnonzero(robot.parameters.free)
    if len(places) != len(unit):
        raise EstimationError(
            report_finding("prior.other-count", identified=len(unit), free=len(places))
        )
    frames = frames_from_arrays(arrays)
    return Posterior(robot, places, unit, directions, variance, determined.astype(bool), frames)
