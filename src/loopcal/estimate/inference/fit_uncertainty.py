# SPDX-License-Identifier: Apache-2.0
"""What a fit knows of machine and nuisance parameters together, to predict other measurements.

With y and w independent standard normal variables, the machine deviates from the estimate by
`E y` [SI], E = diag(unit) V diag(variance)^(1/2), and the nuisance parameters by `S E y + T w`:
they follow the machine (slope S), and have an uncertainty of their own (root T). A frame is often
known only together with the machine; then neither is certain, but their combination is.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.posterior import Posterior, posterior_from_arrays
from loopcal.estimate.result import Identification
from loopcal.mechanism import Mechanism
from loopcal.typing import FloatArray

UNKNOWN = 1e6
"""Standard deviation in `unit` that stands for a direction of which nothing is known."""

SLOPE, ROOT = "local_slope", "local_root"
"""Arrays of a run folder."""


class FitUncertainty(NamedTuple):
    """Free parameters and nuisance parameters of a fit with their joint uncertainty.

    Attributes
    ----------
    posterior : of the machine. names : (U,) nuisance parameters.
    slope : (U, p) S [SI / SI]. root : (U, U) T [SI].
    noise_scale : factor on the stated sigmas of the rows.
    """

    posterior: Posterior
    names: tuple[str, ...]
    slope: FloatArray
    root: FloatArray
    noise_scale: float

    def __repr__(self) -> str:
        p, u = len(self.posterior.unit), len(self.names)
        return f"<FitUncertainty: {p} parameters, {u} nuisance parameters>"

    @property
    def spread(self) -> FloatArray:
        """(p, p) E [SI] without a model discrepancy; zero where the fit states no intervals."""
        posterior = self.posterior.without_discrepancy
        variance = posterior.variance
        sd = np.where(np.isinf(variance), UNKNOWN, np.sqrt(np.nan_to_num(variance, posinf=0.0)))
        return posterior.unit[:, None] * posterior.directions * sd

    @property
    def free(self) -> FreeParameters:
        """The free parameters at the estimate, in units of the posterior, and the errors of a model
        discrepancy.
        """
        posterior = self.posterior
        stated = np.zeros(len(posterior.unit), dtype=bool)
        own = posterior.discrepancy
        return FreeParameters(
            posterior.robot,
            posterior.places,
            posterior.estimate,
            posterior.unit,
            stated,
            errors=None if own is None else own.errors,
        )


def collect_uncertainty(fit: Identification) -> FitUncertainty:
    """Return the joint uncertainty of a fit."""
    nuisance = fit.nuisance
    root = np.nan_to_num(nuisance.root, posinf=0.0)
    slope = nuisance.slope / fit.tolerance
    scale = fit.residual_test.sigma_scale
    return FitUncertainty(
        fit.posterior, nuisance.names, slope, root, scale if np.isfinite(scale) else 1.0
    )


def uncertainty_from_arrays(
    robot: Mechanism, names: tuple[str, ...], arrays: Mapping[str, np.ndarray], noise_scale: float
) -> FitUncertainty | None:
    """Return the joint uncertainty in the arrays of a run folder; None in one that has none.

    Parameters
    ----------
    robot : the corrected robot of the run. names : (U,) of its nuisance parameters.

    Raises
    ------
    EstimationError : see `posterior_from_arrays`.
    """
    if SLOPE not in arrays or ROOT not in arrays:
        return None
    posterior = posterior_from_arrays(robot, arrays)
    return FitUncertainty(posterior, names, arrays[SLOPE], arrays[ROOT], noise_scale)
