# SPDX-License-Identifier: Apache-2.0
"""The posterior of a fit, direction by direction, also where a covariance would be infinite.

The deviation from the estimate is e - estimate = diag(unit) V y, with independent coordinates y_i
of variance `variance_i`. The variance is infinite for directions of which nothing is known. See
docs/theory/uncertainty.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.inference.measured_frames import MeasuredFrames, frames_from_arrays
from loopcal.estimate.inference.model_discrepancy import (
    DISCREPANCY,
    ModelDiscrepancy,
    discrepancy_from_arrays,
)
from loopcal.estimate.inference.residual_test import ResidualTest
from loopcal.estimate.inference.shown_noise import ShownNoise, shown_noise_from_arrays
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.findings import report_finding
from loopcal.measure import FittedRows, fitted_rows_from_arrays
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

PREFIX = "posterior_"
STORED = {"unit": "unit", "directions": "directions", "variance": "variance", "seen": "determined"}
"""Arrays of a run folder (after `PREFIX`), and the attributes that they hold."""


NOISE = "noise"
"""Source of the part of the covariance that the noise of the rows causes."""

PARTS = ("source", "degrees", "root", "part")
"""Arrays of a run folder (after `PREFIX`) with the parts of the covariance: the source and the
degrees of freedom of each, the roots beside each other, and the number of the part of each column.
"""


class CovariancePart(NamedTuple):
    """A part of the covariance of the parameters whose size was estimated from data.

    Attributes
    ----------
    source : what causes it: "noise", or the code of the finding with which it was added.
    root : (p, k) [SI], the part is root root'.
    degrees : degrees of freedom of its estimated size; infinite where it is known.
    """

    source: str
    root: FloatArray
    degrees: float


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
    parts : the parts of the covariance whose size was estimated from data, with their degrees of
        freedom; what they leave of the covariance counts as known.
    fitted_rows : the measured rows that it comes from, so that they do not count twice; None where
        they are not known.
    discrepancy : slow errors of the poses that no geometry explains; None where none were found.
        Their effect on the parameters is one of the parts.
    shown_noise : the noise that the residuals alone show; None where it is not known.
    """

    robot: Mechanism
    places: IntArray
    unit: FloatArray
    directions: FloatArray
    variance: FloatArray
    determined: BoolArray
    frames: MeasuredFrames | None = None
    parts: tuple[CovariancePart, ...] = ()
    fitted_rows: FittedRows | None = None
    discrepancy: ModelDiscrepancy | None = None
    shown_noise: ShownNoise | None = None

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

    @property
    def without_discrepancy(self) -> Posterior:
        """The posterior of the parameters if no slow error of the poses moved them."""
        own = self.discrepancy
        if own is None:
            return self
        parts = tuple(part for part in self.parts if part.source != DISCREPANCY)
        return replace(
            self, directions=own.directions, variance=own.variance, parts=parts, discrepancy=None
        )

    @property
    def root(self) -> FloatArray:
        """(p, k) square root of the covariance [SI], of the k directions of finite variance; NaN
        without intervals.
        """
        is_finite = ~np.isinf(self.variance)
        return (
            self.unit[:, None] * self.directions[:, is_finite] * np.sqrt(self.variance[is_finite])
        )

    def count_degrees(self, effect: FloatArray) -> FloatArray:
        """Return the effective degrees of freedom (..,) of the size of errors.

        The square of the size of an error `effect` times the deviation of the parameters is the sum
        of the squares of its c components. Its parts u_i^2 have nu_i degrees of freedom, each with
        one common factor, so that (Welch-Satterthwaite, JCGM 100 G.4)

            degrees = u^4 / sum(u_i^4 / nu_i)

        Parameters
        ----------
        effect : (.., c, p) [per SI].

        Returns
        -------
        At least the smallest nu_i; infinite where no part has an effect.
        """
        total = _sum_squares(effect @ self.root)
        spread = np.zeros_like(total)
        for part in self.parts:
            spread += _sum_squares(effect @ part.root) ** 2 / part.degrees
        return np.divide(total**2, spread, out=np.full_like(total, np.inf), where=spread > 0.0)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `posterior_from_arrays` reads."""
        own = {
            PREFIX + name: np.asarray(getattr(self, attribute))
            for name, attribute in STORED.items()
        }
        parts = self.parts
        content = (
            np.array([part.source for part in parts], dtype=np.str_),
            np.array([part.degrees for part in parts]),
            np.concatenate([np.zeros((len(self.unit), 0)), *(part.root for part in parts)], axis=1),
            np.repeat(np.arange(len(parts)), [part.root.shape[1] for part in parts]),
        )
        own |= {PREFIX + name: array for name, array in zip(PARTS, content, strict=True)}
        for value in (self.frames, self.fitted_rows, self.discrepancy, self.shown_noise):
            own |= {} if value is None else value.arrays()
        return own


def compute_posterior(
    robot: Mechanism,
    places: IntArray,
    tolerance: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    noise: float = 1.0,
    frames: MeasuredFrames | None = None,
    degrees: float = np.inf,
) -> Posterior:
    """Return the posterior of trial 0 of a decomposition.

    Parameters
    ----------
    robot : at the estimate. places, tolerance : (p,) of the free parameters.
    decomposition, penalty : of the fit; columns scaled by tolerance.
    noise : variance of the whitened rows; NaN without intervals.
    frames : which frames the measurements determine.
    degrees : degrees of freedom of the noise variance; infinite where it is known.
    """
    directions, variance, determined = decomposition.knowledge(penalty, noise)
    unit = tolerance * decomposition.scale
    by_noise = unit[:, None] * decomposition.noise_roots(penalty, noise)[0]
    return Posterior(
        robot=robot,
        places=places,
        unit=unit,
        directions=directions,
        variance=variance,
        determined=determined,
        frames=frames,
        parts=(CovariancePart(NOISE, by_noise, degrees),),
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
    return Posterior(
        robot,
        places,
        unit,
        directions,
        variance,
        determined.astype(bool),
        frames_from_arrays(arrays),
        _parts_from_arrays(arrays),
        fitted_rows_from_arrays(arrays),
        discrepancy_from_arrays(arrays),
        shown_noise_from_arrays(arrays),
    )


def _parts_from_arrays(arrays: Mapping[str, np.ndarray]) -> tuple[CovariancePart, ...]:
    """Return the parts of the covariance; none for run folders of earlier versions."""
    if any(PREFIX + name not in arrays for name in PARTS):
        return ()
    sources, degrees, roots, number = (arrays[PREFIX + name] for name in PARTS)
    return tuple(
        CovariancePart(str(source), roots[:, number == i], float(degrees[i]))
        for i, source in enumerate(sources.tolist())
    )


def _sum_squares(values: FloatArray) -> FloatArray:
    """Return the sum of squares over the last two axes."""
    return np.asarray((values**2).sum(axis=(-2, -1)))
