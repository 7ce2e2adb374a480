# SPDX-License-Identifier: Apache-2.0
"""Groups of parameters that the data know only together, in words: strongly correlated errors of
the estimates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopcal.estimate.result import Identification
from loopcal.typing import FloatArray

STRONG = 0.9
"""Correlation beyond which the error of one parameter is mostly that of another (81 % of its
variance).
"""


@dataclass(frozen=True)
class CorrelatedGroup:
    """Parameters linked by correlations beyond STRONG, directly or by others of the group.

    Attributes
    ----------
    names : in the order of the table. pair, correlation : the two that are most strongly
        correlated.
    """

    names: tuple[str, ...]
    pair: tuple[str, str]
    correlation: float

    def __str__(self) -> str:
        way = "the same way" if self.correlation > 0.0 else "opposite ways"
        most = "" if len(self.names) == 2 else f", most of all {self.pair[0]} and {self.pair[1]}"
        return (
            f"{', '.join(self.names[:-1])} and {self.names[-1]} are known better together than "
            f"alone{most}: their errors go"
            f" {way} (correlation {self.correlation:+.3f})"
        )


def correlation(fit: Identification) -> FloatArray:
    """Return the correlation matrix (p, p) of the errors; nan where a parameter's variance is
    infinite or not given.
    """
    sd = fit.standard_deviations
    known = np.isfinite(sd) & (sd > 0.0)
    scale = np.where(known, 1.0 / np.where(known, sd, 1.0), np.nan)
    return np.where(known[:, None] & known, fit.covariance, np.nan) * scale[:, None] * scale


def find_correlated_groups(
    fit: Identification, strong: float = STRONG
) -> tuple[CorrelatedGroup, ...]:
    """Return the groups, largest correlation first."""
    rho = correlation(fit)
    linked = np.where(np.isnan(rho), 0.0, np.abs(rho)) > strong
    np.fill_diagonal(linked, val=False)
    group = np.arange(len(rho))
    for i, j in np.argwhere(linked):
        group[group == group[j]] = group[i]
    found = []
    for number in np.unique(group[linked.any(axis=1)]):
        places = np.flatnonzero(group == number)
        inner = np.where(linked[np.ix_(places, places)], np.abs(rho[np.ix_(places, places)]), 0.0)
        a, b = (places[k] for k in np.unravel_index(int(np.argmax(inner)), inner.shape))
        a, b = min(a, b), max(a, b)
        names = tuple(fit.names[i] for i in places)
        found.append(CorrelatedGroup(names, (fit.names[a], fit.names[b]), float(rho[a, b])))
    return tuple(sorted(found, key=lambda g: -abs(g.correlation)))
