# SPDX-License-Identifier: Apache-2.0
"""Which deviations from the tolerances the data could not show.

A deviation of a component E by x tolerances, one parameter or several together, moves its
standardized score E'h / sqrt(E'Q E) (`component_choice`) by x sqrt(E'Q E). The test at the level of
`prior_conflict` misses one of five deviations of

    x = (t + 0.84) / sqrt(E'Q E)

with the threshold t of the test. In geodesy this is the minimal detectable bias [Baarda1968]. A
larger deviation than tolerances allow that is not detected is no error of the test; but intervals
that use the tolerances do not cover it.
"""

from __future__ import annotations

import numpy as np

from loopcal.estimate.free_parameters import FreeParameters
from loopcal.estimate.methods.component_choice import predict
from loopcal.estimate.methods.prior_conflict import LEVEL
from loopcal.estimate.methods.tolerance_components import list_shifts
from loopcal.findings import Finding, report_finding
from loopcal.numerics.chi_square import compute_chi_square_quantile
from loopcal.numerics.decomposition import Decomposition
from loopcal.numerics.multiple_tests import compute_single_level

POWER_QUANTILE = 0.8416212335729143
"""Normal quantile of the power 0.8."""

WIDE = 5.0
"""Deviation in tolerances that a test should show; what it could not is reported."""

NAMED = 4
"""Largest number of parameters that are named."""


def report_undetectable(free: FreeParameters, rows: Decomposition) -> list[Finding]:
    """Return a finding where deviations of WIDE tolerances would stay undetected.

    Parameters
    ----------
    free : the parameters. rows : for the stated tolerances, divided by their noise (t = 1).
    """
    Q, count = predict(rows, np.ones(1)).information[0], int((~free.assumed).sum())
    if count == 0:
        return []
    least = find_information(WIDE, count)
    own, names = np.where(free.assumed, np.inf, np.diag(Q)), free.names
    order = np.argsort(own)
    single = order[own[order] < least]
    shifts = [list(shift.places) for shift in list_shifts(free)]
    E = np.zeros((len(Q), len(shifts)))
    for j, places in enumerate(shifts):
        E[places, j] = 1.0
    common = (E * (Q @ E)).sum(axis=0)
    shared = np.flatnonzero(common < least)
    if not single.size and not shared.size:
        return []
    # the first of those that the data show least; rounding must not choose among several
    worst = shifts[int(np.argmax(common <= common.min() + 1e-6 * least))] if shared.size else []
    return [
        report_finding(
            "prior.undetectable",
            size=WIDE,
            names=tuple(names[i] for i in single[:NAMED]),
            count=len(single),
            total=count,
            together=tuple(names[i] for i in worst),
        )
    ]


def find_information(size: float, count: int) -> float:
    """Return the E'Q E with which a deviation is detected in four of five data sets.

    Parameters
    ----------
    size : of the deviation, in tolerances. count : number of statistics of the test.
    """
    level = compute_single_level(LEVEL, 3 * count)
    threshold = float(np.sqrt(compute_chi_square_quantile(1.0, level)))
    return ((threshold + POWER_QUANTILE) / size) ** 2
