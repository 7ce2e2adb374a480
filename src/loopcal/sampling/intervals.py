# SPDX-License-Identifier: Apache-2.0
"""Intervals of parameters from draws, compared with linear ones.

A linear interval is off where one of its ends differs from that of the draws by more than 10 % of
its half-width, beyond what the finite number of draws explains. The ends are compared draw by draw:
with the same random numbers, the difference of a quantile from its linear counterpart is known far
better than either. Its standard error follows from the influence of each draw,

    d_i = w_i (1[x_i <= q] - a) / f - v_i (1[l_i <= r] - a) / f

with the quantiles q and r at level a of draws x_i with weights w_i and of linear draws l_i with
weights v_i, and the linear density f there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from loopcal.findings import Finding, report_finding
from loopcal.numerics.multiple_tests import compute_single_level
from loopcal.presentation import TableResult
from loopcal.sampling.weighted_sample import weighted_quantiles
from loopcal.typing import BoolArray, FloatArray

OFF = 0.10
"""Difference of an end of an interval, in linear half-widths, above which it is reported."""

NAMED = 3
"""Parameters that a finding names, at most."""

FALSE_ALARMS = 0.01
"""Probability that any end is reported by the random draws alone, where linear intervals hold."""


@dataclass(frozen=True, eq=False)
class Intervals(TableResult):
    """Intervals of parameters; arrays are (p,) [SI], NaN where the data determine none.

    Attributes
    ----------
    names : of the parameters. level : coverage of each interval. source : what was drawn.
    center, sd : mean and standard deviation of the draws. lower, upper : the interval.
    linear_lower, linear_upper : the linear interval, under the same assumptions on the noise.
    shift : (2, p) differences of the ends from the linear ones, in linear half-widths.
    shift_error : (2, p) their standard errors by the finite number of draws.
    """

    names: tuple[str, ...]
    level: float
    source: str
    center: FloatArray
    sd: FloatArray
    lower: FloatArray
    upper: FloatArray
    linear_lower: FloatArray
    linear_upper: FloatArray
    shift: FloatArray
    shift_error: FloatArray

    def __repr__(self) -> str:
        """Return the number of parameters, and how many linear intervals are off."""
        off = int(self.is_off.sum())
        return f"<Intervals by {self.source}: {len(self.names)} parameters, {off} linear ones off>"

    @property
    def is_off(self) -> BoolArray:
        """(p,) whether the linear interval is off by more than `OFF`, beyond the random draws."""
        tested = int(np.isfinite(self.shift).sum())
        if not tested:
            return np.zeros(len(self.names), dtype=bool)
        quantile = float(half_widths(1.0 - compute_single_level(FALSE_ALARMS, tested)))
        beyond = np.abs(self.shift) - quantile * self.shift_error
        return np.asarray((np.where(np.isnan(beyond), 0.0, beyond) > OFF).any(axis=0))

    @property
    def largest_shift(self) -> FloatArray:
        """(p,) largest difference of an end, in linear half-widths."""
        return np.asarray(np.abs(np.nan_to_num(self.shift)).max(axis=0))

    def to_dict(self) -> dict[str, Any]:
        """Return one entry for each parameter, for JSON [SI]."""
        return {
            "level": self.level,
            "source": self.source,
            "parameters": [
                {
                    "name": name,
                    "mean": self.center[i],
                    "sd": self.sd[i],
                    "lower": self.lower[i],
                    "upper": self.upper[i],
                    "linear_lower": self.linear_lower[i],
                    "linear_upper": self.linear_upper[i],
                    "shift": self.shift[:, i],
                    "shift_error": self.shift_error[:, i],
                    "linear_is_off": bool(self.is_off[i]),
                }
                for i, name in enumerate(self.names)
            ],
        }


@dataclass(frozen=True, eq=False)
class EndDifference:
    """Quantiles (2, p) of draws and of linear draws at the ends of intervals, and the standard
    error (2, p) of their difference.
    """

    quantile: FloatArray
    linear: FloatArray
    error: FloatArray


def compare_ends(
    draws: FloatArray,
    weight: FloatArray,
    linear: FloatArray,
    linear_weight: FloatArray,
    level: float,
) -> EndDifference:
    """Compare the ends of intervals of draws (T, p) with those of linear draws (T, p), one by one.

    Both have weights (T,) of sum 1.
    """
    tails = np.array([0.5 - 0.5 * level, 0.5 + 0.5 * level])
    quantile = weighted_quantiles(draws, weight, tails)
    reference = weighted_quantiles(linear, linear_weight, tails)
    mean = linear_weight @ linear
    sd = np.sqrt(linear_weight @ (linear - mean) ** 2)
    density = np.exp(-0.5 * float(half_widths(level)) ** 2) / np.sqrt(2.0 * np.pi)
    error = np.zeros_like(quantile)
    for i, tail in enumerate(tails):
        own = weight[:, None] * ((draws <= quantile[i]) - tail)
        other = linear_weight[:, None] * ((linear <= reference[i]) - tail)
        error[i] = np.sqrt(((own - other) ** 2).sum(axis=0)) * sd / density
    return EndDifference(quantile, reference, error)


def half_widths(level: float, degrees: FloatArray | float = np.inf) -> FloatArray:
    """Return half-widths in standard deviations of two-sided intervals, by Student's t."""
    from loopcal.numerics.special_functions import ndtri, stdtrit

    quantile = 0.5 + 0.5 * level
    nu = np.asarray(degrees, dtype=np.float64)
    finite = np.isfinite(nu)
    by_t = stdtrit(np.where(finite, nu, 1.0), quantile)
    return np.asarray(np.where(finite, by_t, ndtri(quantile)))


def report_intervals(intervals: Intervals, agrees: str, differs: str) -> list[Finding]:
    """Return whether linear intervals hold, with the codes for yes and no."""
    off, size = np.flatnonzero(intervals.is_off), intervals.largest_shift
    share: dict[str, Any] = {"limit": OFF, "level": intervals.level}
    if not len(off):
        return [report_finding(agrees, **share, count=len(intervals.names))]
    order = off[np.argsort(-size[off])]
    names = tuple(intervals.names[i] for i in order)
    return [
        report_finding(
            differs,
            **share,
            count=len(off),
            total=len(intervals.names),
            names=names[:NAMED],
            largest=float(size[order[0]]),
        )
    ]
