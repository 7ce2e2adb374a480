# SPDX-License-Identifier: Apache-2.0
"""Examine a fit in one call: outliers, lack of fit, correlated parameters and expected gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.diagnose.calibration_gain import CalibrationGain, estimate_calibration_gain
from loopcal.diagnose.outliers import OutlierCheck, find_outliers
from loopcal.diagnose.residual_tests import LackOfFit, check_lack_of_fit
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure import Measurements
from loopcal.typing import FloatArray

STRONG = 0.9
"""Correlation above which the error of one parameter is mostly that of another (81 % of its
variance).
"""


@dataclass(frozen=True)
class CorrelatedGroup:
    """Parameters whose estimates are linked by correlations above STRONG, directly or in a chain.

    Attributes
    ----------
    names : in the order of the table. pair, correlation : the two most strongly correlated ones.
    """

    names: tuple[str, ...]
    pair: tuple[str, str]
    correlation: float

    @property
    def finding(self) -> Finding:
        """The group as a finding."""
        return report_finding("residuals.correlated-parameters", **vars(self))

    def to_dict(self) -> dict[str, object]:
        """Return the attributes and the finding for JSON."""
        return {**vars(self), "finding": self.finding}


@dataclass(frozen=True, eq=False)
class FitExamination:
    """The results of all examinations of a fit by its own data.

    Attributes
    ----------
    outliers : poses that do not fit the others. lack_of_fit : the test against repeated poses.
    correlated : groups of strongly correlated parameters. gain : expected errors before and after.
    """

    outliers: OutlierCheck
    lack_of_fit: LackOfFit
    correlated: tuple[CorrelatedGroup, ...]
    gain: CalibrationGain

    JSON_FIELDS = {  # noqa: RUF012
        "outliers": "outliers",
        "lack_of_fit": "lack_of_fit",
        "correlated": "correlated",
        "worth": "gain",
        "findings": "findings",
    }

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, the most important ones first."""
        findings = list(self.outliers.findings)
        if self.gain.is_worthwhile is not None:
            findings.insert(len(findings) if self.gain.is_worthwhile else 0, self.gain.finding)
        if self.lack_of_fit.groups:
            findings += self.lack_of_fit.findings
        return (*findings, *(group.finding for group in self.correlated))


def examine_fit(fit: Identification, data: Measurements) -> FitExamination:
    """Examine a fit with the data it was made from.

    Parameters
    ----------
    fit : an identification. data : the measurements it was made from.
    """
    return FitExamination(
        find_outliers(fit, data),
        check_lack_of_fit(fit, data),
        find_correlated_groups(fit),
        estimate_calibration_gain(fit, data),
    )


def find_correlated_groups(
    fit: Identification, strong: float = STRONG
) -> tuple[CorrelatedGroup, ...]:
    """Return the groups of strongly correlated parameters, the largest correlation first."""
    rho = correlation_matrix(fit)
    linked = np.where(np.isnan(rho), 0.0, np.abs(rho)) > strong
    np.fill_diagonal(linked, val=False)
    group = np.arange(len(rho))
    for i, j in np.argwhere(linked):
        group[group == group[j]] = group[i]
    groups = []
    for number in np.unique(group[linked.any(axis=1)]):
        places = np.flatnonzero(group == number)
        inner = np.where(linked[np.ix_(places, places)], np.abs(rho[np.ix_(places, places)]), 0.0)
        a, b = (places[k] for k in np.unravel_index(int(np.argmax(inner)), inner.shape))
        a, b = min(a, b), max(a, b)
        names = tuple(fit.names[i] for i in places)
        groups.append(CorrelatedGroup(names, (fit.names[a], fit.names[b]), float(rho[a, b])))
    return tuple(sorted(groups, key=lambda g: -abs(g.correlation)))


def correlation_matrix(fit: Identification) -> FloatArray:
    """Return the correlation matrix (p, p) of the estimates; NaN where a parameter has no finite
    variance.
    """
    sd = fit.standard_deviations
    finite = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(finite, 1.0 / np.where(finite, sd, 1.0), np.nan)
    return np.where(finite[:, None] & finite, fit.covariance, np.nan) * scale[:, None] * scale
