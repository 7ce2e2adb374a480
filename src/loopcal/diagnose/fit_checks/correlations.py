# SPDX-License-Identifier: Apache-2.0
"""Find parameters whose estimates are strongly correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.numerics.sorted_values import find_distinct

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


def find_correlated_groups(
    fit: Identification, strong: float = STRONG
) -> tuple[CorrelatedGroup, ...]:
    """Return the groups of strongly correlated parameters, the largest correlation first."""
    sd = fit.standard_deviations
    finite = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(finite, 1.0 / np.where(finite, sd, 1.0), np.nan)
    rho = np.where(finite[:, None] & finite, fit.covariance, np.nan) * scale[:, None] * scale
    linked = np.where(np.isnan(rho), 0.0, np.abs(rho)) > strong
    np.fill_diagonal(linked, val=False)
    group = np.arange(len(rho))
    for i, j in np.argwhere(linked):
        group[group == group[j]] = group[i]
    groups = []
    for number in find_distinct(group[linked.any(axis=1)]):
        places = np.flatnonzero(group == number)
        inner = np.where(linked[np.ix_(places, places)], np.abs(rho[np.ix_(places, places)]), 0.0)
        a, b = (places[k] for k in np.unravel_index(int(np.argmax(inner)), inner.shape))
        a, b = min(a, b), max(a, b)
        names = tuple(fit.names[i] for i in places)
        groups.append(CorrelatedGroup(names, (fit.names[a], fit.names[b]), float(rho[a, b])))
    return tuple(sorted(groups, key=lambda g: -abs(g.correlation)))
