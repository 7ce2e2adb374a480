# SPDX-License-Identifier: Apache-2.0
"""Add a covariance to a fit: for errors that its rows show and its assumptions do not contain.

The deviation of the machine from the estimate becomes e = diag(unit) V y + L w with independent w
of variance 1. In the coordinates y, of covariance S = diag(variance), the sum has the covariance
S + K K', K = V^-1 diag(1 / unit) L. Let y1 be the directions that the rows determine and y2 the
others of finite variance. Independent coordinates of the sum are those of y1, turned to their
principal axes, and of y2 - G y1, G = S21 S11^-1:

    V y = (V1 + V2 G) y1 + V2 (y2 - G y1)

so that the directions that no row determines stay what they are. Directions of infinite variance
stay infinite, whatever is added to them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from loopcal.estimate.nuisance_estimate import NuisanceEstimate
from loopcal.estimate.posterior import CovariancePart, Posterior
from loopcal.estimate.result import Identification
from loopcal.findings import Finding
from loopcal.numerics.decomposition import are_nonzero
from loopcal.typing import BoolArray, FloatArray


def add_covariance(
    fit: Identification, root: FloatArray, degrees: float, finding: Finding
) -> Identification:
    """Return a fit whose parameters have the additional covariance root root'.

    Estimates do not change. `covariance` and `posterior` stay consistent; directions of infinite
    variance stay infinite, and a fit without intervals (NaN) stays without. The setup parameters
    follow the machine by their slope, and get the covariance S root root' S'. Several additions can
    follow each other; each counts with its own degrees of freedom in the effective ones of every
    interval (`Posterior.count_degrees`).

    Parameters
    ----------
    fit : an identification.
    root : (p, k) [SI] square root of the covariance to add, parameters in the order of `fit.names`.
    degrees : degrees of freedom of its size, where it was estimated from data; infinite where it is
        known.
    finding : why it is added. It joins the findings of the fit, and its code is the source of the
        new part of `posterior.parts`.
    """
    root = np.asarray(root, dtype=np.float64)
    return replace(
        fit,
        covariance=fit.covariance + root @ root.T,
        posterior=add_to_posterior(fit.posterior, CovariancePart(finding.code, root, degrees)),
        nuisance=_add_to_nuisance(fit.nuisance, root / fit.tolerance[:, None]),
        findings=(*fit.findings, finding),
    )


def add_to_posterior(posterior: Posterior, part: CovariancePart) -> Posterior:
    """Return a posterior with an additional covariance, direction by direction."""
    variance, parts = posterior.variance, (*posterior.parts, part)
    if np.isnan(variance).any():
        return replace(posterior, parts=parts)
    is_finite = np.isfinite(variance)
    first, second = is_finite & posterior.determined, is_finite & ~posterior.determined
    added = np.linalg.solve(posterior.directions, part.root / posterior.unit[:, None])
    added = np.asarray(added, dtype=np.float64)
    spread = np.concatenate([np.diag(np.sqrt(np.where(is_finite, variance, 0.0))), added], axis=1)
    directions, variance = posterior.directions.copy(), variance.copy()
    turned, squares, towards = _diagonalize(spread[first])
    # the part of y2 that y1 explains: G of y1 in its principal axes
    slope = spread[second] @ towards
    directions[:, first] = posterior.directions[:, first] @ turned
    directions[:, first] += posterior.directions[:, second] @ slope
    variance[first] = squares
    rest = spread[second] - slope @ (turned.T @ spread[first])
    turned, squares, _ = _diagonalize(rest)
    directions[:, second] = posterior.directions[:, second] @ turned
    variance[second] = squares
    return replace(posterior, directions=directions, variance=variance, parts=parts)


def _diagonalize(spread: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return principal axes U (a, a) and variances (a,) of coordinates spread (a, b) times
    independent variables, and the pseudoinverse (b, a) of U' spread.
    """
    u, s, vt = np.linalg.svd(spread, full_matrices=False)
    used = are_nonzero(s)
    inverse = np.divide(1.0, s, out=np.zeros_like(s), where=used)
    return u, s**2, vt.T * inverse


def _add_to_nuisance(nuisance: NuisanceEstimate, root: FloatArray) -> NuisanceEstimate:
    """Return setup parameters that follow an added error of the machine, root (p, k) [tolerances].

    Infinite standard deviations stay infinite, and NaN stays NaN.
    """
    if not len(nuisance):
        return nuisance
    moved: BoolArray = nuisance.table.free
    added = np.where(moved, ((nuisance.slope @ root) ** 2).sum(axis=1), 0.0)
    return replace(nuisance, sd=np.sqrt(nuisance.sd**2 + added))
