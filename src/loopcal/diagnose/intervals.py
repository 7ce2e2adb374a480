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

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from loopcal.estimate.residual_test import coverage_factor
from loopcal.findings import Finding, report_finding
from loopcal.numerics.statistics import compute_single_level
from loopcal.results.description import Field, fields, label_axes
from loopcal.results.result import TableResult
from loopcal.typing import BoolArray, FloatArray

# Statistics of weighted draws, and how well the draws determine them.

LARGEST_TAIL = 0.2  # share of the draws whose weights are the tail, at most; see `fit_tail_shape`


def normalize_weights(log_weight: FloatArray) -> FloatArray:
    """Return weights (T,) of sum 1 from their logarithms; zero where these are not finite."""
    finite = np.isfinite(log_weight)
    if not finite.any():
        return np.zeros(len(log_weight))
    shifted = np.where(finite, log_weight - log_weight[finite].max(), -np.inf)
    weight = np.exp(shifted)
    return np.asarray(weight / weight.sum())


def effective_size(weight: FloatArray) -> float:
    """Return the number of independent draws that are worth as much as the weighted ones."""
    total = float((weight**2).sum())
    return 1.0 / total if total > 0.0 else 0.0


def fit_tail_shape(weight: FloatArray) -> float:
    """Return the shape k of the generalized Pareto distribution of the largest weights.

    The estimate of Zhang and Stephens (2009), with the weak prior of Vehtari et al. (2024,
    doi:10.48550/arXiv.1507.02646, appendix C), of the M largest weights over the next one,
    M = min(T / 5, 3 sqrt(T)). NaN with fewer than 5 of them.
    """
    total = len(weight)
    count = int(min(LARGEST_TAIL * total, 3.0 * np.sqrt(total)))
    if count < 5:
        return np.nan
    ordered = np.sort(weight)
    x = ordered[-count:] - ordered[-count - 1]
    x = x[x > 0.0]
    n = len(x)
    if n < 5:
        return np.nan
    m = 30 + int(np.sqrt(n))
    quartile = x[int(n / 4 + 0.5) - 1]
    b = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-b[:, None] * x).mean(axis=1)
    likelihood = n * (np.log(-b / k) - k - 1.0)
    share = 1.0 / np.exp(likelihood - likelihood[:, None]).sum(axis=1)
    best = float((b * share).sum() / share.sum())
    shape = float(np.log1p(-best * x).mean())
    return (n * shape + 10.0 * 0.5) / (n + 10.0)


def weighted_quantiles(draws: FloatArray, weight: FloatArray, level: FloatArray) -> FloatArray:
    """Return quantiles (len(level), p) of draws (T, p) with weights (T,) of sum 1.

    Between two draws the distribution function is linear, with half the weight of a draw below it.
    """
    order = np.argsort(draws, axis=0, kind="stable")
    values = np.take_along_axis(draws, order, axis=0)
    ordered = weight[order]
    below = np.cumsum(ordered, axis=0) - 0.5 * ordered
    columns = [np.interp(level, below[:, j], values[:, j]) for j in range(draws.shape[1])]
    return np.stack(columns, axis=1)


OFF = 0.10  # difference of an end of an interval, in linear half-widths, above which it is reported
NAMED = 3  # parameters that a finding names, at most
# Probability that any end is reported by the random draws alone, where linear intervals hold.
FALSE_ALARMS = 0.01


ENDS = ("lower", "upper", "linear_lower", "linear_upper")


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

    FIELDS: ClassVar[tuple[Field, ...]] = (
        *fields("level", "source", parameters=lambda intervals: intervals._list_rows()),
        *(Field(name, axes="parameter", unit="SI") for name in ("center", "sd", *ENDS)),
        Field("linear_is_off", "is_off", "parameter"),
    )
    LABELS: ClassVar[Mapping[str, Any]] = label_axes(parameter="names")

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
        quantile = float(coverage_factor(np.inf, 1.0 - compute_single_level(FALSE_ALARMS, tested)))
        beyond = np.abs(self.shift) - quantile * self.shift_error
        return np.asarray((np.where(np.isnan(beyond), 0.0, beyond) > OFF).any(axis=0))

    @property
    def largest_shift(self) -> FloatArray:
        """(p,) largest difference of an end, in linear half-widths."""
        return np.asarray(np.abs(np.nan_to_num(self.shift)).max(axis=0))

    def _list_rows(self) -> list[dict[str, Any]]:
        """Return one entry for each parameter [SI]."""
        columns = {name: getattr(self, name) for name in ENDS}
        columns |= {"shift": self.shift.T, "shift_error": self.shift_error.T}
        columns = {"name": self.names, "mean": self.center, "sd": self.sd, **columns}
        columns["linear_is_off"] = self.is_off
        rows = zip(*columns.values(), strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]


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
    density = np.exp(-0.5 * float(coverage_factor(np.inf, level)) ** 2) / np.sqrt(2.0 * np.pi)
    error = np.zeros_like(quantile)
    for i, tail in enumerate(tails):
        own = weight[:, None] * ((draws <= quantile[i]) - tail)
        other = linear_weight[:, None] * ((linear <= reference[i]) - tail)
        error[i] = np.sqrt(((own - other) ** 2).sum(axis=0)) * sd / density
    return EndDifference(quantile, reference, error)


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
