# SPDX-License-Identifier: Apache-2.0
"""Test whether the geometry from which a fit starts is as good as the fit.

Start values. Where the start is the truth and the noise is as stated, the gain chi_square(start) -
chi_square(fit) has a chi-square distribution with as many degrees of freedom as fitted directions.
Where the noise is not stated, or contradicts the residuals of the fit, the gain per direction over
the residual per degree of freedom has an F distribution.

Geometry stored by a delta printer's firmware. Klipper's fit minimizes w * sum(height error^2) +
sum(distance error^2) with w = number of distances / (number of heights / 2) where there are
distances, and 1 otherwise, over radius, two tower angles and three end stops, and over the arms
where there are distances (source: the module `delta_calibrate` of Klipper). With sigmas of 1 mm /
sqrt(w) and 1 mm this is the chi-square in mm^2 of `identify`, so the stored values can be checked
against the optimum before they are used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, ClassVar

import numpy as np

from loopcal.errors import EstimationError
from loopcal.estimate.identification import identify
from loopcal.estimate.penalties import LeastSquares
from loopcal.estimate.residual_test import FEWEST_DEGREES, SIGNIFICANCE
from loopcal.estimate.result import Identification
from loopcal.findings import Finding, report_finding
from loopcal.measure.measurements import Measurements
from loopcal.measure.observations import Observations
from loopcal.mechanism.model import Mechanism
from loopcal.numerics.statistics import compute_chi_square_tail
from loopcal.results.description import Field, fields

# Share of the start's cost below which a gain is rounding: the last digits of a file.
NO_GAIN = 1e-3

MM = 1e-3

SMALL = 0.01  # changes below this are not listed [mm, deg]


class StartVerdict(Enum):
    """The start values of a fit, compared with the fit."""

    BEST = "best"
    WITHIN_NOISE = "within noise"
    NOT_CALIBRATED = "not calibrated"
    OPEN = "open"


@dataclass(frozen=True)
class StartCheck:
    """The geometry from which a fit started, compared with the fit."""

    verdict: StartVerdict  # see `StartVerdict`
    # before, after: root mean square of the residuals in units of the stated sigma, of the start
    # and of the fit [1]
    before: float
    after: float
    # probability of such a gain if the start is the truth; NaN where there is no test
    p_value: float
    finding: Finding  # the result

    FIELDS: ClassVar[tuple[Field, ...]] = fields(
        verdict="verdict.value", before="", after="", p_value="", finding=""
    )


@dataclass(frozen=True)
class StoredAnswer:
    """A stored geometry and the optimum of the firmware's cost, from the same probes."""

    # stored, best: the cost of each [mm^2]
    stored: float
    best: float
    # parameter, stored value, best value and unit, of those that differ
    moved: tuple[tuple[str, float, float, str], ...]

    @property
    def is_optimum(self) -> bool:
        """Whether the optimum is no better, except for the decimals of a file."""
        return self.stored - self.best <= NO_GAIN * self.stored

    @property
    def finding(self) -> Finding:
        """The comparison as a finding."""
        if self.is_optimum:
            return report_finding("residuals.stored-is-optimum", stored=self.stored, best=self.best)
        return report_finding("residuals.stored-not-optimum", **vars(self))

    def __str__(self) -> str:
        return str(self.finding)


def check_start_values(fit: Identification) -> StartCheck:
    """Compare the geometry from which a fit started with the fit, on the fitted measurements."""
    first, last = float(fit.history.cost[0]), float(fit.history.cost[-1])
    rows = sum(int(np.isfinite(r.raw).sum()) for r in fit.residuals)
    before, after = np.sqrt(first / rows), np.sqrt(last / rows)

    def judged(verdict: StartVerdict, p_value: float, code: str, **data: Any) -> StartCheck:
        finding = report_finding(f"residuals.start-{code}", **data)
        return StartCheck(verdict, before, after, p_value, finding)

    if not fit.converged:
        return judged(StartVerdict.OPEN, float("nan"), "not-comparable")
    gain = max(first - last, 0.0)
    if gain <= NO_GAIN * first:
        return judged(StartVerdict.BEST, 1.0, "is-best")
    test = fit.residual_test
    # the stated noise explains the residuals of the fit, or none are left
    is_consistent = test.noise == "given" and not test.failed
    p_value = float("nan")  # of a larger gain by this noise, else by that of the residuals
    if is_consistent:
        p_value = float(compute_chi_square_tail(fit.rank, gain))
    elif test.dof >= 1.0 and last > 0.0:
        from scipy.special import fdtrc

        p_value = float(fdtrc(fit.rank, test.dof, gain / fit.rank / (last / test.dof)))
    ratio = float(before / after) if after > 0.0 else None
    if p_value < SIGNIFICANCE:
        return judged(StartVerdict.NOT_CALIBRATED, p_value, "not-calibrated", ratio=ratio)
    if test.dof < FEWEST_DEGREES and not is_consistent:
        return judged(StartVerdict.OPEN, p_value, "needs-sigma", ratio=ratio)
    if test.failed:
        return judged(StartVerdict.OPEN, p_value, "undecided", ratio=ratio)
    return judged(StartVerdict.WITHIN_NOISE, p_value, "within-noise", ratio=ratio)


def compare_stored_geometry(robot: Mechanism, measured: Measurements) -> StoredAnswer | None:
    """Compare the stored geometry of a printer with the optimum of the firmware's cost; None where
    the probes do not determine one.

    measured : heights and distances; their sigmas do not matter.
    """
    count = {o.kind.poses_per_row: len(o) for o in measured.observations}
    w = 2.0 * count[2] / count[1] if count.get(1) and count.get(2) else 1.0
    sigma = {1: MM / np.sqrt(w), 2: MM}
    weighted = tuple(
        Observations.from_sigma(o.kind, o.rows, o.measured, sigma[o.kind.poses_per_row])
        for o in measured.observations
    )
    try:
        fit = identify(robot, replace(measured, observations=weighted), LeastSquares())
    except EstimationError:
        return None  # fewer probes than parameters, or a geometry that cannot reach them
    if not fit.converged or fit.rank < len(fit.names):
        return None
    is_angle = np.array([name.endswith(".angle") for name in fit.names])
    unit = np.where(is_angle, np.pi / 180.0, MM)
    stored = fit.initial.values[fit.free_parameters.places] / unit
    best = fit.estimate / unit
    symbols = ["deg" if angle else "mm" for angle in is_angle]
    return StoredAnswer(
        float(fit.history.cost[0]),
        float(fit.history.cost[-1]),
        tuple(
            (name, float(first), float(last), symbol)
            for name, first, last, symbol in zip(fit.names, stored, best, symbols, strict=True)
            if abs(last - first) > SMALL
        ),
    )
