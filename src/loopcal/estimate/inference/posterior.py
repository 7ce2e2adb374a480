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
from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.covariance_parts import (
    NOISE,
    PREFIX,
    CovariancePart,
    combine_degrees,
    parts_from_arrays,
    store_parts,
)
from loopcal.estimate.inference.data_information import (
    DataInformation,
    collect_information,
    information_from_arrays,
)
from loopcal.estimate.inference.measured_frames import MeasuredFrames, frames_from_arrays
from loopcal.estimate.inference.model_discrepancy import (
    DISCREPANCY,
    ModelDiscrepancy,
    discrepancy_from_arrays,
)
from loopcal.estimate.inference.residual_test import ResidualTest
from loopcal.estimate.inference.shown_noise import (
    ShownNoise,
    find_shown_noise,
    shown_noise_from_arrays,
)
from loopcal.estimate.methods.penalties import Method
from loopcal.findings import report_finding
from loopcal.measure import FittedRows, fitted_rows_from_arrays
from loopcal.mechanism import Mechanism
from loopcal.numerics.decomposition import Decomposition
from loopcal.typing import BoolArray, FloatArray, IntArray

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
    parts : the parts of the covariance whose size was estimated from data, with their degrees of
        freedom; what they leave of the covariance counts as known.
    fitted_rows : the measured rows that it comes from, so that they do not count twice; None where
        they are not known.
    discrepancy : slow errors of the poses that no geometry explains; None where none were found.
        Their effect on the parameters is one of the parts.
    shown_noise : the noise that the residuals alone show; None where it is not known.
    information : what the data say without tolerances, to compare calibrations; None where it is
        not known.
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
    information: DataInformation | None = None

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
        """Return the effective degrees of freedom (..,) of the size of errors, whose square is the
        sum of the squares of c components; see `combine_degrees`.

        Parameters
        ----------
        effect : (.., c, p) [per SI] of the components.
        """
        squares = ((_sum_squares(effect @ part.root), part.degrees) for part in self.parts)
        return combine_degrees(_sum_squares(effect @ self.root), squares)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of the run folder, which `posterior_from_arrays` reads."""
        own = {
            PREFIX + name: np.asarray(getattr(self, attribute))
            for name, attribute in STORED.items()
        }
        own |= store_parts(self.parts, len(self.unit))
        for value in (
            self.frames,
            self.fitted_rows,
            self.discrepancy,
            self.shown_noise,
            self.information,
        ):
            own |= {} if value is None else value.arrays()
        return own


class VarianceSources(NamedTuple):
    """What the variances of a fit are made of, beside its decomposition and penalty.

    Attributes
    ----------
    noise : variance of the whitened rows; NaN without intervals.
    prior : (1, p) variance of the true coordinates about nominal, from which the bias of the
        penalty is expected; None for 1 / penalty.
    """

    noise: float
    prior: FloatArray | None = None


def compute_posterior(
    robot: Mechanism,
    places: IntArray,
    tolerance: FloatArray,
    decomposition: Decomposition,
    penalty: FloatArray,
    sources: VarianceSources = VarianceSources(1.0),  # noqa: B008
    frames: MeasuredFrames | None = None,
    degrees: float = np.inf,
) -> Posterior:
    """Return the posterior of trial 0 of a decomposition.

    Parameters
    ----------
    robot : at the estimate. places, tolerance : (p,) of the free parameters.
    decomposition, penalty : of the fit; columns scaled by tolerance.
    sources : of the variances; default: stated noise, and a prior that is the penalty.
    frames : which frames the measurements determine.
    degrees : degrees of freedom of the noise variance; infinite where it is known.
    """
    directions, variance, determined = decomposition.knowledge(penalty, *sources)
    unit = tolerance * decomposition.scale
    by_noise = unit[:, None] * decomposition.noise_roots(penalty, sources.noise)[0]
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


def find_variance_sources(
    decomposition: Decomposition,
    penalty: FloatArray,
    test: ResidualTest,
    method: Method,
    free: FreeParameters,
) -> VarianceSources:
    """Return what the variances of a fit are made of: noise as the test scales it, and the bias of
    the penalty as the stated tolerances let it expect.
    """
    prior = method.prior_variance(decomposition, penalty, free)
    is_known = test.intervals and (prior is None or not np.isnan(prior).any())
    return VarianceSources(test.sigma_scale**2 if is_known else np.nan, prior)


def add_data(
    posterior: Posterior,
    free: FreeParameters,
    decomposition: Decomposition,
    test: ResidualTest,
    rows: FittedRows | None,
) -> Posterior:
    """Return a posterior with what is known of its data: rows, noise and information.

    Parameters
    ----------
    free, decomposition, test : of the fit (t = 1). rows : see `Posterior.fitted_rows`.
    """
    return replace(
        posterior,
        fitted_rows=rows,
        shown_noise=find_shown_noise(decomposition, test),
        information=collect_information(free, decomposition, test),
    )


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
        parts_from_arrays(arrays),
        fitted_rows_from_arrays(arrays),
        discrepancy_from_arrays(arrays),
        shown_noise_from_arrays(arrays),
        information_from_arrays(arrays),
    )


def _sum_squares(values: FloatArray) -> FloatArray:
    """Return the sum of squares over the last two axes."""
    return np.asarray((values**2).sum(axis=(-2, -1)))
