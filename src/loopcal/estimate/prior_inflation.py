# SPDX-License-Identifier: Apache-2.0
"""What a fit by MAP says about its prior: the tests of the tolerances, and the uncertainty of the
factors by which they are inflated.

A factor is estimated from the data that are fitted. Its error moves the estimate, by dz / d(log
factor) times the error of its logarithm, and this is added to the covariance.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.inference.added_covariance import add_covariance
from loopcal.estimate.methods.inflated_tolerances import (
    estimate_excess_noise,
    estimate_factor_spread,
)
from loopcal.estimate.methods.penalties import MAP, Method
from loopcal.estimate.methods.prior_conflict import PriorConflict, assess_prior_conflict
from loopcal.estimate.minimization.descent import Descent
from loopcal.estimate.result import Identification
from loopcal.findings import report_finding
from loopcal.typing import FloatArray


def run_prior_tests(free: FreeParameters, fit: Descent, method: Method) -> PriorConflict | None:
    """Return the tests of the prior, where the method uses one."""
    if not isinstance(method, MAP):
        return None
    sigma = float(method.sigma(fit.decomposition)[0])
    inflation = float(method.compute_inflation(fit.decomposition)[0])
    return assess_prior_conflict(free, fit.decomposition, inflation, sigma, fit.deviation[0])


def add_factor_uncertainty(result: Identification, fit: Descent) -> Identification:
    """Return the result with the uncertainty of the factors that inflated its tolerances.

    Nothing is added where the tolerances count as stated: below 1 no factor is used, and its
    distribution has no error to one side.
    """
    method = result.method
    if not (isinstance(method, MAP) and callable(method.inflation) and result.converged):
        return result
    factor = method.compute_inflation(fit.decomposition)
    if factor[0] <= 1.0:
        return result
    root = differentiate_by_factor(fit, method) * result.tolerance
    finding = report_finding("prior.inflation", factor=float(factor[0]))
    return add_covariance(result, root[:, None], np.inf, finding)


def differentiate_by_factor(fit: Descent, method: MAP) -> FloatArray:
    """Return the change (p,) of the estimate, in tolerances, by one standard deviation of the
    logarithm of the factor on all tolerances.

    In the coordinates y of the decomposition it is 2 (1 - f_i) y_i.
    """
    d, penalty = fit.decomposition, np.where(np.isfinite(fit.penalty), fit.penalty, 0.0)
    divided = d.divided(method.sigma(d))
    divided = divided.divided(estimate_excess_noise(divided))
    spread = estimate_factor_spread(divided, method.compute_inflation(d))
    change = 2.0 * (1.0 - d.filter_factors(penalty)) * d.solution(fit.penalty)
    change = np.where(penalty > 0.0, change, 0.0)
    return np.asarray(d.deviation(change * spread[:, None])[0])
